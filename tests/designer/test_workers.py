"""Jobs on processes and on a Dask cluster: the order, the errors, and that nothing stays behind."""

from __future__ import annotations

import multiprocessing
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from jobs import die, refuse, stay, threads_after_a_product, where
from runs import children, wait_until_gone

from agent.contract.errors import InputError, RunBroken, Unattainable
from designer import workers
from designer.workers import each


def own_children() -> set[multiprocessing.process.BaseProcess]:
    """Worker processes; those of Dask are daemons."""
    return {process for process in multiprocessing.active_children() if not process.daemon}


@pytest.fixture(autouse=True)
def _nobody_stays() -> Iterator[None]:
    """No test leaves a process that was not there before."""
    before = own_children()
    yield
    assert own_children() == before


# on processes of this machine
def test_results_come_in_the_order_of_the_items() -> None:
    done = list(each(where, range(7), processes=2))
    assert [item for item, _ in done] == list(range(7))
    assert 1 <= len({pid for _, pid in done} - {os.getpid()}) <= 2
    assert os.getpid() not in {pid for _, pid in done}


@pytest.mark.parametrize(("items", "processes"), [([4], 3), ([1, 2], 1), ([], 2)])
def test_one_process_is_this_one(items: list[int], processes: int) -> None:
    assert list(each(where, items, processes=processes)) == [(item, os.getpid()) for item in items]


def test_a_worker_takes_one_core(monkeypatch: pytest.MonkeyPatch) -> None:
    """Numpy's linear algebra starts no threads of its own."""
    for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        monkeypatch.delenv(variable, raising=False)
    assert all(before == after for before, after in each(threads_after_a_product, range(2), processes=2))


def test_an_error_of_a_job_is_raised_here_and_ends_the_rest() -> None:
    with pytest.raises(Unattainable, match="item 2 has no answer"):
        list(each(refuse, range(20), processes=2))


def test_closing_the_iterator_ends_jobs_that_run() -> None:
    running = each(stay, range(5), processes=2)
    assert next(running) == 0
    assert own_children()
    running.close()  # type: ignore[attr-defined]
    assert not own_children()


def test_a_worker_that_dies_is_said() -> None:
    with pytest.raises(RunBroken, match="a worker process died"):
        list(each(die, range(1, 4), processes=2))


@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGKILL])
def test_no_worker_outlives_whoever_started_it(ctrl_c: None, how: signal.Signals, tmp_path: Path) -> None:
    """Ctrl-C ends jobs that run, and so does the end of the process that waits for them."""
    script = tmp_path / "starter.py"
    script.write_text(
        "from jobs import stay\nfrom designer.workers import each\n"
        'if __name__ == "__main__":\n'
        "    for done in each(stay, range(5), processes=2):\n"
        "        print(done, flush=True)\n"
    )
    path = os.pathsep.join(sys.path)
    with subprocess.Popen(
        [sys.executable, str(script)],
        env={**os.environ, "PYTHONPATH": path},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        try:
            assert process.stdout.readline() == "0\n"
            pids = list(children(process.pid))
            assert len(pids) >= 2
        finally:
            process.send_signal(how)
        wait_until_gone(pids)
        errors = process.stderr.read()
        assert errors.count("Traceback") == (how == signal.SIGINT)  # the workers are silent


def test_less_than_one_process_is_refused() -> None:
    with pytest.raises(InputError, match="processes is 0; it must be at least 1"):
        each(where, [1], processes=0)


# on a Dask cluster
def test_a_cluster_gives_the_results_in_order(cluster: str) -> None:
    done = list(each(where, range(12), dask=cluster))
    assert [item for item, _ in done] == list(range(12))
    assert len({pid for _, pid in done}) == 2
    assert os.getpid() not in {pid for _, pid in done}


def test_one_item_runs_on_the_cluster_too(cluster: str) -> None:
    assert next(each(where, [3], dask=cluster))[1] != os.getpid()


def test_an_error_on_the_cluster_is_raised_here(cluster: str) -> None:
    with pytest.raises(Unattainable, match="item 2 has no answer"):
        list(each(refuse, range(5), dask=cluster))
    assert [item for item, _ in each(where, range(3), dask=cluster)] == [0, 1, 2]  # and the cluster goes on


def test_a_job_that_kills_its_worker_is_said(cluster: str) -> None:
    with pytest.raises(RunBroken, match=r"workers of the Dask cluster at .* died"):
        list(each(die, [1], dask=cluster))


FOREIGN_CLUSTER = """
import asyncio, sys
class Nothing:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] == "jobs":
            raise ModuleNotFoundError(f"No module named {name!r}")
sys.meta_path.insert(0, Nothing())
from distributed import Scheduler, Worker
async def main():
    nowhere = {"dashboard_address": "127.0.0.1:0"}
    async with Scheduler(host="127.0.0.1", port=0, **nowhere) as scheduler, Worker(scheduler.address, **nowhere):
        print(scheduler.address, flush=True)
        await asyncio.to_thread(sys.stdin.read)
asyncio.run(main())
"""


def test_a_cluster_that_lacks_the_code_is_said() -> None:
    with subprocess.Popen(
        [sys.executable, "-c", FOREIGN_CLUSTER],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    ) as foreign:
        assert foreign.stdin is not None
        assert foreign.stdout is not None
        try:
            address = foreign.stdout.readline().strip()
            with pytest.raises(InputError, match="cannot load the jobs; its scheduler and workers need the peakmesh"):
                list(each(where, [1, 2], dask=address))
        finally:
            foreign.kill()


def test_a_cluster_without_workers_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    from distributed import LocalCluster

    monkeypatch.setattr(workers, "PATIENCE", 1)
    with (
        LocalCluster(n_workers=0, processes=True, host="127.0.0.1", dashboard_address="127.0.0.1:0") as empty,
        pytest.raises(InputError, match=r"has no workers; start one: dask worker tcp://127\.0\.0\.1:\d+$"),
    ):
        list(each(where, [1, 2], dask=empty.scheduler_address))


@pytest.mark.parametrize("address", ["127.0.0.1", "carrier-pigeon://127.0.0.1:8786"])
def test_an_address_that_is_none_is_refused(address: str) -> None:
    with pytest.raises(InputError, match="no Dask scheduler answers at "):
        list(each(where, [1, 2], dask=address))


@pytest.mark.parametrize("listens", [False, True])
def test_an_address_where_no_scheduler_answers_is_refused(listens: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Neither a port where nobody listens nor one that takes the connection and says nothing is waited for long."""
    monkeypatch.setattr(workers, "PATIENCE", 1)
    with socket.socket() as silent:
        silent.bind(("127.0.0.1", 0))
        if listens:
            silent.listen()
        address = f"tcp://127.0.0.1:{silent.getsockname()[1]}"
        with pytest.raises(InputError, match=f"no Dask scheduler answers at {address}: "):
            list(each(where, [1, 2], dask=address))


def test_without_dask_it_is_said_how_to_get_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(InputError, match=r"pip install 'peakmesh\[dask\]'"):
        list(each(where, [1, 2], dask="tcp://127.0.0.1:8786"))
