"""The runtime's commands: run, and one for each role. Results on stdout, progress and errors on stderr."""

from __future__ import annotations

import argparse
import os
import sys
import traceback
from collections.abc import Sequence
from contextlib import redirect_stderr

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # small matrices: threads only cost memory and time

from agent.commands import doctor, keys, roles, run
from agent.commands.quiet import Quiet
from agent.contract.errors import EXIT_BROKEN, EXIT_GOOD, EXIT_INPUT, EXIT_INTERRUPTED, PeakmeshError
from agent.contract.extras import needing


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; returns its exit code."""
    open_streams()
    words = list(sys.argv[1:] if arguments is None else arguments)
    parser = argparse.ArgumentParser(prog="peakmesh", description=__doc__, allow_abbrev=False)
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    run.add_run(commands)
    roles.add_roles(commands, {} if "--child" in words else os.environ)  # a launcher says all to its children
    keys.add_keys(commands)
    doctor.add_doctor(commands)
    return perform(parser.parse_args(words))


def open_streams() -> None:
    """Where a standard stream was closed, open it to nowhere: else the next file opened would be taken for it."""
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # takes the lowest number that is free: this one
            setattr(sys, name, open(number, "r" if number == 0 else "w", closefd=False))  # noqa: SIM115 -- for good


def perform(options: argparse.Namespace) -> int:
    """Call the chosen command; an error becomes one sentence on stderr and an exit code."""
    try:
        with needing(options.command), redirect_stderr(Quiet(sys.stderr) if options.quiet else sys.stderr):
            code = options.call(options)
        sys.stdout.flush()
        return int(code)
    except PeakmeshError as error:
        if options.verbose:
            traceback.print_exc()
        print(f"peakmesh: {error}", file=sys.stderr)
        return error.exit_code
    except KeyboardInterrupt:
        print("peakmesh: interrupted", file=sys.stderr)
        return EXIT_INTERRUPTED
    except BrokenPipeError:  # the reader of our output has gone
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return EXIT_GOOD
    except MemoryError as error:
        why = f" ({error})" if str(error) else ""
        print(f"peakmesh: {options.command}: there is too little memory for this{why}; ask for less", file=sys.stderr)
        return EXIT_BROKEN
    except OSError as error:
        print(f"peakmesh: {error.filename or options.command}: {error.strerror or error}", file=sys.stderr)
        return EXIT_INPUT
    except Exception:  # a defect of peakmesh: 1 would mean that the answer is no
        traceback.print_exc()
        return EXIT_BROKEN
