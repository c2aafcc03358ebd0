"""Every error that peakmesh raises on purpose, and the exit code each one ends a command with.

PeakmeshError
├── InputError      2  bad usage or malformed input: a file, a name, a value
├── Unattainable    1  the question was well put and the answer is no: infeasible, no certificate
└── RunBroken       3  a run or a recording broke: a time-out, a lost peer, a cut log
    ├── RecordingFailed  the recording cannot be written any more
    └── Interrupted 130, 143 or 129: stopped by SIGINT, SIGTERM, or SIGHUP

A message is one sentence that says what, where, the value, and what would be right.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from difflib import get_close_matches
from typing import Any, TypeAlias

from pydantic import ValidationError

Location: TypeAlias = "tuple[int | str, ...]"  # of a value in a document, as pydantic gives it

EXIT_GOOD = 0
EXIT_NO = 1
EXIT_INPUT = 2
EXIT_BROKEN = 3
EXIT_INTERRUPTED = 130


class PeakmeshError(Exception):
    """Base of every error that a command turns into one sentence and an exit code."""

    exit_code = EXIT_BROKEN


class InputError(PeakmeshError):
    """Bad usage or malformed input."""

    exit_code = EXIT_INPUT


class Unattainable(PeakmeshError):
    """A well-put question whose answer is no."""

    exit_code = EXIT_NO


class RunBroken(PeakmeshError):
    """A run, or the record of one, that broke."""

    exit_code = EXIT_BROKEN


class RecordingFailed(RunBroken):
    """The recording cannot be written any more; `gone`: what was written of the file is gone too."""

    def __init__(self, message: str, *, gone: bool = False) -> None:
        super().__init__(message)
        self.gone = gone


class Interrupted(RunBroken):
    """Stopped from outside by a signal."""

    def __init__(self, signal_number: int) -> None:
        super().__init__({1: "the terminal was closed", 2: "interrupted"}.get(signal_number, "terminated"))
        self.exit_code = 128 + signal_number


def listed(names: Iterable[str]) -> str:
    """Names as a person reads them: "a", "b" and "c"; of more than eight the first seven and the last."""
    quoted = [f'"{name}"' for name in names]
    if len(quoted) > 8:
        quoted = [*quoted[:7], f"... {len(quoted) - 8} more ...", quoted[-1]]
    return " and ".join([", ".join(quoted[:-1]), quoted[-1]] if len(quoted) > 1 else quoted)


def first_fault(error: ValidationError, document: Any, known: Callable[[Location], Iterable[str]] | None = None) -> str:
    """The first fault pydantic found, as one sentence that names the place by its name, not its index.

    An unknown key comes first: it is mostly the misspelling of one that is then reported as missing, or of an optional
    one; `known` tells what keys the table at a location may have.
    """
    faults = error.errors(include_url=False)
    fault = next((f for f in faults if f["type"] == "extra_forbidden"), faults[0])
    place = _place(fault["loc"], document)
    match fault["type"]:
        case "missing":
            return f'{place}"{fault["loc"][-1]}" is missing'
        case "extra_forbidden":
            absent = [str(f["loc"][-1]) for f in faults if f["type"] == "missing"]
            key = str(fault["loc"][-1])
            near = get_close_matches(key, known(fault["loc"][:-1]) if known else (), n=1)
            hint = f'; did you mean "{near[0]}"?' if near and near[0] != key else ""  # another kind has that key
            hint = f"; {listed(absent)} {'is' if len(absent) == 1 else 'are'} missing" if absent else hint
            return f"{place}this key is not known here{hint}"
        case "value_error":
            return f"{place}{fault['ctx']['error']}"
        case "union_tag_not_found":
            return f'{place}"kind" is missing'
        case "union_tag_invalid":
            known = fault["ctx"]["expected_tags"].replace("'", '"')
            return f'{place}kind "{fault["ctx"]["tag"]}" is not known; there are {known}'
        case "tuple_type" if isinstance(fault["input"], dict):
            return f"{place}must be a list; write [[{fault['loc'][0]}]], once for each entry"
        case kind:
            wanted = _WANTED.get(kind, _lower(fault["msg"])).format(**fault.get("ctx", {}))
            return f"{place}{wanted}, got {shortened(fault['input'])}"


_WANTED = {  # what pydantic asks for, as a person says it who writes TOML
    "string_type": "must be a string",
    "float_type": "must be a number",
    "int_type": "must be a whole number",
    "bool_type": "must be true or false",
    "literal_error": "must be {expected}",
    "finite_number": "must be finite",
    "greater_than": "must be greater than {gt:g}",
    "greater_than_equal": "must be at least {ge:g}",
    "model_type": "must be a table of keys and values",
    "dict_type": "must be a table of keys and values",
    "tuple_type": "must be a list",
    "list_type": "must be a list",
    "less_than": "must be less than {lt:g}",
    "less_than_equal": "must be at most {le:g}",
    "too_short": "must not be empty",
}


def _place(location: Location, document: Any) -> str:
    """'node "2": C: ' for ("node", 1, "C")."""
    words: list[str] = []
    here = document
    for step in location:
        try:
            here = here[step]
        except (KeyError, IndexError, TypeError):
            continue  # a missing key, or the tag of a union, which is no place in the document
        if isinstance(step, int):
            name = here.get("name") if isinstance(here, dict) else None
            named = isinstance(name, str) and name.isprintable()
            words[-1] += f' "{name}"' if named else f" number {step + 1}"
        else:
            words.append(str(step))
    return "".join(f"{word}: " for word in words)


def counted(number: int, noun: str) -> str:
    """ "1 entry", "2 entries"."""
    if number == 1:
        return f"1 {noun}"
    return f"{number} {noun.removesuffix('y')}ies" if noun.endswith("y") else f"{number} {noun}s"


def shortened(value: Any) -> str:
    """A value as Python writes it, in 60 characters at most."""
    try:
        text = repr(value)
    except ValueError:
        return "an integer of thousands of digits"
    return text if len(text) <= 60 else text[:57] + "..."


def _lower(message: str) -> str:
    return message[:1].lower() + message[1:]
