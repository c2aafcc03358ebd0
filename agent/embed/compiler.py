"""What this machine's C compiler makes of a node: whether it passes its self-test, and how much room it takes."""

from __future__ import annotations

import shutil
import subprocess
import tempfile
from pathlib import Path
from typing import NamedTuple

COMPILERS = ("cc", "gcc", "clang")
FLAGS = ("-std=c99", "-ffp-contract=off")
_PATIENCE = 300.0  # seconds, for each program


class Built(NamedTuple):
    """What was seen of a node on this machine."""

    compiler: str
    passes: bool
    says: str  # the self-test, or the compiler where it made none
    text: int | None = None  # bytes, at -Os; None where nothing counts them
    data: int | None = None
    bss: int | None = None
    stack: int | None = None  # bytes at most, while any function of it runs


def build(folder: Path, node: str) -> Built | None:
    """Compile, measure, run the self-test; None where there is no compiler. Nothing is left behind."""
    compiler = next((found for name in COMPILERS if (found := shutil.which(name))), None)
    if compiler is None:
        return None
    try:
        return _built(compiler, folder, node)
    except (OSError, subprocess.TimeoutExpired) as error:
        return Built(compiler, False, str(error))


def _built(compiler: str, folder: Path, node: str) -> Built:
    body, test = folder.resolve() / f"{node}.c", folder.resolve() / f"{node}_selftest.c"
    with tempfile.TemporaryDirectory() as work:
        made = _said(work, compiler, *FLAGS, "-O2", "-o", "selftest", str(test), str(body))
        if made.returncode:
            return Built(compiler, False, made.stderr.strip())
        tested = _said(work, str(Path(work) / "selftest"))
        counted = _said(work, compiler, *FLAGS, "-Os", "-fstack-usage", "-c", "-o", "node.o", str(body))
        sizes = (None, None, None) if counted.returncode else _sizes(work)
        return Built(compiler, tested.returncode == 0, tested.stdout.strip(), *sizes, _stack(Path(work)))


def _said(work: str, *command: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(command, cwd=work, capture_output=True, text=True, timeout=_PATIENCE, check=False)


def _sizes(work: str) -> tuple[int | None, int | None, int | None]:
    if shutil.which("size") is None:
        return None, None, None
    text, data, bss = _said(work, "size", "node.o").stdout.splitlines()[1].split()[:3]
    return int(text), int(data), int(bss)


def _stack(work: Path) -> int | None:
    """The frames of all functions together: no more can be in use, for none is called within itself."""
    usage = next(work.glob("*.su"), None)
    return None if usage is None else sum(int(line.split("\t")[1]) for line in usage.read_text().splitlines())
