"""Replay of paced runs: what really acted is reproduced exactly, whatever was late or away. With mutants."""

from __future__ import annotations

import copy
import math
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from made_recordings import (
    Sent,
    observer_gains,
    random_gains,
    random_problem,
    real_problem,
    record,
    simulate,
    whole_run,
)
from paced_runs import PACE, SOON, PacedRun

from agent.contract.gains import Gains
from agent.contract.messages import ZERO_STATE
from designer.replay import replay
from designer.replay.coupling import Coupling
from designer.replay.verdict import Verdict

STEPS = 60
AWAY = range(30, 37)
HIDDEN = random_gains(random_problem(3))
REAL = observer_gains(real_problem(1, radius=1.02))
SEEN = observer_gains(real_problem(2, links=False))


class Weather:
    """Delays that are drawn once: 5 % of all messages are lost, 15 % take up to two periods; ticks come through."""

    def __init__(self, seed: int) -> None:
        self._rng = np.random.default_rng(seed)
        self._drawn: dict[tuple[str, str, int], float] = {}

    def __call__(self, receiver: str, topic: str, step: int) -> float:
        if topic == "mode":
            return SOON
        place = receiver, topic, step
        if place not in self._drawn:
            draw = self._rng.random()
            late = float(self._rng.uniform(0.0, 2.0 * PACE.period)) if draw < 0.2 else SOON
            self._drawn[place] = math.inf if draw < 0.05 else late
        return self._drawn[place]


FAULTS: dict[str, dict[str, Any]] = {
    "late": {},
    "node away": {"away": {"n1": AWAY}},
    "node gone": {"away": {"n1": range(30, STEPS)}},
    "plant away": {"away": {"plant": AWAY}},
    "both away": {"away": {"plant": AWAY, "n2": range(34, 50)}},
    "frozen": {"frozen": {"n0": AWAY}},
}


def faulty(gains: Gains, seed: int = 1, **faults: Any) -> list[Sent]:
    return PacedRun(gains, steps=STEPS, seed=seed, delay=Weather(seed), **faults).messages


TRUE = faulty(HIDDEN, **FAULTS["node away"])


def verdict_of(folder: Path, sent: list[Sent], gains: Gains = HIDDEN, **facts: Any) -> Verdict:
    return replay(record(folder / "run.mcap", gains, sent, steps=STEPS, **{"period": "0.1", **facts}))


def document_of(topic: str, step: int, sent: list[Sent] = TRUE) -> dict[str, Any]:
    return next(m.document for m in sent if m.topic == topic and m.document["step"] == step)


def changed(topic: str, step: int, mutate: Callable[[dict[str, Any]], None]) -> list[Sent]:
    """TRUE with one payload changed."""
    at = next(i for i, m in enumerate(TRUE) if m.topic == topic and m.document["step"] == step)
    return with_document(at, mutate)


def with_document(at: int, mutate: Callable[[dict[str, Any]], None]) -> list[Sent]:
    document = copy.deepcopy(TRUE[at].document)
    mutate(document)
    assert document != TRUE[at].document
    return [*TRUE[:at], TRUE[at]._replace(document=document), *TRUE[at + 1 :]]


def without(topic: str, step: int) -> list[Sent]:
    return [m for m in TRUE if not (m.topic == topic and m.document["step"] == step)]


def reason(topic_ends: str, *, before: int = AWAY.start - 25) -> tuple[int, str, str, int]:
    """Where an event stands, who says it, about what, and of which early step, far from anybody's absence."""
    for at, sent in enumerate(TRUE):
        if sent.document.get("kind") in ("late", "silent") and sent.document["about"].endswith(topic_ends):
            for step in sent.document["steps"]:
                if step < before:
                    return at, sent.who.removeprefix("node-"), sent.document["about"], step
    raise AssertionError("the run has no such substitution")


def assert_found(verdict: Verdict, *, step: int, node: str | None, field: str, proof: int) -> None:
    first = verdict.first_divergence
    assert verdict.exit_code == 1, verdict.text()
    assert first is not None
    assert (first.step, first.node, first.field, first.proof) == (step, node, field, proof)
    assert first.gap > verdict.tolerance


