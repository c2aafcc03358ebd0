"""A problem file is read exactly; equal problems have equal digests, and no others."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from made_recordings import random_problem
from problem_text import LINKED, SINE, TEXT, edited, linked, load

from agent.contract.errors import InputError
from agent.contract.problem import Problem


# what is read
def test_a_file_is_read_as_it_stands(tmp_path: Path) -> None:
    problem = load(tmp_path, TEXT)
    assert (problem.n, problem.nx, problem.nw, problem.nz) == (2, 2, 1, 1)
    assert problem.node_names == ("left", "right")
    assert problem.mode_names == ("apart", "joined")
    assert problem.plant.A.tolist() == [[0.5, 0.1], [0.0, -0.5]]
    assert problem.beta.tolist() == [0.75, 1.0]
    assert problem.nodes[1].C.shape == (2, 2)
    assert problem.neighbours(0, 1) == (1,)
    assert problem.neighbours(1, 1) == (0, 1)
    assert problem.ever_heard(0) == (0, 1)


def test_arrays_cannot_be_written_to(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="read-only"):
        load(tmp_path, TEXT).plant.A[0, 0] = 1.0


def test_without_disturbance_there_is_none(tmp_path: Path) -> None:
    said = load(tmp_path, edited(SINE, 'kind = "none"'))
    assert load(tmp_path, edited("[disturbance]\n" + SINE, "")) == said


def test_names_that_do_not_exist_are_refused_with_those_that_do() -> None:
    problem = random_problem(1, ny=(1, 1), modes=1)
    with pytest.raises(InputError, match=r'^node "x" does not exist; the problem has nodes "n0" and "n1"$'):
        problem.node_index("x")
    with pytest.raises(InputError, match=r'^mode "x" does not exist; the problem has modes "mode-0"$'):
        problem.mode_index("x")


# what real networks have
def test_seen_losses_links_and_unbiased_gains_are_read(tmp_path: Path) -> None:
    text = LINKED.replace('name = "left"\n', 'name = "left"\nloss = "seen"\n')
    problem = load(tmp_path, text.replace("[plant]", "unbiased = true\n[plant]"))
    assert [node.seen for node in problem.nodes] == [True, False]
    assert problem.delivery.tolist() == [[1.0, 0.9], [1.0, 1.0]]  # row i for what node i gets
    assert problem.unbiased is True
    assert not problem.carries_plant  # the other node loses nothing
    assert Problem.from_document(problem.document()) == problem
    assert load(tmp_path, text).carries_plant
    assert load(tmp_path, edited('name = "pair"', 'name = "pair"\nunbiased = true')).carries_plant


def test_a_delivery_probability_of_1_loses_nothing(tmp_path: Path) -> None:
    problem = load(tmp_path, linked("0.9", "1"))
    assert problem.delivery.tolist() == [[1.0, 1.0], [1.0, 1.0]]


# exactness
finite = st.floats(allow_nan=False, allow_infinity=False)
edges = st.sampled_from([-0.0, 0.0, 5e-324, 2.2250738585072014e-308, 1e308, -1.7976931348623157e308, 0.1, 1 / 3])


@given(st.lists(finite | edges, min_size=6, max_size=6))
def test_every_float_survives_the_file_bit_for_bit(numbers: list[float]) -> None:
    """B, C and D take any finite number, so they carry the test."""
    document = random_problem(1, ny=(1,), modes=1).document()
    document["plant"]["B"] = [numbers[:2], numbers[2:4]]
    document["node"][0]["C"] = [numbers[4:]]
    problem = Problem.from_document(document)
    again = Problem.from_document(problem.document())
    assert again.canonical() == problem.canonical()
    read = [*again.plant.B.ravel(), *again.nodes[0].C.ravel()]
    assert struct.pack("6d", *read) == struct.pack("6d", *numbers)


@given(st.integers(0, 50))
def test_documents_give_back_the_same_problem(seed: int) -> None:
    problem = random_problem(seed, ny=(2, 1), modes=2, nw=3, nz=2)
    again = Problem.from_document(problem.document())
    assert again == problem
    assert hash(again) == hash(problem)
    assert again.digest() == problem.digest()


# the digest
def test_the_digest_does_not_depend_on_the_order_in_the_file(tmp_path: Path) -> None:
    head, _, tail = TEXT.partition("[plant]\n")
    plant, _, rest = tail.partition("[[node]]")
    A, B, M = plant.splitlines()
    moved = "\n".join([head, "[[node]]" + rest, "[plant]", M, B, A])
    assert load(tmp_path, moved).digest() == load(tmp_path, TEXT).digest()


def test_the_digest_does_not_depend_on_how_a_number_is_written(tmp_path: Path) -> None:
    assert load(tmp_path, edited("0.75\n", "7.5e-1\n")).digest() == load(tmp_path, TEXT).digest()


def test_the_digest_does_not_depend_on_saying_what_goes_without_saying(tmp_path: Path) -> None:
    """Losses are hidden and gains not imposed to be unbiased unless a file says otherwise."""
    said = edited('name = "left"', 'name = "left"\nloss = "hidden"').replace("[plant]", "unbiased = false\n[plant]")
    assert load(tmp_path, said).digest() == load(tmp_path, TEXT).digest()
    others = {load(tmp_path, text).digest() for text in (
        TEXT,
        edited('name = "left"', 'name = "left"\nloss = "seen"'),
        edited('name = "pair"', 'name = "pair"\nunbiased = true'),
        LINKED,
        linked("0.9", "0.8"),
    )}  # fmt: skip
    assert len(others) == 5


def leaves(value: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    if isinstance(value, dict):
        return [leaf for key, inner in value.items() for leaf in leaves(inner, (*path, key))]
    if isinstance(value, list | tuple):
        return [leaf for key, inner in enumerate(value) for leaf in leaves(inner, (*path, key))]
    return [path]


def test_the_digest_changes_with_every_value() -> None:
    """Each name in turn, and the last bit of each number."""
    before = random_problem(4, ny=(1, 2), modes=2)
    text = before.canonical()
    digests, paths = {before.digest()}, leaves(before.document())
    for path in paths:
        document: Any = json.loads(text)
        inner = document
        for key in path[:-1]:
            inner = inner[key]
        if path == ("disturbance", "kind"):
            document["disturbance"] = {"kind": "none"}
        elif path == ("markov", "initial"):
            inner["initial"] = "mode-0"
        elif isinstance(inner[path[-1]], str):
            inner[path[-1]] += "-x"
            if path[0] == "topology" and document["markov"]["initial"] == inner[path[-1]][:-2]:
                document["markov"]["initial"] += "-x"
        else:
            inner[path[-1]] = float(np.nextafter(inner[path[-1]], 0.5))
        digests.add(Problem.from_document(document).digest())
    assert len(digests) == len(paths) + 1
