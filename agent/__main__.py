"""`python -m agent`: the runtime's commands."""

import sys


def main() -> int:
    """Call the program, of which the imports take a moment; Ctrl-C ends that moment with a sentence, too."""
    try:
        from agent.cli import main as run_command

        return run_command()
    except KeyboardInterrupt:
        print("peakmesh: interrupted", file=sys.stderr)
        return 130  # EXIT_INTERRUPTED of agent/contract/errors.py, which may not be there yet


if __name__ == "__main__":
    sys.exit(main())
