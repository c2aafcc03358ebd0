"""What is seen of a run is what its messages say, and no more."""

from __future__ import annotations

import io
import json
from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from made_recordings import Sent
from paced_runs import PACE, PacedRun, estimates, of
from places import ROOT
from rich.console import Console

from agent.contract import keys
from agent.contract.gains import Gains
from agent.contract.messages import Control, Message
from designer.watch import scene as module
from designer.watch.lines import lines
from designer.watch.scene import Scene, Seen
from designer.watch.table import table

GAINS = Gains.load(ROOT / "recordings" / "golden" / "zhu2020-lossy.gains.json")
NAMES = GAINS.problem.node_names
STEPS, SEED, SOON = 40, 2, 0.003
START = Control(
    order="start", steps=STEPS, seed=SEED, window=32, external=[], reason="",
    period=PACE.period, measure_by=0.4, hear_by=0.8,
)  # fmt: skip
EVERYBODY = keys.participants(GAINS.problem)


def read(sent: Sent) -> Message:
    model = keys.model_of(sent.topic)
    assert model is not None
    return model(**sent.document)


def heard(messages: Iterable[Sent], *, facts: bool = True, scene: Scene | None = None) -> Scene:
    """A scene that has heard these messages: ticks on time, all else SOON after the tick of its step."""
    scene = scene or Scene("a-run")
    if facts:
        scene.learn(START, GAINS)
    scene.present(EVERYBODY)
    for sent in messages:
        at = sent.document["step"] * PACE.period + (0.0 if sent.topic == "mode" else SOON)
        scene.hear(sent.topic, read(sent), at)
        scene.settle(at)
    return scene


@pytest.fixture(scope="module")
def faulty() -> list[Sent]:
    """Node 1 is away for some steps, and node 3 hears node 1 late for some more."""

    def delay(receiver: str, topic: str, step: int) -> float:
        return 0.09 if (receiver, topic) == ("3", "node/1/estimate") and 20 <= step < 30 else SOON

    return PacedRun(GAINS, steps=STEPS, seed=SEED, away={"1": range(8, 14)}, delay=delay).messages


def test_a_node_is_as_it_has_told_last(faulty: list[Sent]) -> None:
    seen, made, z = heard(faulty).seen(), estimates(faulty), of(faulty, "plant/state")
    assert [node.name for node in seen.nodes] == list(NAMES)
    for node in seen.nodes:
        document: Any = made[node.name, STEPS - 1]
        assert (node.step, node.heard, node.measured) == (STEPS - 1, document["heard"], document.get("measured", True))
        assert node.innovation == pytest.approx(float(np.linalg.norm(document["innovation"])))
        errors = {k: abs(z[k]["z"][0] - made[node.name, k]["z_hat"][0]) for k in range(STEPS) if (node.name, k) in made}  # type: ignore[index]
        assert (node.error, node.error_step) == (pytest.approx(errors[STEPS - 1]), STEPS - 1)
        assert node.largest_error == pytest.approx(max(errors.values()))
        assert node.delay == pytest.approx(SOON)
    assert [node.origin != "" for node in seen.nodes] == [True, False, False, False]
    assert (seen.step, seen.mode) == (STEPS - 1, of(faulty, "mode")[STEPS - 1]["mode"])
    assert (seen.problem, seen.seed, seen.period, seen.steps, seen.watched_since) == (
        "zhu2020-lossy", SEED, PACE.period, STEPS, 0,
    )  # fmt: skip


def test_substitutions_are_counted_as_the_nodes_count_them(faulty: list[Sent]) -> None:
    """But for the last step, of which no estimate tells, and for what a process has counted that is away since."""
    seen = heard(faulty).seen()
    accounts: dict[str, Any] = {}
    for sent in faulty:
        if sent.topic == "account":
            accounts[sent.document["who"].partition("-")[2]] = sent.document
    for node in seen.nodes:
        if node.name != "1":
            account = accounts[node.name]
            assert 0 <= account["pairs_substituted"] - node.pairs_substituted <= 1
            assert account["measurements_substituted"] == node.measurements_substituted
            assert node.to_step_max == account["to_step_max"]
    assert seen.pairs_substituted == sum(node.pairs_substituted for node in seen.nodes) > 0
    reasons = {"late": 0, "gone": 0}
    for sent in faulty:
        if sent.topic == "event" and sent.document["kind"] in reasons:
            reasons[sent.document["kind"]] += len(sent.document.get("steps", []))
    assert seen.reasons == {kind: count for kind, count in reasons.items() if count}


