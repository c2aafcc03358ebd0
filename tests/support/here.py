"""The program in this process, where what it prints is all that matters: one of its own takes a second to start."""

from __future__ import annotations

import contextlib
import io
import subprocess
from pathlib import Path

from designer.cli import main


def here(*arguments: object, cwd: Path | None = None) -> subprocess.CompletedProcess[str]:
    """Run a command to its end, as `runs.peakmesh` does."""
    out, err = (io.TextIOWrapper(io.BytesIO(), write_through=True) for _ in range(2))
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err), contextlib.chdir(cwd or Path.cwd()):
        try:
            code = main([str(argument) for argument in arguments])
        except SystemExit as refused:  # by the parser
            code = int(refused.code or 0)
    said, complained = (stream.buffer.getvalue().decode() for stream in (out, err))  # type: ignore[attr-defined]
    return subprocess.CompletedProcess(arguments, code, said, complained)
