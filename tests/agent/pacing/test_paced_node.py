"""A node against the clock, under a virtual one: what is in time counts, what is not is substituted and told."""

from __future__ import annotations

import math
from collections import Counter
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from made_recordings import observer_gains, random_gains, random_problem, real_problem, simulate
from paced_runs import PACE, SOON, PacedRun, estimates, of

from agent.contract.gains import Gains
from agent.contract.messages import ZERO_STATE

STEPS = 12
GAINS = random_gains(random_problem(5, ny=(1, 2, 1), modes=2))
REAL = observer_gains(real_problem(1, radius=1.02))


def hears(gains: Gains, k: int, run: PacedRun, node: str) -> set[str]:
    """The nodes that `node` is to hear in the mode of step k, without losses of the model."""
    problem = gains.problem
    mode = str(of(run.messages, "mode")[k]["mode"])
    i = problem.node_index(node)
    return {problem.node_names[j] for j in problem.neighbours(problem.mode_index(mode), i)}


def told(run: PacedRun) -> Counter[tuple[str, str, int, str]]:
    """(who, topic, step, kind) of every substitution that an event names."""
    return Counter(
        (sent.who.removeprefix("node-"), sent.document["about"], step, sent.document["kind"])
        for sent in run.messages
        if sent.topic == "event"
        and sent.document["kind"] in ("late", "silent", "gone", "refused")
        and "steps" in sent.document
        for step in sent.document["steps"]
    )


def substituted(gains: Gains, run: PacedRun) -> set[tuple[str, str, int]]:
    """(node, topic, step) of everything that was not there in time, by what the nodes' estimates say."""
    found = set()
    for (node, k), document in estimates(run.messages).items():
        if not document.get("measured", True) and "origin" not in document:
            found.add((node, f"node/{node}/measurement", k))
        if document["mode"]:
            heard: Any = document["heard"]
            lost = hears(gains, k - 1, run, node) - set(heard)
            found |= {(node, f"node/{j}/estimate", k - 1) for j in lost}
    return found


@pytest.mark.parametrize("gains", [GAINS, REAL], ids=["paper", "real"])
def test_what_is_in_time_gives_the_numbers_of_lock_step(gains: Gains) -> None:
    """Bit for bit the same for every node, and not a word of substitutions."""
    run = PacedRun(gains, steps=STEPS)
    expected = estimates(simulate(gains, steps=STEPS))
    found = estimates(run.messages)
    assert found.keys() == expected.keys()
    for key, document in found.items():
        assert (document["mode"], document["heard"]) == (expected[key]["mode"], expected[key]["heard"])
        np.testing.assert_allclose(document["x_hat"], expected[key]["x_hat"], rtol=1e-12, atol=1e-13)  # type: ignore[arg-type]
        assert "measured" not in document
        assert "origin" not in document
    assert told(run) == Counter()
    assert all(node.done for node in run.nodes.values())


def some_delays(seed: int, worst: float) -> dict[tuple[str, str, int], float]:
    rng = np.random.default_rng(seed)
    names = GAINS.problem.node_names
    topics = [f"node/{name}/{what}" for name in names for what in ("estimate", "measurement")]
    return {
        (name, topic, k): math.inf if draw < 0.1 else float(rng.uniform(0.0, worst))
        for name in names
        for topic in topics
        for k in range(STEPS)
        if (draw := rng.random()) < 0.5
    }


@settings(max_examples=25)
@given(st.integers(0, 10_000))
def test_every_substitution_is_told_once_and_nothing_else_is(seed: int) -> None:
    """Whatever the network does: what an estimate lacks is what the events name, late or silent as it was."""
    delays = some_delays(seed, worst=0.3)
    run = PacedRun(GAINS, steps=STEPS, delay=lambda *place: delays.get(place, SOON))
    said = told(run)
    last = STEPS - 1  # what the last step heard, no estimate tells any more
    named = {(who, topic, k) for who, topic, k, _ in said if not (topic.endswith("estimate") and k == last)}
    assert named == substituted(GAINS, run)
    assert max(said.values(), default=1) == 1
    for who, topic, k, kind in said:
        assert (kind == "silent") == (delays.get((who, topic, k), SOON) == math.inf)


