"""`python -m peakmesh.background ARGUMENTS`: `run` in a process of its own, for `Mesh`.

Says {"listening": addresses} as a line of JSON, and in its last line on stderr what went wrong. It ends the run when
its standard input ends: then whoever has started it is gone, or wants it to.
"""

from __future__ import annotations

import json
import os
import signal
import sys
import threading
from typing import Any

from peakmesh import claim


def main() -> int:
    """Returns the exit code of `peakmesh run`."""
    threading.Thread(target=_end_with_parent, daemon=True).start()
    claim()
    from agent.commands.run import exit_code_of
    from agent.contract.errors import PeakmeshError
    from peakmesh.running import run

    try:
        done = run(**json.loads(sys.argv[1]), report=_tell)
    except PeakmeshError as error:
        print(error, file=sys.stderr, flush=True)
        return error.exit_code
    if why := done.broken_off or done.not_whole:
        print(f"the recording is not whole: {why}", file=sys.stderr, flush=True)
    return exit_code_of(vars(done))


def _tell(word: dict[str, Any]) -> None:
    if "listening" in word:
        print(json.dumps(word), flush=True)


def _end_with_parent() -> None:
    os.read(0, 1)
    os.kill(os.getpid(), signal.SIGTERM)


if __name__ == "__main__":
    sys.exit(main())
