"""A network without one of its parts, and what each part is worth."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from networks import random_problem

from agent.contract.errors import InputError, Unattainable
from agent.contract.problem import Problem
from designer import what_if
from designer.gain.exact import exact_gain
from designer.ladder import rounded_up
from designer.model.error_model import error_model, stacked_gains
from designer.problems import find
from designer.search.descent import NEAR
from designer.search.exact_design import design_exact
from designer.search.starts import consensus_gains, least_variance_gains
from designer.synthesis import design
from designer.what_if import price, price_text, without_link, without_node


@pytest.fixture
def lossy() -> Problem:
    """The paper's second example, where two links lose messages, with a disturbance from a file."""
    document = find("zhu2020-lossy").document()
    document["link"] = [
        {"receiver": "1", "sender": "4", "delivery_probability": 0.9},
        {"receiver": "3", "sender": "1", "delivery_probability": 0.8},
    ]
    document["disturbance"] = {"kind": "csv", "file": "w.csv", "values": [[1.0], [0.5]]}
    return Problem.from_document(document)


def test_a_node_goes_with_its_links(lossy: Problem) -> None:
    """Names, adjacency and lossy links of the others stay as they were; so do chain and disturbance."""
    rest = without_node(lossy, "1")
    assert rest.name == "zhu2020-lossy-without-1"
    assert rest.node_names == ("2", "3", "4")
    assert rest.links is None  # both touched node 1
    for before, after in zip(lossy.topologies, rest.topologies, strict=True):
        np.testing.assert_array_equal(after.adjacency, before.adjacency[1:, 1:])
    assert rest.markov == lossy.markov
    assert rest.disturbance == lossy.disturbance
    assert [link.receiver for link in without_node(lossy, "4").links or ()] == ["3"]
    assert len(without_node(lossy, "2").links or ()) == 2


def test_a_link_goes_in_one_direction(lossy: Problem) -> None:
    """A:B ends what A hears from B, in every mode, and nothing else."""
    rest = without_link(lossy, "3", "1")
    assert rest.name == "zhu2020-lossy-without-3-from-1"
    for before, after in zip(lossy.topologies, rest.topologies, strict=True):
        changed = before.adjacency != after.adjacency
        changed[2, 0] = False
        assert not changed.any()
        assert after.adjacency[2, 0] == 0.0
        assert after.adjacency[0, 2] == before.adjacency[0, 2]
    assert [(link.receiver, link.sender) for link in rest.links or ()] == [("1", "4")]
    assert (without_link(lossy, "1", "2").links or ()) == lossy.links


def test_a_long_name_stays_legal() -> None:
    document = find("two-nodes").document() | {"name": "n" * 64}
    assert len(without_node(Problem.from_document(document), "left").name) == 64


def test_what_cannot_be_left_out_is_refused() -> None:
    """One sentence for each."""
    one = without_node(find("two-nodes"), "left")
    assert one.node_names == ("right",)
    for call, sentence in (
        (lambda: without_node(one, "right"), 'node "right" is the only node'),
        (lambda: without_node(one, "left"), 'node "left" does not exist; the problem has nodes "right"'),
        (lambda: without_link(find("zhu2020-lossy"), "3", "3"), "a node always hears itself"),
        (lambda: without_link(without_link(find("two-nodes"), "left", "right"), "left", "right"), "hears nobody else"),
    ):
        with pytest.raises(InputError, match=sentence):
            call()


def test_the_gains_that_are_left_fit_and_keep_their_sum() -> None:
    """Without a link the sum over j of a_ij K_ij is as it was: what multiplies x in the errors stays as small."""
    problem = random_problem(5, n=3)
    gains = design(problem, method="decomposed")
    i, j = next((i, j) for i in range(3) for j in problem.ever_heard(i) if i != j)
    rest = without_link(problem, problem.node_names[i], problem.node_names[j])
    (K_before, H_before), (K, H) = stacked_gains(gains), what_if._gains_left(gains, rest)
    sums = [bar.reshape(len(bar), 3, 2, 3, 2).sum(axis=3) for bar in (K_before, K)]
    np.testing.assert_allclose(sums[1], sums[0], atol=1e-12)
    assert not K[:, 2 * i : 2 * i + 2, 2 * j : 2 * j + 2].any()
    assert np.count_nonzero(H) < np.count_nonzero(H_before)