def test_nothing_stops_whatever_is_lost() -> None:
    """A node that hears nobody and measures nothing makes every step, on time, from its own estimate."""
    run = PacedRun(GAINS, steps=STEPS, delay=lambda receiver, topic, step: SOON if topic == "mode" else math.inf)
    for (_, k), document in estimates(run.messages).items():
        assert document["x_hat"] == [0.0, 0.0]
        assert document["innovation"] == [0.0] * len(document["innovation"])  # type: ignore[arg-type]
        assert k < STEPS
    assert len(estimates(run.messages)) == 3 * STEPS
    assert {kind for *_, kind in told(run)} == {"silent"}


@pytest.mark.parametrize(("late", "used"), [(0.0799, True), (0.0801, False)])
def test_a_pair_counts_up_to_its_deadline(late: float, used: bool) -> None:
    """`hear_by` after the tick, to the tenth of a millisecond; by how much it was late is told."""
    i = 0
    problem = GAINS.problem
    j = next(j for j in problem.ever_heard(i) if j != i)
    node, sender = problem.node_names[i], problem.node_names[j]
    k = next(k for k in range(STEPS) if sender in hears(GAINS, k, PacedRun(GAINS, steps=STEPS), node))

    def delay(receiver: str, topic: str, step: int) -> float:
        return late if (receiver, topic, step) == (node, f"node/{sender}/estimate", k) else SOON

    run = PacedRun(GAINS, steps=STEPS, delay=delay)
    heard: Any = estimates(run.messages)[node, k + 1]["heard"]
    assert (sender in heard) == used
    events = [sent.document for sent in run.messages if sent.document.get("kind") == "late"]
    assert len(events) == (not used)
    for event in events:
        assert event["steps"] == [k]
        assert event["seconds"] == pytest.approx([late - PACE.hear_by * PACE.period], abs=1e-9)


def test_what_is_refused_is_substituted_like_what_never_came_and_told_to_be_refused() -> None:
    """Pairs and measurements: the numbers are those of a run that lost them, and each event has the reason."""
    problem = GAINS.problem
    node, other = (problem.node_names[i] for i in (next(j for j in problem.ever_heard(0) if j), 0))
    unfit = {(node, f"node/{node}/measurement", 3), *((other, f"node/{node}/estimate", k) for k in range(2, STEPS - 1))}
    run = PacedRun(GAINS, steps=STEPS, unfit=unfit)
    lost = PacedRun(GAINS, steps=STEPS, delay=lambda *place: math.inf if place in unfit else SOON)
    assert estimates(run.messages) == estimates(lost.messages)
    said, silent = told(run), told(lost)
    assert {kind for *_, kind in said} == {"refused"}
    assert {kind for *_, kind in silent} == {"silent"}
    assert {place[:3] for place in said} == {place[:3] for place in silent}
    assert (node, f"node/{node}/measurement", 3, "refused") in said


def test_a_measurement_that_comes_too_late_is_never_used() -> None:
    """The innovation is 0, the estimate says so, and the event says by how much it was late."""
    node = GAINS.problem.node_names[1]
    topic = f"node/{node}/measurement"
    run = PacedRun(GAINS, steps=STEPS, delay=lambda receiver, t, step: 0.05 if (t, step) == (topic, 4) else SOON)
    document = estimates(run.messages)[node, 4]
    assert document["innovation"] == [0.0, 0.0]
    assert document["measured"] is False
    assert told(run) == Counter({(node, topic, 4, "late"): 1})
    (event,) = [sent.document for sent in run.messages if sent.document.get("kind") == "late"]
    assert event["seconds"] == pytest.approx([0.05 - SOON - 0.04], abs=1e-9)


