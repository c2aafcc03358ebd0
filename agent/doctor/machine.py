"""What the machine lets a process have: files, threads, memory, folders, clocks; for a whole run of so many nodes."""

from __future__ import annotations

import ctypes
import math
import multiprocessing
import os
import resource
import shutil
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from agent.children import folder_of_sockets
from agent.doctor.findings import Finding, State

FILES, FILES_EACH = 64, 4  # that whoever starts a run has open, and for each process of it: a pipe, a socket, two files
THREADS = 20  # of a process; a node has 18
MEMORY, MEMORY_EACH = 64, 16  # MB: of all together, and of each process beside what is common
DISK = 100  # MB; a recording of four nodes takes 1 MB for a thousand steps
OLDEST = 1_735_689_600  # 2025-01-01: a clock that says less has never been set
LATE = 0.005  # seconds after which a sleep has ended when it should not have
NAPS = 20
_TIME_ERROR = 5  # of adjtimex(2): not synchronised
_SIZE_OF_TIMEX = 256  # and more than that


def machine(processes: int) -> Iterator[Finding]:
    """All looks; `processes` are those of a whole run on this machine."""
    yield _at_least(
        "open files", resource.getrlimit(resource.RLIMIT_NOFILE)[0], FILES + FILES_EACH * processes, "ulimit -n"
    )
    yield _at_least("threads", _threads(), THREADS * processes, "ulimit -u, or pids.max of the cgroup")
    yield memory(MEMORY + MEMORY_EACH * processes)
    yield from folders()
    yield workers()
    yield clock()
    yield timer()


def _at_least(what: str, limit: float, needed: int, where: str) -> Finding:
    allowed = "no limit" if limit in (math.inf, resource.RLIM_INFINITY) else f"{limit:g} allowed"
    if limit != resource.RLIM_INFINITY and limit < needed:
        return Finding(what, State.WRONG, f"{allowed}, and a run takes about {needed}: {where}")
    return Finding(what, State.GOOD, f"{allowed}, a run takes about {needed}")


def _threads() -> float:
    """How many more this user, or this container, may have."""
    limits = [math.inf]
    of_user = resource.getrlimit(resource.RLIMIT_NPROC)[0]
    if of_user != resource.RLIM_INFINITY and os.geteuid():  # root may have as many as it likes
        limits.append(of_user)
    folder = Path("/sys/fs/cgroup")
    try:
        most, now = (folder / name for name in ("pids.max", "pids.current"))
        limits.append(int(most.read_text()) - int(now.read_text()))
    except (OSError, ValueError):  # not there, or "max"
        pass
    return min(limits)


def memory(needed: int) -> Finding:
    """`needed` in MB; what is available without swapping."""
    try:
        lines = dict(line.split(":") for line in Path("/proc/meminfo").read_text().splitlines())
        available = int(lines["MemAvailable"].split()[0]) // 1024
    except (OSError, KeyError, ValueError):
        return Finding("memory", State.WARNING, f"not known; a run takes about {needed} MB")
    state = State.GOOD if available >= needed else State.WARNING
    return Finding("memory", state, f"{available} MB available, a run takes about {needed} MB")


def folders() -> Iterator[Finding]:
    """Where a run has its sockets, and where recordings go."""
    for what, folder in (("sockets in", folder_of_sockets()), ("recordings in", os.getcwd())):
        name, free = f"{what} {folder}", shutil.disk_usage(folder).free // 10**6
        try:
            with tempfile.TemporaryFile(dir=folder):
                pass
        except OSError as error:
            yield Finding("folder", State.WRONG, f"{name}: nothing can be written: {error.strerror}")
            continue
        state = State.GOOD if free >= DISK else State.WARNING
        yield Finding("folder", state, f"{name}: {free} MB free")


def workers() -> Finding:
    """What sweep, simulate and design --price need to work on several cores."""
    cores = len(os.sched_getaffinity(0))
    try:
        multiprocessing.get_context("spawn").Lock()
    except OSError as error:
        said = f"no semaphores ({error.strerror}): is /dev/shm there? simulate --processes 1 needs none"
        return Finding("workers", State.WARNING, said)
    return Finding("workers", State.GOOD, f"{cores} cores")


def clock() -> Finding:
    """Whether certificates, and times that are told of two machines, mean anything. Lock-step needs none of it."""
    now = time.time()
    said = time.strftime("%Y-%m-%d %H:%M:%S UTC", time.gmtime(now))
    if now < OLDEST:
        return Finding("clock", State.WRONG, f"{said}: it was never set, and certificates will not be valid")
    if _adjtimex() == _TIME_ERROR:
        return Finding(
            "clock",
            State.WARNING,
            f"{said}, not synchronised: certificates and the times in recordings are as wrong as it is",
        )
    return Finding("clock", State.GOOD, said)


def _adjtimex() -> int:
    """What the kernel says of its clock; nothing is changed. -1 where it does not tell."""
    try:
        return int(ctypes.CDLL(None).adjtimex(ctypes.create_string_buffer(_SIZE_OF_TIMEX)))
    except (OSError, AttributeError):
        return -1


def timer() -> Finding:
    """How late sleeps of a millisecond end: what a period can be kept to."""
    longest = 0.0
    for _ in range(NAPS):
        began = time.monotonic()
        time.sleep(0.001)
        longest = max(longest, time.monotonic() - began - 0.001)
    said = f"a sleep of 1 ms took {1e3 * longest:.2f} ms more at most, of {NAPS}"
    if longest > LATE:
        return Finding("timer", State.WARNING, f"{said}: what is due in a shorter time than that will be late")
    return Finding("timer", State.GOOD, said)
