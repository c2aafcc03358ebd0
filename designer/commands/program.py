"""`peakmesh help` and `peakmesh completion`: what is asked of the program itself."""

from __future__ import annotations

import argparse
from difflib import get_close_matches
from functools import partial
from pathlib import Path

from agent.commands.options import Subcommands, add_command
from agent.contract.errors import EXIT_GOOD, InputError

SHELLS = {  # and where each looks for it
    "bash": "~/.local/share/bash-completion/completions/peakmesh",
    "zsh": "a folder of $fpath, as _peakmesh",
    "fish": "~/.config/fish/completions/peakmesh.fish",
}
FILES = {"PROBLEM", "PROBLEM_OR_GAINS"}  # of what may be a file, beside every path


def add_help(commands: Subcommands, program: argparse.ArgumentParser) -> None:
    """Describe `help` to the parser, which it prints."""
    about = add_command(commands, "help", partial(help_command, program), "what a command does, and its options")
    about.add_argument("words", nargs="*", metavar="COMMAND", help="such as design, or keys init (the program itself)")


def help_command(program: argparse.ArgumentParser, options: argparse.Namespace) -> int:
    """`peakmesh help COMMAND`."""
    parser = program
    for word in options.words:
        known = _commands(parser)
        if not known:
            raise InputError(f"{parser.prog} has no commands of its own")
        if word not in known:
            near = get_close_matches(word, known, n=1)
            hint = f'did you mean "{near[0]}"?' if near else f"there are {', '.join(known)}"
            raise InputError(f'there is no command "{word}"; {hint}')
        parser = known[word]
    parser.print_help()
    return EXIT_GOOD


def add_completion(commands: Subcommands, program: argparse.ArgumentParser) -> None:
    """Describe `completion` to the parser, for which it is made."""
    where = "; ".join(f"{shell}: {place}" for shell, place in SHELLS.items())
    completion = add_command(
        commands, "completion", partial(completion_command, program), f"a script that completes commands ({where})"
    )
    completion.add_argument("shell", choices=sorted(SHELLS), help="which shell reads it")


def completion_command(program: argparse.ArgumentParser, options: argparse.Namespace) -> int:
    """`peakmesh completion SHELL`."""
    import shtab

    _say_what_is_a_file(program)
    print(shtab.complete(program, options.shell))
    return EXIT_GOOD


def _say_what_is_a_file(parser: argparse.ArgumentParser) -> None:
    import shtab

    for action in parser._actions:
        if action.type is Path or action.metavar in FILES:
            action.complete = shtab.FILE  # type: ignore[attr-defined]
    for command in _commands(parser).values():
        _say_what_is_a_file(command)


def _commands(parser: argparse.ArgumentParser) -> dict[str, argparse.ArgumentParser]:
    """By name; none where there are none below it."""
    return {
        name: command
        for action in parser._actions
        if isinstance(action, argparse._SubParsersAction)
        for name, command in action.choices.items()
    }