def test_a_tick_ends_the_step_before() -> None:
    """Ticks that come in a heap, as after a freeze, leave no time in any of their steps: no node falls behind."""
    node = GAINS.problem.node_names[0]
    run = PacedRun(GAINS, steps=STEPS, frozen={node: range(3, 7)})
    made = estimates(run.messages)
    assert {k for name, k in made if name == node} == set(range(STEPS))
    others = {key: document for key, document in made.items() if key[0] != node}
    for (name, k), document in others.items():
        if k >= 1 and node in hears(GAINS, k - 1, run, name):
            heard: Any = document["heard"]
            assert (node in heard) == (k - 1 not in range(3, 7)), (name, k)
    assert {kind for who, topic, _, kind in told(run) if who != node and node in topic} == {"late"}
    assert all(paced.done for paced in run.nodes.values())


def test_a_node_that_begins_again_takes_a_neighbours_estimate_and_says_whose() -> None:
    node = "n0"
    run = PacedRun(GAINS, steps=30, away={node: range(5, 9)})
    made = estimates(run.messages)
    assert not {k for name, k in made if name == node} & set(range(5, 9))
    again = made[node, 9]
    origin = str(again["origin"])
    neighbours = hears(GAINS, 9, run, node) - {node}
    assert (origin in neighbours) if neighbours else (origin == ZERO_STATE)
    assert again["x_hat"] == (made[origin, 9]["x_hat"] if neighbours else [0.0, 0.0])
    assert again["innovation"] == [0.0]
    assert (again["mode"], again["heard"], again["measured"]) == ("", [], False)
    assert "origin" not in made[node, 10]
    gone = {k for who, topic, k, kind in told(run) if kind == "gone" and topic == f"node/{node}/estimate"}
    assert gone <= set(range(5, 9))
    assert gone


def test_a_missed_tick_makes_a_node_begin_again() -> None:
    """Without the mode of step 4 it cannot know what it should have heard."""
    node = "n2"
    run = PacedRun(
        GAINS,
        steps=STEPS,
        delay=lambda receiver, topic, step: math.inf if (receiver, topic, step) == (node, "mode", 4) else SOON,
    )
    made = estimates(run.messages)
    assert (node, 4) not in made
    assert made[node, 5]["origin"]
    assert (node, 6) in made


def test_the_account_counts_what_happened() -> None:
    delays = some_delays(3, worst=0.3)
    run = PacedRun(GAINS, steps=STEPS, delay=lambda *place: delays.get(place, SOON))
    said = told(run)
    accounts = [sent.document for sent in run.messages if sent.topic == "account"]
    assert sorted(account["who"] for account in accounts) == ["node-n0", "node-n1", "node-n2"]
    pairs = sum(len(hears(GAINS, k, run, name)) - 1 for k in range(STEPS) for name in run.nodes)
    assert sum(account["pairs"] for account in accounts) == pairs
    for what, field in (("estimate", "pairs_substituted"), ("measurement", "measurements_substituted")):
        expected = sum(count for (_, topic, _, _), count in said.items() if topic.endswith(what))
        assert sum(account[field] for account in accounts) == expected > 0
    assert sum(account["late"] for account in accounts) == sum(n for (*_, kind), n in said.items() if kind == "late")
    assert all(0.0 <= account["to_estimate_median"] <= account["to_estimate_max"] <= 0.04 for account in accounts)
    assert all(0.0 < account["to_step_median"] <= account["to_step_p99"] <= 0.08 * 1.02 for account in accounts)


def test_an_account_is_given_now_and_then_and_at_the_end() -> None:
    """Each of all steps so far: so who comes late knows it too."""
    run = PacedRun(GAINS, steps=100)
    for name in run.nodes:
        accounts = [
            sent.document for sent in run.messages if sent.topic == "account" and sent.document["who"] == f"node-{name}"
        ]
        assert [account["step"] for account in accounts] == [29, 59, 89, 99]
        assert [account["steps"] for account in accounts] == [30, 60, 90, 100]
