"""Parts that do not go together are refused: the place, the value, what would be right."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from problem_text import JOINED, LINK, LINKED, edited, linked, load, refusal, unstable


def test_an_unstable_plant_is_admissible_where_the_errors_do_not_contain_the_state(tmp_path: Path) -> None:
    problem = load(tmp_path, unstable(left='loss = "seen"', unbiased="unbiased = true"))
    assert abs(np.linalg.eigvals(problem.plant.A)).max() == pytest.approx(1.02)
    nothing_lost = unstable(unbiased="unbiased = true").replace("arrival_probability = 0.75", "arrival_probability = 1")
    assert not load(tmp_path, nothing_lost).carries_plant


REFUSED = [
    # names
    (edited('"left"', '"right"'), 'node "right" is there 2 times; names must differ'),
    (edited('"joined"', '"apart"'), 'topology "apart" is there 2 times; names must differ'),
    # shapes
    (edited("C = [[1.0, 0.0]]", "C = [[1.0]]"),
     'node "left": C is 1 x 1; the plant has 2 states, so C needs 2 columns'),
    (edited("D = [[0.1]]", "D = [[0.1, 0.1]]"),
     'node "left": D is 1 x 2; the plant has 1 disturbance, so D needs 1 column'),
    (edited(JOINED, "adjacency = [[1]]"), 'topology "joined": adjacency is 1 x 1; for 2 nodes it must be 2 x 2'),
    (edited(", [0.25, 0.75]]", "]"), "markov: transition is 1 x 2; for 2 topologies it must be 2 x 2"),
    # numbers
    (edited("A = [[0.5", "A = [[1.0"),
     "plant: A is unstable: its spectral radius is 1 and must be below 1, "
     "because the errors contain the state; an unstable plant needs unbiased = true, "
     'and loss = "seen" at every node that loses measurements'),
    # an unstable plant where the errors contain the state
    (unstable(left='loss = "seen"'),
     "plant: A is unstable: its spectral radius is 1.02 and must be below 1, "
     "because the errors contain the state; an unstable plant needs unbiased = true, "
     'and loss = "seen" at every node that loses measurements'),
    (unstable(unbiased="unbiased = true"),
     'plant: A is unstable, its spectral radius is 1.02, and node "left" does not know which of its measurements are '
     'lost: its errors then contain the state; give it loss = "seen"'),
    # losses that are seen, links that lose messages, unbiased gains
    (linked('receiver = "left"', 'receiver = "top"'),
     'link from "right" to "top": node "top" does not exist; the problem has nodes "left" and "right"'),
    (linked('sender = "right"', 'sender = "top"'),
     'link from "top" to "left": node "top" does not exist; the problem has nodes "left" and "right"'),
    (linked('sender = "right"', 'sender = "left"'),
     'link from "left" to "left": a node has its own numbers always; name two nodes'),
    (LINKED.replace(JOINED, "adjacency = [[1, 0], [1, 1]]"),
     'link from "right" to "left": "left" hears "right" in no topology'),
    (LINKED.replace(LINK, LINK + LINK), 'link from "right" to "left" is there twice; give it one delivery_probability'),
    # probabilities
    (edited("0.25, 0.75]", "0.25, 0.85]"), 'markov: transition, row of "joined", sums to 1.1; it must sum to 1'),
    (edited("0.25, 0.75]", "0.25, 0.750000002]"),
     'markov: transition, row of "joined", sums to 1.000000002; it must sum to 1'),
    (edited("0.25, 0.75]", "-0.25, 1.25]"),
     'markov: transition, row of "joined", holds -0.25; a probability lies in [0, 1]'),
    (edited('initial = "apart"', 'initial = "together"'),
     'markov: initial "together" is no topology; the topologies are "apart" and "joined"'),
    # topologies
    (edited(JOINED, "adjacency = [[1, 1], [1, 0]]"),
     'topology "joined": adjacency has 0 for "right" itself; a node hears itself, a_ii = 1'),
    (edited(JOINED, "adjacency = [[1, -2], [1, 1]]"),
     'topology "joined": adjacency gives "left" hearing "right" the weight -2.0; a weight is 0 or positive'),
]  # fmt: skip


@pytest.mark.parametrize(("text", "sentence"), REFUSED, ids=[sentence[:60] for _, sentence in REFUSED])
def test_what_is_wrong_is_refused_in_one_sentence(tmp_path: Path, text: str, sentence: str) -> None:
    assert refusal(tmp_path, text) == sentence


@pytest.mark.parametrize("sum_of_row", [1.0 - 0.9e-9, 1.0 + 0.9e-9])
def test_a_row_of_the_chain_may_miss_1_by_rounding(tmp_path: Path, sum_of_row: float) -> None:
    load(tmp_path, edited("[0.25, 0.75]", f"[0.25, {sum_of_row - 0.25!r}]"))
