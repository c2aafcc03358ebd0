"""Options that may be given as variables of the environment, too: --run as PEAKMESH_RUN. An option beats its variable.

So a unit of systemd or a service of Compose has what is the same for everybody in one place.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping
from typing import Any

ABOUT = (
    "Every option may also be given as a variable, --run as PEAKMESH_RUN (several values with spaces between, a flag "
    "as 1 or 0). An option beats its variable, and an empty one counts as not there."
)
_FLAGS = {"1": True, "true": True, "yes": True, "on": True, "0": False, "false": False, "no": False, "off": False}


class Repeated(argparse.Action):
    """Like action="append", but what is given on the command line stands in place of the default."""

    def __call__(
        self, parser: argparse.ArgumentParser, namespace: argparse.Namespace, values: Any, option: str | None = None
    ) -> None:
        before = getattr(namespace, self.dest)
        setattr(namespace, self.dest, [values] if before is self.default else [*before, values])


class _Variable(str):
    """The text of a variable; argparse converts it, as any default that is a string, where the option is not given."""

    name: str


def heed_variables(parser: argparse.ArgumentParser, environment: Mapping[str, str]) -> None:
    """Take the defaults of the options that `parser` has by now from `environment`, and say so in its help."""
    parser.epilog = ABOUT
    for action in parser._actions:
        names = [option for option in action.option_strings if option.startswith("--")]
        if not names or action.dest == "help" or action.help == argparse.SUPPRESS:
            continue
        name = f"PEAKMESH_{names[0][2:].upper().replace('-', '_')}"
        if text := environment.get(name, "").strip():
            action.required = False
            if isinstance(action, Repeated):
                action.default = text.split()
            else:
                action.default = variable = _Variable(text)
                variable.name = name
                action.type = _converting(action)


def _converting(action: argparse.Action) -> Callable[[str], object]:
    """The type of an option that knows where a text is from."""
    given, is_flag, choices = action.type, action.nargs == 0, action.choices

    def convert(text: str) -> object:
        if not isinstance(text, _Variable):
            return given(text) if callable(given) else text
        if is_flag and text.lower() not in _FLAGS:
            raise argparse.ArgumentTypeError(f"{text} is neither 1 nor 0, in the variable {text.name}")
        if choices is not None and text not in choices:
            raise argparse.ArgumentTypeError(f"{text} is none of {', '.join(choices)}, in the variable {text.name}")
        try:
            return _FLAGS[text.lower()] if is_flag else given(str(text)) if callable(given) else str(text)
        except argparse.ArgumentTypeError as error:
            raise argparse.ArgumentTypeError(f"{error}, in the variable {text.name}") from None

    return convert