def test_events_are_told_in_order_and_the_ledgers_turns_among_them(faulty: list[Sent]) -> None:
    seen = heard(faulty).seen()
    assert [told.number for told in seen.events] == list(range(len(seen.events)))
    said = [(sent.document["kind"], sent.document["step"]) for sent in faulty if sent.topic == "event"]
    assert [(told.kind, told.step) for told in seen.events if told.kind != "ledger"] == said
    assert seen.events[-1].kind == "end"
    turns = [told.text for told in seen.events if told.kind == "ledger"]
    assert turns[0] == "valid"
    assert any(text.startswith("valid plus") for text in turns)


def test_who_has_come_and_gone(faulty: list[Sent]) -> None:
    scene = heard(faulty[:200])
    scene.present(set(EVERYBODY) - {"node-2", "recorder"})
    seen = scene.seen()
    assert [node.there for node in seen.nodes] == [True, False, True, True]
    assert seen.gone == ["node-2", "recorder"]
    scene.present(EVERYBODY)
    assert scene.seen().gone == []


def test_a_run_is_over_when_its_coordinator_says_so_and_goes_or_everybody_has_left(faulty: list[Sent]) -> None:
    scene = heard(faulty[:200])
    assert not scene.is_over()
    scene.present(set(EVERYBODY) - {"coordinator"})  # it may come back
    assert not scene.is_over()
    scene.present([])
    assert scene.is_over()
    assert scene.seen().ended == "everybody has left"
    scene = heard(faulty)
    assert not scene.is_over()  # there is still something to see
    scene.present(set(EVERYBODY) - {"coordinator"})
    assert scene.is_over()


def test_without_facts_nobody_knows_whom_a_node_was_to_hear(faulty: list[Sent]) -> None:
    scene = heard(faulty, facts=False)
    seen = scene.seen()
    assert not scene.is_complete
    assert (seen.ledger, seen.period, seen.seed, seen.steps) == (None, None, None, None)
    assert {node.not_heard for node in seen.nodes} == {None}  # type: ignore[type-var]
    assert all(node.error is not None and node.delay is None for node in seen.nodes)
    assert heard(faulty).is_complete


def test_gains_of_which_gamma_is_not_proved_have_no_ledger(faulty: list[Sent]) -> None:
    scene = Scene("a-run")
    scene.learn(START, GAINS, unproved="(17) fails")
    heard(faulty, facts=False, scene=scene)
    assert scene.seen().ledger == {"status": "none", "text": "none: (17) fails"}
    assert scene.is_complete


def test_what_was_not_heard_is_named(faulty: list[Sent]) -> None:
    until = next(i for i, sent in enumerate(faulty) if sent.topic == "event" and sent.document["kind"] == "gone")
    made = {}
    for sent in faulty[: until + 100]:
        scene = heard([sent], facts=not made, scene=made.get("scene"))
        made["scene"] = scene
        for node in scene.seen().nodes:
            document: Any = sent.document
            if sent.topic == f"node/{node.name}/estimate" and document["step"] > 0 and "origin" not in document:
                mode = GAINS.problem.mode_index(document["mode"])
                hears = [NAMES[j] for j in GAINS.problem.neighbours(mode, NAMES.index(node.name))]
                assert node.not_heard == [name for name in hears if name not in document["heard"]]


@pytest.mark.parametrize(
    ("topic", "change"),
    [
        ("node/5/estimate", {}),
        ("node/2/estimate", {"step": STEPS}),
        ("mode", {"step": 2**40}),
        ("account", {"who": "node-5"}),
    ],
)
def test_what_is_not_of_the_run_is_not_believed(faulty: list[Sent], topic: str, change: dict[str, Any]) -> None:
    """No node is there that the problem does not have, and no step beyond the last; so what is kept is bounded."""
    like = next(sent for sent in faulty if sent.topic == topic.replace("5", "1"))
    scene = heard(faulty[:200])
    before = scene.seen().document()
    heard([like._replace(topic=topic, document=like.document | change)], facts=False, scene=scene)
    after = scene.seen().document()
    assert after["unreadable"] == 1
    rates = {"unreadable", "steps_per_second", "messages_per_second"}
    assert {key: value for key, value in after.items() if key not in rates} == {
        key: value for key, value in before.items() if key not in rates
    }