def test_the_price_of_parts_by_lmi() -> None:
    """Every node and every link has its row; each gamma is that of a design of its own; the dearest comes first."""
    problem = find("two-nodes")
    said: list[str] = []
    table = price(problem, method="decomposed", processes=1, report=lambda done, of, what: said.append(what))
    assert {(row.part, row.name) for row in table.rows} == {
        ("node", "left"), ("node", "right"), ("link", "left:right"), ("link", "right:left"),
    }  # fmt: skip
    assert len(said) == 5
    costs = [row.cost for row in table.rows]
    assert costs == sorted(costs, reverse=True)
    row = next(row for row in table.rows if row.name == "left")
    alone = design(without_node(problem, "left"), method="decomposed")
    assert row.gamma == pytest.approx(alone.certificate.gamma, rel=1e-6)
    assert rounded_up(row.gamma) in price_text(table)
    whole, rest = design(problem, method="decomposed"), without_link(problem, "left", "right")
    kept = next(row.kept for row in table.rows if row.name == "left:right")
    assert kept == pytest.approx(exact_gain(error_model(rest, *what_if._gains_left(whole, rest))).high, rel=1e-6)
    assert rounded_up(kept) in price_text(table)


def test_a_node_is_priced_against_what_the_others_had() -> None:
    """Before: the exact gain of the whole network's gains to the errors of the nodes that remain."""
    problem = find("two-nodes")
    whole = design_exact(problem, starts={"consensus": consensus_gains(problem, weight=0.4)})
    before = what_if._bound_for(whole, without_node(problem, "left"))
    model = error_model(problem, *stacked_gains(whole))
    gain = exact_gain(model)
    assert before < gain.high
    rest = what_if._bound_for(whole, without_node(problem, "right"))
    assert max(before, rest) ** 2 <= gain.high**2 <= (before**2 + rest**2) * (1.0 + 1e-6)
    assert what_if._bound_for(whole, without_link(problem, "left", "right")) == whole.certificate.gamma


def test_a_search_without_a_part_begins_with_the_gains_that_do_better_then() -> None:
    """Gains of a network that are near are followed from near; where they have got worse the search is a new one."""
    problem = find("zhu2020-lossy")
    least = least_variance_gains(problem)
    starts, first = what_if._begun(problem, least)
    assert (list(starts), first) == (["whole network"], NEAR)
    starts, first = what_if._begun(problem, consensus_gains(problem, weight=0.4))
    assert (list(starts), first) == (["least variance"], math.inf)
    assert all(np.array_equal(a, b) for a, b in zip(starts["least variance"], least, strict=True))


def test_without_a_part_a_search_ends_a_little_before_its_end() -> None:
    """Its gamma is at most 0.1 % above that of a whole search, though it takes fewer steps."""
    rest = without_node(find("zhu2020-lossy"), "2")
    start = least_variance_gains(rest)
    soon = what_if._design(rest, "exact", start)
    whole = design_exact(rest, starts={"least variance": start})
    assert soon.certificate.gamma <= 1.001 * whole.certificate.gamma
    assert soon.solver.iterations < 0.8 * whole.solver.iterations


def test_no_certificate_without_a_part_is_an_answer(monkeypatch: pytest.MonkeyPatch) -> None:
    """ "no bound" with the reason, and dearer than everything else."""
    made = what_if._design

    def sometimes(problem: Problem, method: str, *start: Any) -> Any:
        if problem.node_names == ("right",):
            raise Unattainable("nobody measures it")
        return made(problem, method, *start)

    monkeypatch.setattr(what_if, "_design", sometimes)
    table = price(find("two-nodes"), method="decomposed", processes=1)
    assert (table.rows[0].name, table.rows[0].gamma, table.rows[0].reason) == ("left", None, "nobody measures it")
    assert table.document()["rows"][0]["cost"] is None
    assert "no bound" in price_text(table)
    assert "nobody measures it" in price_text(table)


def test_a_single_node_has_nothing_to_leave_out() -> None:
    table = price(without_node(find("two-nodes"), "left"), method="decomposed")
    assert table.rows == []
    assert "nothing can be left out" in price_text(table)
