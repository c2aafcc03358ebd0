"""The memory that a design may take: whichever limit is the tightest, and what each of them leaves."""

from __future__ import annotations

import resource
from pathlib import Path

import pytest

from designer.search.memory import free_memory

GB = 1 << 30


def system(root: Path, *, groups: dict[str, int | None]) -> Path:
    """A machine with 8 GB free, and a process in these control groups, of each of which 1 GB is taken."""
    own = max(groups, key=len, default="")
    files = {"proc/meminfo": f"MemTotal: 1 kB\nMemAvailable: {8 * GB // 1024} kB\n", "proc/self/cgroup": f"0::/{own}\n"}
    files["proc/self/statm"] = f"{GB // resource.getpagesize()} 1 1 1 0 1 0\n"
    for path, limit in groups.items():
        folder = f"sys/fs/cgroup/{path}".rstrip("/")
        files |= {
            f"{folder}/memory.max": "max\n" if limit is None else f"{limit}\n",
            f"{folder}/memory.current": f"{GB + GB // 4}\n",
            f"{folder}/memory.stat": f"anon {GB}\ninactive_file {GB // 4}\n",
        }
    for name, text in files.items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text(text)
    return root


@pytest.mark.parametrize(
    ("groups", "free"),
    [
        ({}, 8 * GB),
        ({"": 4 * GB}, 3 * GB),  # in a container
        ({"a": 5 * GB, "a/b": None}, 4 * GB),  # the one above it counts too
        ({"a": 5 * GB, "a/b": 3 * GB}, 2 * GB),
        ({"a": GB // 2}, 0),
    ],
)
def test_the_tightest_control_group_counts(groups: dict[str, int | None], free: float, tmp_path: Path) -> None:
    """What it has taken is off, but for files that it would let go."""
    assert free_memory(system(tmp_path, groups=groups)) == free


def test_a_limit_of_the_address_space_counts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """`ulimit -v`, less what the process has of it."""
    monkeypatch.setattr(resource, "getrlimit", lambda what: {resource.RLIMIT_AS: (3 * GB, 3 * GB)}[what])
    assert free_memory(system(tmp_path, groups={})) == 2 * GB


def test_a_system_that_says_nothing_has_what_is_installed(tmp_path: Path) -> None:
    assert free_memory(tmp_path) > GB / 4