# what is true is believed
@pytest.mark.parametrize("fault", FAULTS)
@pytest.mark.parametrize("gains", [HIDDEN, REAL, SEEN], ids=["hidden", "real", "seen"])
def test_a_faulty_run_is_reproduced_exactly(tmp_path: Path, gains: Gains, fault: str) -> None:
    sent = faulty(gains, **FAULTS[fault])
    verdict = verdict_of(tmp_path, sent, gains)
    assert verdict.exit_code == 0, verdict.text()
    assert all(proof.holds and proof.compared for proof in verdict.proofs)
    pacing = verdict.pacing
    assert pacing is not None
    assert pacing.pairs_substituted > 0.02 * pacing.pairs
    assert pacing.measurements_substituted > 0
    assert bool(pacing.beginnings) == (fault in ("node away", "both away"))
    assert bool(pacing.pairs_lost) == bool(gains.problem.links)


def test_what_nodes_refused_explains_what_they_did_without(tmp_path: Path) -> None:
    problem = HIDDEN.problem
    first, second = (problem.node_names[i] for i in (next(j for j in problem.ever_heard(0) if j), 0))
    unfit = {(first, f"node/{first}/measurement", 5), *((second, f"node/{first}/estimate", k) for k in range(4, 40))}
    sent = PacedRun(HIDDEN, steps=STEPS, unfit=unfit).messages
    verdict = verdict_of(tmp_path, sent)
    assert verdict.exit_code == 0, verdict.text()
    assert verdict.pacing is not None
    assert set(verdict.pacing.reasons) == {"refused"}
    assert verdict.pacing.reasons["refused"] == verdict.pacing.pairs_substituted + 1 > 1
    untold = [message for message in sent if message.document.get("kind") != "refused"]
    (tmp_path / "untold").mkdir()
    assert verdict_of(tmp_path / "untold", untold).exit_code != 0


def test_a_run_without_faults_has_none(tmp_path: Path) -> None:
    verdict = verdict_of(tmp_path, PacedRun(HIDDEN, steps=STEPS).messages)
    assert verdict.exit_code == 0, verdict.text()
    assert verdict.pacing is not None
    assert (verdict.pacing.pairs_substituted, verdict.pacing.measurements_substituted, verdict.pacing.reasons) == (
        0,
        0,
        {},
    )
    assert "0 of " in verdict.text()


def test_a_node_may_begin_with_what_another_has_just_begun_with(tmp_path: Path) -> None:
    """Both have missed a tick; the one begins with 0, the other, which hears it in time, with that."""
    problem = HIDDEN.problem
    two = next(
        (problem.node_names[i], problem.node_names[j])
        for i in range(problem.n)
        for j in problem.ever_heard(i)
        if i != j
    )

    def delay(receiver: str, topic: str, step: int) -> float:
        if topic == "mode" and receiver in two and step % 5 == 4:
            return math.inf
        return SOON + (0.5 * PACE.period if topic == "mode" and receiver == two[0] and not step % 5 else 0.0)

    sent = PacedRun(HIDDEN, steps=STEPS, delay=delay).messages
    begun = {(m.who, m.document["step"]): m.document["origin"] for m in sent if m.document.get("origin")}
    assert any(origin == two[1] and (f"node-{two[1]}", step) in begun for (_, step), origin in begun.items())
    verdict = verdict_of(tmp_path, sent)
    assert verdict.exit_code == 0, verdict.text()


@pytest.mark.parametrize("gains", [HIDDEN, REAL, SEEN], ids=["hidden", "real", "seen"])
def test_rounding_is_measured_where_nothing_of_the_plant_came(tmp_path: Path, gains: Gains) -> None:
    """By what the nodes made of what they had: the plant has told them, and the recorder was not there."""
    sent = [m for m in faulty(gains, **FAULTS["late"]) if m.who != "plant"]
    verdict = verdict_of(tmp_path, sent, gains)
    assert verdict.first_divergence is None, verdict.text()


def test_a_recording_without_a_step_is_no_error(tmp_path: Path) -> None:
    verdict = verdict_of(tmp_path, [m for m in TRUE if m.topic == "event"][:1])
    assert verdict.exit_code == 3
    assert verdict.first_divergence is None


