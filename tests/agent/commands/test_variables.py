"""Options of the role commands as variables of the environment."""

from __future__ import annotations

import argparse

import pytest

from agent.commands.roles import add_roles

ROLES = ("node", "plant", "coordinator", "recorder", "live", "router")


def parse(*words: str, **environment: str) -> argparse.Namespace:
    """The options of a role with variables of these names."""
    parser = argparse.ArgumentParser()
    add_roles(parser.add_subparsers(dest="command"), {f"PEAKMESH_{name}": text for name, text in environment.items()})
    return parser.parse_args(words)


VALUES = {  # of the options whose value is neither a name nor a number of seconds
    "node": "n7", "run": "r", "listen": "none", "host": "::1", "output": "x", "on_record_failure": "continue",
    "keep": "5MB",
    "split_size": "5MB", "split_duration": "2s", "period": "2s", "steps": "7", "seed": "7", "window": "7", "port": "7",
}  # fmt: skip


@pytest.mark.parametrize("role", ROLES)
def test_every_option_has_a_variable(role: str) -> None:
    """Of those that the help shows; each one's variable changes what the option is."""
    parser = argparse.ArgumentParser()
    commands = parser.add_subparsers(dest="command")
    add_roles(commands, {})
    words = [role, *(["gains.json"] if role != "router" else []), *(["--node", "n1"] if role == "node" else [])]
    options = [action for action in commands.choices[role]._actions if action.option_strings]
    shown = [action for action in options if action.dest != "help" and action.help != argparse.SUPPRESS]
    assert len(shown) > 1
    for action in shown:
        name = action.option_strings[-1].removeprefix("--").replace("-", "_").upper()
        text = "1" if action.nargs == 0 else VALUES.get(action.dest, "0.25")
        with_it = parse(*(words[:2] if action.dest == "node" else words), **{name: text})
        assert getattr(with_it, action.dest) != getattr(parse(*words), action.dest), name


def test_an_option_beats_its_variable() -> None:
    given = parse(
        "node", "g", "--run", "b", "--connect", "c", "--node", "2", RUN="a", CONNECT="x y", NODE="1", WAIT="3"
    )
    assert (given.run, given.connect, given.node, given.wait) == ("b", ["c"], "2", 3.0)


def test_several_values_stand_with_spaces_between() -> None:
    assert parse("plant", "g", CONNECT="tcp/a:1  tcp/b:2").connect == ["tcp/a:1", "tcp/b:2"]
    assert parse("plant", "g", "--connect", "tcp/c:1", "--connect", "tcp/d:1", CONNECT="tcp/a:1").connect == [
        "tcp/c:1", "tcp/d:1",
    ]  # fmt: skip


def test_an_empty_variable_counts_as_not_there() -> None:
    given = parse("plant", "g", LISTEN="", CONNECT=" ")
    assert (given.listen, given.connect) == (None, [])


@pytest.mark.parametrize(("text", "value"), [("1", True), ("yes", True), ("0", False), ("off", False)])
def test_a_flag_is_1_or_0(text: str, value: bool) -> None:
    assert parse("recorder", "g", FORCE=text).force is value


@pytest.mark.parametrize(
    ("role", "name", "text", "why"),
    [
        (
            "coordinator",
            "STEPS",
            "many",
            "many is not a whole number from 1 to 2147483647, in the variable PEAKMESH_S",
        ),
        ("recorder", "FORCE", "perhaps", "perhaps is neither 1 nor 0, in the variable PEAKMESH_FORCE"),
        ("recorder", "ON_RECORD_FAILURE", "hope", "hope is none of stop, continue, in the variable"),
        ("plant", "RUN", "a b", "'a b' is not a legal name"),
    ],
)
def test_what_a_variable_cannot_be_is_refused_with_its_name(
    role: str, name: str, text: str, why: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        parse(role, "g", **{name: text})
    assert ended.value.code == 2
    assert why in capsys.readouterr().err


def test_a_variable_of_another_role_does_no_harm() -> None:
    assert parse("plant", "g", STEPS="many", NODE="7").command == "plant"


def test_a_node_needs_its_name_from_somewhere(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        parse("node", "g")
    assert "--node" in capsys.readouterr().err
    assert parse("node", "g", NODE="7").node == "7"


def test_the_help_says_so() -> None:
    parser = argparse.ArgumentParser()
    commands = parser.add_subparsers()
    add_roles(commands, {})
    for role in ROLES:
        assert "--run as PEAKMESH_RUN" in " ".join(commands.choices[role].format_help().split())
