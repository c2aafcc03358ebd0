"""Many independent jobs at once: on processes of this machine, or on a Dask cluster that runs already.

One function, `each`. It knows nothing of what the jobs are.
"""

from __future__ import annotations

import asyncio
import multiprocessing
import os
import signal
import threading
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import suppress
from typing import TypeVar

from agent.contract.errors import InputError, RunBroken
from agent.contract.extras import needing
from designer.patience import look

_OFTEN = 0.5  # seconds between two looks whether it is to end
PATIENCE = 30  # seconds for a Dask scheduler to answer, and for the first of its workers to be there

Item = TypeVar("Item")
Result = TypeVar("Result")


def each(
    function: Callable[[Item], Result],
    items: Sequence[Item],
    *,
    dask: str | None = None,
    processes: int | None = None,
) -> Iterator[Result]:
    """function(item) for every item, in the order of the items, each as soon as it and all before it are there.

    Runs on `processes` processes of this machine (None: one for each core), in this one where one would do, or on
    the Dask cluster whose scheduler listens at `dask`. Function, items and results must be picklable. An exception
    of the function is raised here and ends the rest; so do Ctrl-C and closing the iterator, and no process stays.
    Raises InputError where nobody answers at `dask`, RunBroken where a worker dies.
    """
    if processes is not None and processes < 1:
        raise InputError(f"processes is {processes}; it must be at least 1")
    if dask is not None:
        return _on_cluster(function, items, dask)
    number = min(processes or len(os.sched_getaffinity(0)), len(items))
    return map(function, items) if number <= 1 else _on_processes(function, items, number)


def greet_cluster(address: str) -> None:
    """InputError where no Dask scheduler answers at this address, or the package to ask it with is missing."""
    with needing("a Dask cluster"):
        import distributed  # noqa: F401
    try:
        with ThreadPoolExecutor(1) as thread:  # this one may have an event loop already, as notebooks do
            thread.submit(asyncio.run, _greet(address)).result()
    except (OSError, ValueError) as error:  # TimeoutError is an OSError
        raise _nobody(address, error) from None


def _nobody(address: str, error: Exception) -> InputError:
    return InputError(f"no Dask scheduler answers at {address}: {str(error) or f'nothing came within {PATIENCE} s'}")


def _on_processes(function: Callable[[Item], Result], items: Sequence[Item], number: int) -> Iterator[Result]:
    others = set(multiprocessing.active_children())
    pool = ProcessPoolExecutor(number, mp_context=multiprocessing.get_context("spawn"), initializer=_begin_worker)
    try:
        futures = deque(pool.submit(function, item) for item in items)
        while futures:
            while not futures[0].done():
                wait([futures[0]], timeout=_OFTEN)
                look()
            yield futures.popleft().result()
    except BrokenProcessPool:
        raise RunBroken(
            "a worker process died; was there too little memory? --processes asks for fewer. In a script of your own, "
            'is what it does under if __name__ == "__main__": ?'
        ) from None
    finally:
        for worker in set(multiprocessing.active_children()) - others:
            worker.terminate()  # it is idle, or at a job whose result nobody waits for any more
        pool.shutdown()  # no job is cancelled: Python 3.11 stumbles over cancelled ones of a worker that died


def _begin_worker() -> None:
    """Before the first job, and so before numpy is loaded: one core each; whoever started it decides when it ends."""
    os.environ.update(OMP_NUM_THREADS="1", OPENBLAS_NUM_THREADS="1", MKL_NUM_THREADS="1")
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)


def _on_cluster(function: Callable[[Item], Result], items: Sequence[Item], address: str) -> Iterator[Result]:
    greet_cluster(address)
    import distributed

    try:
        client = distributed.Client(address, timeout=PATIENCE, set_as_default=False)
    except (OSError, ValueError) as error:
        raise _nobody(address, error) from None
    try:
        try:
            client.wait_for_workers(1, timeout=PATIENCE)
        except TimeoutError:
            raise InputError(
                f"the Dask cluster at {address} has no workers; start one: dask worker {address}"
            ) from None
        futures = client.map(function, items, pure=False)
        try:
            for future in futures:
                while not future.done():
                    with suppress(TimeoutError):
                        future.result(timeout=_OFTEN)
                    look()
                yield future.result()
        except distributed.KilledWorker as error:
            raise RunBroken(f"workers of the Dask cluster at {address} died: {error}") from None
        except (RuntimeError, ImportError) as error:
            if isinstance(error, RuntimeError) and "deserialization" not in str(error):
                raise
            raise InputError(
                f"the Dask cluster at {address} cannot load the jobs; its scheduler and workers need the peakmesh of "
                "this machine"
            ) from error
        finally:
            client.cancel(futures)
    finally:
        client.close()


async def _greet(address: str) -> None:
    """A Client would wait for ever for the first words of somebody who listens and says nothing."""
    from distributed.comm import connect

    comm = await asyncio.wait_for(connect(address, timeout=PATIENCE), PATIENCE)
    await comm.close()