def test_rates_are_over_the_last_seconds() -> None:
    scene = heard(PacedRun(GAINS, steps=STEPS, seed=SEED).messages)
    seen = scene.seen()
    assert seen.steps_per_second == pytest.approx(1.0 / PACE.period, rel=0.1)
    assert seen.messages_per_second == pytest.approx((2 + 2 * len(NAMES)) / PACE.period, rel=0.2)
    scene.settle(1000.0)
    scene.settle(1001.0)
    assert scene.seen().steps_per_second == 0.0


def test_in_lock_step_there_is_no_delay() -> None:
    scene = Scene("a-run")
    scene.learn(START.model_copy(update={"period": 0.0}), GAINS)
    heard(PacedRun(GAINS, steps=STEPS, seed=SEED).messages, facts=False, scene=scene)
    assert {node.delay for node in scene.seen().nodes} == {None}
    assert scene.seen().ledger is not None


def test_what_is_kept_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    """Also where the plant, or the nodes, have nothing heard of them here."""
    monkeypatch.setattr(module, "MEMORY", 10)
    messages = PacedRun(GAINS, steps=STEPS, seed=SEED).messages
    for without in ("plant/state", "estimate", "mode"):
        scene = heard(sent for sent in messages if not sent.topic.endswith(without))
        kept = len(scene._z), len(scene._modes), len(scene._z_hat) / len(NAMES)
        assert max(kept) <= 11


def drawn(seen: Seen, *, width: int = 150) -> str:
    console = Console(width=width, record=True, file=io.StringIO())
    console.print(table(seen))
    return console.export_text()


def test_the_table_has_it_all(faulty: list[Sent]) -> None:
    """A node that is gone, one that was not heard, the ledger, and the last events."""
    scene = heard(sent for sent in faulty if sent.document["step"] < 11)
    scene.present(set(EVERYBODY) - {"node-1"})
    text = drawn(scene.seen())
    assert "run a-run   paced, 100 ms   seed 2" in text
    assert "step 10 of 40, mode" in text
    rows = {line.split()[0]: line for line in text.splitlines() if line[:1] in NAMES}
    assert "gone at 7" in rows["1"]
    assert any("not 1" in row for row in rows.values())
    assert "ledger at step 6: valid" in text
    assert "gone: node-1" in text
    assert "node 1" not in rows["2"]


def test_of_many_that_were_heard_there_is_the_number(faulty: list[Sent]) -> None:
    seen = heard(faulty[:200]).seen()
    seen.nodes[0].heard, seen.nodes[0].not_heard = [f"n{i}" for i in range(10)], ["n11"]
    assert "10 nodes not n11" in drawn(seen)


def test_of_more_nodes_than_a_terminal_has_lines_those_in_trouble_come_first(faulty: list[Sent]) -> None:
    seen = heard(faulty[:20]).seen()
    seen.nodes = [replace(seen.nodes[1], name=f"n{i}", there=i != 70) for i in range(80)]
    console = Console(width=120, height=40, record=True, file=io.StringIO(), force_terminal=True)
    console.print(table(seen))
    text = console.export_text()
    rows = [line.split()[0] for line in text.splitlines() if line.startswith("n") and line[1].isdigit()]
    assert rows == ["n70", *(f"n{i}" for i in range(21))]
    assert "and 58 more" in text


@pytest.mark.parametrize("width", [40, 80, 200])
def test_the_table_is_no_wider_than_the_terminal(faulty: list[Sent], width: int) -> None:
    assert max(map(len, drawn(heard(faulty).seen(), width=width).splitlines())) <= width


def test_the_table_of_nothing_can_be_drawn() -> None:
    assert "ledger not known yet" in drawn(Scene("a-run").seen())
    assert list(lines(Scene("a-run").seen()))


def test_lines_tell_each_event_once(faulty: list[Sent]) -> None:
    seen = heard(faulty).seen()
    *events, line = lines(seen, after=1)
    assert len(events) == len(seen.events) - 2
    assert line.startswith("step 39 of 40, mode")
    assert "4 of 4 nodes" in line
    assert [*lines(seen, after=seen.events[-1].number)] == [line]


def test_a_state_is_plain_json(faulty: list[Sent]) -> None:
    document = json.loads(json.dumps(heard(faulty).seen().document(), allow_nan=False))
    assert document["nodes"][0]["name"] == "1"
    assert document["ledger"]["status"] == "valid"