@pytest.mark.parametrize("there", [0, 2, len(HIDDEN.problem.nodes)], ids=["nothing", "some", "all but its state"])
def test_nodes_may_say_alone_that_the_plant_was_gone(tmp_path: Path, there: int) -> None:
    """Where it was gone with the coordinator, between two of its messages too; what all have had cannot be gone."""
    names = [*HIDDEN.problem.node_names][there:]
    lost = {"plant/state", *(f"node/{name}/measurement" for name in names)}

    def delay(receiver: str, topic: str, step: int) -> float:
        return math.inf if topic in lost and step == 20 else SOON

    sent = PacedRun(HIDDEN, steps=STEPS, delay=delay).messages
    gone = [m for m in sent if not (m.topic in lost and m.document["step"] == 20)]
    verdict = verdict_of(tmp_path, gone)
    assert verdict.exit_code == (0 if names else 1), verdict.text()


@pytest.mark.parametrize("last", [1, 2, 7], ids=["state", "measurement too", "two steps"])
def test_a_plant_need_not_have_come_to_the_end(tmp_path: Path, last: int) -> None:
    """It stood still, or was asked to go, as the run ended: what it has sent, by its numbers and evidence, is there."""
    everything = [m for m in TRUE if m.who == "plant"]
    short = [m for m in TRUE if m not in everything[-last:]]
    sent = {who: count - (last if who == "plant" else 0) for who, count in whole_run(HIDDEN.problem, STEPS).items()}
    taken = everything[-last - 1]

    def missing(sent_by: dict[str, int], messages: list[Sent] = short, **how: Any) -> int:
        (tmp_path / "run.mcap").unlink(missing_ok=True)
        path = record(tmp_path / "run.mcap", HIDDEN, messages, steps=STEPS, received=sent_by, period="0.1", **how)
        verdict = replay(path)
        assert (verdict.exit_code == 0) == (not verdict.missing.total), verdict.text()
        return verdict.missing.total

    assert missing(sent) == 0
    assert missing(whole_run(HIDDEN.problem, STEPS)) == last
    assert missing(sent, evidence=False) == last
    assert missing(sent, [m for m in short if m is not taken]) == last + 1


# what went with the process that held it
def lost_from(first: int, sent: list[Sent] = TRUE) -> list[Sent]:
    """Node n1 was killed at the step AWAY.start, and no recorder had got what it sent from `first` on.

    Its successor uses those numbers again, and nothing shows that there was something.
    """
    lost = [m for m in sent if m.who == "node-n1" and first <= m.document["step"] < AWAY.start]
    numbers = {m.number for m in lost}
    return [
        m._replace(number=m.number - sum(number < m.number for number in numbers)) if m.who == "node-n1" else m
        for m in sent
        if m not in lost
    ]


def verdict_of_lost(folder: Path, first: int, sent: list[Sent] = TRUE) -> Verdict:
    messages = lost_from(first, sent)
    (folder / "run.mcap").unlink(missing_ok=True)
    return verdict_of(folder, messages, received=Counter(m.who for m in messages))


def with_change(sent: list[Sent], topic: str, step: int, mutate: Callable[[dict[str, Any]], None]) -> list[Sent]:
    at = next(i for i, m in enumerate(sent) if m.topic == topic and m.document["step"] == step)
    document = copy.deepcopy(sent[at].document)
    mutate(document)
    return [*sent[:at], sent[at]._replace(document=document), *sent[at + 1 :]]


def shift(document: dict[str, Any]) -> None:
    document["x_hat"][1] += 1e-6


def who_used(sender: str, step: int) -> str:
    """A node that says that it has used a pair of this step."""
    heard = (m for m in TRUE if m.topic.endswith("estimate") and m.document["step"] == step + 1)
    return next(m.who for m in heard if sender in m.document["heard"] and m.who != f"node-{sender}").removeprefix(
        "node-"
    )


