"""What many tests share. Networks and gains are made by `made_recordings`, without any solver."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as the program does; two tests at a time take both cores

import pytest
from hypothesis import settings
from made_recordings import random_gains, random_problem

from agent.contract.gains import Gains

# The same examples every time: a test that fails, fails for everybody.
settings.register_profile("repeatable", derandomize=True, deadline=None, database=None)
settings.load_profile("repeatable")


@pytest.fixture(scope="session")
def gains() -> Gains:
    """Three nodes with 1, 2 and 1 measurements, two modes, weights that differ from 1."""
    return random_gains(random_problem(5, ny=(1, 2, 1), modes=2))


@pytest.fixture
def ctrl_c() -> Iterator[None]:
    """SIGINT has its effect, here and in processes started here, though whoever started the tests may ignore it."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.fixture(scope="module")
def cluster() -> Iterator[str]:
    """The address of a cluster with two workers, each a process; it costs time while it is idle too."""
    import dask
    from distributed import LocalCluster

    with (
        dask.config.set({"distributed.scheduler.allowed-failures": 0}),  # a job that kills its worker is not repeated
        LocalCluster(
            n_workers=2, threads_per_worker=1, processes=True, host="127.0.0.1", dashboard_address="127.0.0.1:0"
        ) as local,
    ):
        yield local.scheduler_address
