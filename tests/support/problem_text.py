"""A problem file as text, and ways to spoil it."""

from __future__ import annotations

from pathlib import Path

import pytest

from agent.contract.errors import InputError
from agent.contract.problem import Problem

TEXT = """
name = "pair"
[plant]
A = [[0.5, 0.1], [0.0, -0.5]]
B = [[1.0], [0.5]]
M = [[1.0, 0.0]]
[[node]]
name = "left"
C = [[1.0, 0.0]]
D = [[0.1]]
arrival_probability = 0.75
[[node]]
name = "right"
C = [[0.0, 1.0], [1.0, 1.0]]
D = [[0.2], [0.3]]
arrival_probability = 1
[[topology]]
name = "apart"
adjacency = [[1, 0], [0, 1]]
[[topology]]
name = "joined"
adjacency = [[1, 1], [1, 1]]
[markov]
transition = [[0.9, 0.1], [0.25, 0.75]]
initial = "apart"
[disturbance]
kind = "damped-sine"
decay = 0.2
"""
SINE = 'kind = "damped-sine"\ndecay = 0.2'
CSV = 'kind = "csv"\nfile = "w.csv"'
JOINED = "adjacency = [[1, 1], [1, 1]]"
HUGE = "1" + "0" * 400
LINK = """[[link]]
receiver = "left"
sender = "right"
delivery_probability = 0.9
"""
LINKED = TEXT.replace("[markov]", LINK + "[markov]")
UNSTABLE = TEXT.replace("A = [[0.5", "A = [[-1.02")


def load(folder: Path, text: str | bytes) -> Problem:
    path = folder / "problem.toml"
    path.write_bytes(text.encode() if isinstance(text, str) else text)
    return Problem.load(path)


def edited(old: str, new: str) -> str:
    assert TEXT.count(old) == 1, old
    return TEXT.replace(old, new)


def linked(old: str, new: str) -> str:
    """LINKED with the one link edited."""
    assert LINK.count(old) == 1, old
    return LINKED.replace(LINK, LINK.replace(old, new))


def unstable(*, left: str = "", unbiased: str = "") -> str:
    """UNSTABLE, with a word on the losses of the left node, and one on the gains."""
    text = UNSTABLE.replace('name = "left"\n', f'name = "left"\n{left}\n')
    return text.replace('name = "pair"\n', f'name = "pair"\n{unbiased}\n')


def refusal(folder: Path, text: str | bytes) -> str:
    """The sentence, without the file's name that begins it."""
    with pytest.raises(InputError) as caught:
        load(folder, text)
    sentence = str(caught.value)
    assert "\n" not in sentence
    assert sentence.startswith(str(folder / "problem.toml"))
    return sentence.removeprefix(str(folder / "problem.toml")).removeprefix(": ").replace(str(folder), "FOLDER")