def test_an_estimate_that_was_used_and_lost_accuses_nobody(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nobody knows what it was made of; so what depends on it is not judged, and the run is not whole."""
    verdict = verdict_of_lost(tmp_path, 26)
    assert (verdict.outcome, verdict.exit_code) == ("agrees for what is there", 3), verdict.text()
    assert verdict.unknown == (("node/n1/estimate", 27), ("node/n1/estimate", 28))
    assert (
        "unknown, and used by others, whose next estimates are not judged by them: node/n1/estimate" in verdict.text()
    )
    assert [proof.holds for proof in verdict.proofs] == [True, True, True, None, True]
    assert verdict.document()["unknown"] == 2
    monkeypatch.setattr(Coupling, "doubtful", lambda coupling: coupling)
    assert verdict_of_lost(tmp_path, 26).exit_code == 1


def test_an_estimate_that_can_be_inferred_is_known(tmp_path: Path) -> None:
    """It was made as the seed says: what others made of it, to the last digits, says so."""
    verdict = verdict_of_lost(tmp_path, 27)
    assert (verdict.exit_code, verdict.unknown) == (0, ()), verdict.text()


@pytest.mark.parametrize("first", [26, 27])
def test_who_lies_about_what_it_made_of_a_lost_estimate_is_not_believed(tmp_path: Path, first: int) -> None:
    """What is lost cannot be held against it; but nothing is said to agree as a whole."""
    liar = who_used("n1", 28)
    sent = with_change(TRUE, f"node/{liar}/estimate", 29, shift)
    verdict = verdict_of_lost(tmp_path, first, sent)
    assert verdict.exit_code != 0, verdict.text()
    assert verdict.exit_code == 1 or ("node/n1/estimate", 28) in verdict.unknown


@pytest.mark.parametrize("step", [20, AWAY.start + 3, STEPS - 1])
def test_a_lie_elsewhere_is_found_whatever_was_lost(tmp_path: Path, step: int) -> None:
    sent = with_change(TRUE, "node/n2/estimate", step, shift)
    assert_found(verdict_of_lost(tmp_path, 26, sent), step=step, node="n2", field="x_hat[1]", proof=2)


def test_nobody_has_heard_of_who_was_gone(tmp_path: Path) -> None:
    """Who says that it has used an estimate long after its sender was seen to go has made it up."""
    long_gone = AWAY.stop - 2
    receiver = next(
        name
        for i, name in enumerate(HIDDEN.problem.node_names)
        if name != "n1"
        and HIDDEN.problem.node_index("n1")
        in HIDDEN.problem.neighbours(HIDDEN.problem.mode_index(document_of("mode", long_gone)["mode"]), i)
    )

    def lie(document: dict[str, Any]) -> None:
        document["heard"] = [*document["heard"], "n1"]
        shift(document)

    untold = [
        m._replace(document={**m.document, "steps": [k for k in m.document["steps"] if k != long_gone]})
        if m.who == f"node-{receiver}" and m.document.get("about") == "node/n1/estimate"
        else m
        for m in TRUE
    ]
    verdict = verdict_of_lost(tmp_path, 26, with_change(untold, f"node/{receiver}/estimate", long_gone + 1, lie))
    assert verdict.exit_code == 1, verdict.text()


def test_numbers_that_the_recorder_calls_void_are_lost(tmp_path: Path) -> None:
    """Its own account: not missing, and not whole; without it they are missing."""
    taken = [m for m in TRUE if m.topic == "node/n2/estimate" and m.document["step"] == 20]
    sent = [m for m in TRUE if m not in taken]
    path = record(
        tmp_path / "run.mcap", HIDDEN, sent, steps=STEPS, period="0.1", void={"node-n2": str(taken[0].number)}
    )
    verdict = replay(path)
    assert (verdict.outcome, verdict.lost, verdict.missing.total) == ("agrees for what is there", 1, 0), verdict.text()
    assert "1 lost, by the recorder's account" in verdict.text()


def by_sensors(sent: list[Sent]) -> list[Sent]:
    """The same without a plant: every measurement is from a sensor."""
    return [
        m._replace(who=f"sensor-{m.topic.split('/')[1]}") if m.topic.endswith("measurement") else m
        for m in sent
        if m.topic != "plant/state"
    ]


def test_without_a_plant_estimates_are_compared(tmp_path: Path) -> None:
    """Every measurement from a sensor, some of which never came."""
    sent = by_sensors(TRUE)
    lost = {
        (m.topic.replace("estimate", "measurement"), m.document["step"])
        for m in TRUE
        if m.document.get("measured") is False
    }
    sent = [m for m in sent if (m.topic, m.document["step"]) not in lost]
    verdict = verdict_of(tmp_path, sent, external="n0,n1,n2,n3")
    assert verdict.exit_code == 0, verdict.text()
    assert [proof.holds for proof in verdict.proofs] == [True, True, True, True, None]
    shifted = changed("node/n2/estimate", 12, lambda document: document["x_hat"].__setitem__(0, 1.0))
    (tmp_path / "run.mcap").unlink()
    verdict = verdict_of(tmp_path, by_sensors(shifted), external="n0,n1,n2,n3")
    assert_found(verdict, step=12, node="n2", field="x_hat[0]", proof=2)


# mutants: substitutions
def test_a_substitution_without_a_reason_is_found(tmp_path: Path) -> None:
    at, who, _, step = reason("estimate")
    verdict = verdict_of(tmp_path, with_document(at, lambda d: d["steps"].remove(step)))
    assert_found(verdict, step=step + 1, node=who, field="heard", proof=1)


def test_a_measurement_that_was_refused_without_a_reason_is_found(tmp_path: Path) -> None:
    at, who, _, step = reason("measurement")
    verdict = verdict_of(tmp_path, with_document(at, lambda d: d["steps"].remove(step)))
    assert_found(verdict, step=step, node=who, field="measured", proof=1)


def test_a_reason_for_what_was_used_is_found(tmp_path: Path) -> None:
    """An event that names a step in which the pair went into the estimate."""
    at, who, about, step = reason("estimate")
    sender = about.split("/")[1]
    other = next(k for k in range(3, 28) if k != step and sender in document_of(f"node/{who}/estimate", k + 1)["heard"])
    verdict = verdict_of(tmp_path, with_document(at, lambda d: d["steps"].append(other)))
    assert_found(verdict, step=other + 1, node=who, field="heard", proof=1)


def test_a_late_pair_that_was_used_is_found(tmp_path: Path) -> None:
    """Whether the node admits it or not: here it computes with it, and says that it did not."""
    _, who, about, step = reason("estimate")
    sender, problem = about.split("/")[1], HIDDEN.problem
    mode = document_of("mode", step)["mode"]
    mine, theirs = document_of(f"node/{who}/estimate", step), document_of(about, step)
    K, H = HIDDEN.K[mode][who][sender], HIDDEN.H[mode][who][sender]
    a = problem.topologies[problem.mode_index(mode)].adjacency[problem.node_index(who), problem.node_index(sender)]
    more = a * (K @ np.subtract(theirs["x_hat"], mine["x_hat"]) + H @ theirs["innovation"])

    def use(document: dict[str, Any]) -> None:
        document["x_hat"] = np.add(document["x_hat"], more).tolist()

    topic = f"node/{who}/estimate"
    verdict = verdict_of(tmp_path, changed(topic, step + 1, use))
    assert_found(verdict, step=step + 1, node=who, field="x_hat[0]", proof=2)
    (tmp_path / "run.mcap").unlink()
    verdict = verdict_of(tmp_path, changed(topic, step + 1, lambda d: d["heard"].append(sender)))
    first = verdict.first_divergence
    assert first is not None
    assert (first.step, first.node) == (step + 1, who)


def test_a_late_measurement_that_was_used_is_found(tmp_path: Path) -> None:
    """With `measured` false an innovation other than 0, and with 0 the claim that it was measured."""
    _, who, _, step = reason("measurement")
    topic = f"node/{who}/estimate"
    verdict = verdict_of(tmp_path, changed(topic, step, lambda d: d["innovation"].__setitem__(0, 1e-9)))
    assert_found(verdict, step=step, node=who, field="innovation[0]", proof=1)
    (tmp_path / "run.mcap").unlink()
    verdict = verdict_of(tmp_path, changed(topic, step, lambda d: d.pop("measured")))
    assert verdict.exit_code == 1
    assert verdict.first_divergence is not None
    assert (verdict.first_divergence.step, verdict.first_divergence.node) == (step, who)


# mutants: beginnings and absences
def test_a_beginning_from_nowhere_is_found(tmp_path: Path) -> None:
    """An estimate that is not its origin's, by the last bit; another origin; none at all; no event."""
    topic, step = "node/n1/estimate", AWAY.stop
    assert document_of(topic, step)["origin"] not in ("", ZERO_STATE)
    others: list[Callable[[dict[str, Any]], Any]] = [
        lambda d: d["x_hat"].__setitem__(0, math.nextafter(d["x_hat"][0], 9.0)),
        lambda d: d.update(origin=ZERO_STATE),
        lambda d: d.update(origin="n1"),
        lambda d: d.update(origin="nobody"),
        lambda d: d.pop("origin"),
    ]
    for mutate in others:
        verdict = verdict_of(tmp_path, changed(topic, step, mutate))
        assert verdict.exit_code == 1
        (tmp_path / "run.mcap").unlink()
    silent = [m for m in TRUE if m.document.get("kind") != "began"]
    assert_found(verdict_of(tmp_path, silent), step=step, node="n1", field="origin", proof=1)


def test_a_node_that_was_there_cannot_begin_again_unnoticed(tmp_path: Path) -> None:
    """A jump to a neighbour's estimate in the middle of a run."""
    theirs = document_of("node/n2/estimate", 20)

    def jump(document: dict[str, Any]) -> None:
        document.update(
            x_hat=theirs["x_hat"],
            z_hat=theirs["z_hat"],
            mode="",
            heard=[],
            measured=False,
            origin="n2",
            innovation=[0.0],
        )

    verdict = verdict_of(tmp_path, changed("node/n0/estimate", 20, jump))
    assert_found(verdict, step=20, node="n0", field="origin", proof=1)


@pytest.mark.parametrize("part", ["mode", "plant/state", "node/n0/measurement", "node/n2/estimate", "node/n1/estimate"])
def test_a_dropped_message_of_somebody_who_was_there_is_missing(tmp_path: Path, part: str) -> None:
    """Absences excuse what falls into them, and nothing else."""
    verdict = verdict_of(tmp_path, without(part, 20))
    assert verdict.exit_code == 1
    assert (verdict.missing.total, verdict.missing.first) == (1, ((part, 20),)), verdict.text()


def test_a_plant_that_comes_back_with_another_state_is_found(tmp_path: Path) -> None:
    sent = faulty(HIDDEN, **FAULTS["plant away"])
    moved = [
        m._replace(document={**m.document, "x": [value + 1e-9 for value in m.document["x"]]})
        if m.topic == "plant/state" and m.document["step"] == AWAY.stop
        else m
        for m in sent
    ]
    verdict = verdict_of(tmp_path, moved)
    assert verdict.first_divergence is not None
    assert (verdict.first_divergence.step, verdict.first_divergence.node) == (AWAY.stop, None)
    assert verdict.first_divergence.field == "x[0]"


def test_what_a_killed_node_could_not_explain_is_named(tmp_path: Path) -> None:
    """Its reasons went with its process: the run agrees, and the step is named as unexplained."""
    told = {
        (step, m.document["about"])
        for m in TRUE
        if m.who == "node-n1" and m.document.get("kind") in ("late", "silent", "gone")
        for step in m.document["steps"]
    }
    weather, asked = Weather(1), {}
    PacedRun(HIDDEN, steps=STEPS, delay=lambda *place: asked.setdefault(place, weather(*place)), **FAULTS["node away"])
    unsaid = {
        step
        for (receiver, topic, step), delay in asked.items()
        if receiver == "n1" and delay > 0.08 and step < AWAY.start and (step, topic) not in told
    }
    verdict = verdict_of(tmp_path, TRUE)
    assert verdict.exit_code == 0, verdict.text()
    pacing = verdict.pacing
    assert pacing is not None
    assert 0 < pacing.unexplained_total <= len(unsaid)
    assert set(pacing.unexplained) <= {f'node "n1" at step {step}' for step in unsaid}
    assert f"unexplained: {pacing.unexplained_total} (" in verdict.text()


@pytest.mark.parametrize("cut", [200, 333, 507])
def test_a_cut_file_agrees_as_far_as_it_goes(tmp_path: Path, cut: int) -> None:
    """What nodes had not told yet is named, and held against nobody."""
    path = record(tmp_path / "run.mcap", HIDDEN, TRUE[:cut], steps=STEPS, whole=False, period="0.1")
    verdict = replay(path)
    assert (verdict.agrees, verdict.exit_code) == (True, 3), verdict.text()
    assert verdict.pacing is not None
    assert verdict.pacing.unexplained_total > 0


@pytest.mark.parametrize(("topic_ends", "field", "after"), [("measurement", "measured", 0), ("estimate", "heard", 1)])
def test_a_reason_that_a_cut_file_lacks_was_perhaps_given(
    tmp_path: Path, topic_ends: str, field: str, after: int
) -> None:
    """A number is not there, as where the recorder was killed before it came; where all are there, nobody gave it."""
    at, node, _, _ = reason(topic_ends)
    event = TRUE[at]
    lacking = [*TRUE[:at], *TRUE[at + 1 :]]
    silent = [m._replace(number=m.number - (m.who == event.who and m.number > event.number)) for m in lacking]
    facts: dict[str, Any] = {"steps": STEPS, "whole": False, "period": "0.1"}
    verdict = replay(record(tmp_path / "lacking.mcap", HIDDEN, lacking, **facts))
    assert (verdict.agrees, verdict.exit_code) == (True, 3), verdict.text()
    verdict = replay(record(tmp_path / "silent.mcap", HIDDEN, silent, **facts))
    assert_found(verdict, step=min(event.document["steps"]) + after, node=node, field=field, proof=1)


def test_a_file_without_events_explains_nothing_and_accuses_nobody(tmp_path: Path) -> None:
    sent = [m for m in faulty(HIDDEN) if m.topic not in ("event", "account")]
    verdict = verdict_of(tmp_path, sent)
    assert (verdict.agrees, verdict.exit_code) == (True, 3), verdict.text()
    assert verdict.pacing is not None
    assert verdict.pacing.unexplained_total > 10


# mutants: the step, as in lock-step
@pytest.mark.parametrize(("node", "step"), [("n0", 1), ("n1", AWAY.stop + 1), ("n3", STEPS - 1)])
def test_a_millionth_in_an_estimate_is_found(tmp_path: Path, node: str, step: int) -> None:
    def shift(document: dict[str, Any]) -> None:
        document["x_hat"][1] += 1e-6

    verdict = verdict_of(tmp_path, changed(f"node/{node}/estimate", step, shift))
    assert_found(verdict, step=step, node=node, field="x_hat[1]", proof=2)


def test_a_run_of_another_seed_is_found(tmp_path: Path) -> None:
    verdict = verdict_of(tmp_path, faulty(REAL, seed=2), REAL, seed="1")
    assert verdict.exit_code == 1
    assert verdict.first_divergence is not None
    assert verdict.first_divergence.proof == 1


def test_a_lock_step_run_may_not_say_what_paced_runs_say(tmp_path: Path) -> None:
    sent = simulate(HIDDEN, steps=STEPS)
    at = next(i for i, m in enumerate(sent) if m.topic == "node/n2/estimate" and m.document["step"] == 9)
    sent[at] = sent[at]._replace(document={**sent[at].document, "measured": False})
    verdict = replay(record(tmp_path / "run.mcap", HIDDEN, sent, steps=STEPS))
    assert verdict.exit_code == 1
    assert verdict.strange == ("node/n2/estimate, step 9: it says what only paced runs have to say",)


def test_a_paced_run_that_is_passed_off_as_lock_step_is_found(tmp_path: Path) -> None:
    assert verdict_of(tmp_path, TRUE, period="0").exit_code == 1


def test_the_delays_are_those_of_the_last_account_of_each_node(tmp_path: Path) -> None:
    """What a killed node told before is of another process."""
    told = {sent.document["who"]: sent.document for sent in TRUE if sent.topic == "account"}
    pacing = verdict_of(tmp_path, TRUE).pacing
    assert pacing is not None
    assert [f"node-{delays.node}" for delays in pacing.delays] == sorted(told)
    for delays in pacing.delays:
        account = told[f"node-{delays.node}"]
        assert delays.to_estimate == tuple(account[f"to_estimate_{what}"] for what in ("median", "p99", "max"))
        assert delays.to_step == tuple(account[f"to_step_{what}"] for what in ("median", "p99", "max"))
    assert f"{1e3 * max(one.to_step[2] for one in pacing.delays):.2f} ms" in "".join(pacing.text())
