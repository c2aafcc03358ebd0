"""Runs whose numbers cancel or grow: what honest ones are spared, and what is said of the rest."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from made_recordings import record, simulate, uncertified

from agent.contract.arrays import Array
from agent.contract.gains import Gains
from agent.contract.problem import Problem
from designer.replay import PathAudit, replay
from designer.replay.free_run import Path as PathBlock
from designer.replay.part import Part
from designer.replay.verdict import Verdict


def cancelling(part: float, **disturbance: object) -> Gains:
    """z is a difference of two states that move alike, but for `part` of them."""
    return single(
        {"A": [[0.9, 0.0], [0.0, 0.9]], "B": [[0.7], [0.7]], "M": [[1.0, -1.0 - part]]},
        {"C": [[1.0, 0.0]], "D": [[0.3]], "arrival_probability": 0.9},
        np.array([[0.5, 0.0], [0.0, 0.5]]),
        np.array([[0.4], [0.4]]),
        **disturbance,
    )


def growing(a: float, *, C: float = 1.0, M: float = 1.0) -> Gains:
    """One node of an unstable plant."""
    node = {"C": [[C]], "D": [[0.0, 0.3]], "arrival_probability": 0.9, "loss": "seen"}
    plant = {"A": [[a]], "B": [[1.0, 0.0]], "M": [[M]]}
    return single(plant, node, np.array([[a]]), np.array([[0.8 * a / C]]), unbiased=True)


def single(plant: dict[str, object], node: dict[str, object], K: Array, H: Array, **more: object) -> Gains:
    document = {
        "name": "single",
        "plant": plant,
        "node": [{"name": "a", **node}],
        "topology": [{"name": "t", "hears": {}}],
        "markov": {"transition": [[1.0]], "initial": "t"},
        "disturbance": {"kind": "white", "deviation": 1.0},
    }
    problem = Problem.from_document(document | more)
    return uncertified(problem, {"t": {"a": {"a": K}}}, {"t": {"a": {"a": H}}}, method="none")


def replayed(folder: Path, gains: Gains, steps: int, nudge: tuple[int, str, float] | None = None) -> Verdict:
    path = folder / "run.mcap"
    record(path, gains, simulate(gains, steps=steps, nudge=nudge), steps=steps)
    return replay(path)


def outcome(verdict: Verdict, number: int) -> bool | None:
    return next(proof.holds for proof in verdict.proofs if proof.number == number)


@pytest.mark.parametrize("part", [1e-6, 1e-8, 1e-10])
@pytest.mark.parametrize("kind", ["white", "worst-case"])
def test_what_cancels_in_M_accuses_nobody(part: float, kind: str, tmp_path: Path) -> None:
    """The path bound is of a factor: squares would have no digit of it left."""
    gains = cancelling(part, **({} if kind == "white" else {"disturbance": {"kind": "impulse"}}))
    verdict = replayed(tmp_path, gains, 120)
    assert verdict.agrees, verdict.text()


def test_a_state_that_grows_silences_the_path_inequality(tmp_path: Path) -> None:
    """Where its rounding is above the bound, nothing is said, and no margin is made of rounding."""
    short = replayed(tmp_path, growing(1.2), 40)
    assert outcome(short, 5) is True
    assert "says nothing" not in short.text()
    assert short.silent_from is None
    assert "rounding alone" not in short.text().split("peak")[1]
    (tmp_path / "run.mcap").unlink()
    verdict = replayed(tmp_path, growing(1.2), 400)
    assert verdict.agrees, verdict.text()
    note = next(proof.note for proof in verdict.proofs if proof.number == 5)
    assert f"it says nothing from step {verdict.silent_from} on" in note
    assert verdict.peak is not None
    assert (" on it may be rounding alone" in verdict.text()) is (verdict.peak.step >= (verdict.silent_from or 0))
    assert verdict.path_margin is not None
    assert verdict.leeway is not None
    assert verdict.leeway > 1e10
    assert f"at its last step an estimate may be off by {verdict.leeway:.2g} and agree" in verdict.text()


def test_numbers_whose_squares_overflow_are_agreed_up_to(tmp_path: Path) -> None:
    verdict = replayed(tmp_path, growing(3.0), 400)
    assert verdict.agrees, verdict.text()
    assert verdict.up_to is not None
    assert 270 < verdict.up_to < 280  # 3^273 is 1e130
    assert verdict.outcome == "agrees"
    assert f"agrees up to step {verdict.up_to}: later numbers are too large to compare" in verdict.text()


@pytest.mark.parametrize("gains", [growing(2e12), growing(3.0, C=1e20), growing(30.0, M=1e15)], ids=["fast", "C", "M"])
def test_growth_of_any_speed_and_in_any_units_accuses_nobody(gains: Gains, tmp_path: Path) -> None:
    """Though no state was large in the step before a message was too large to be compared."""
    steps = int(240 * np.log(10.0) / np.log(gains.problem.plant.A[0, 0]))
    verdict = replayed(tmp_path, gains, steps)
    assert verdict.outcome == "agrees", verdict.text()
    assert verdict.up_to is not None
    assert verdict.up_to < steps - 1


def test_a_number_that_growth_does_not_explain_is_strange(tmp_path: Path) -> None:
    """Nor does a lie that is just within what may be compared end the comparison before it is found."""
    for step, lie in ((5, 1e200), (5, 1e135)):
        gains = growing(1.2)
        sent = [
            message._replace(document=message.document | {"x_hat": [lie]})
            if message.topic == "node/a/estimate" and message.document["step"] == step
            else message
            for message in simulate(gains, steps=20)
        ]
        record(tmp_path / f"{lie}.mcap", gains, sent, steps=20)
        assert not replay(tmp_path / f"{lie}.mcap").agrees


def test_a_lie_before_the_numbers_are_too_large_is_found(tmp_path: Path) -> None:
    verdict = replayed(tmp_path, growing(3.0), 400, nudge=(10, "a", 1.0))
    assert verdict.headline() == f"DIVERGES; numbers after step {verdict.up_to} are too large to compare"
    assert verdict.first_divergence is not None
    assert verdict.first_divergence.step == 10


def audited(error: float, bound: float, rounding: float) -> PathAudit:
    audit = PathAudit(growing(1.2).problem, Part())
    audit.add(PathBlock(5, np.array([error]), np.array([bound]), np.array([rounding])), 1.0)
    return audit


def test_the_margin_is_of_the_bound_alone() -> None:
    assert audited(0.9, 1.0, 0.5).margin == pytest.approx(0.1)
    assert audited(1.2, 1.0, 0.5).holds  # rounding explains it
    assert not audited(1.6, 1.0, 0.5).holds
    silent = audited(1.6, 1.0, 1.1)
    assert silent.holds
    assert silent.compared == 0
    assert silent.note() == "it says nothing from step 5 on, where rounding may be more than the bound"


def test_what_an_initial_error_leaves_stands_beside_the_bound(tmp_path: Path) -> None:
    """Until the first w it is all there is, which is in no margin; step 1 is none of those that say nothing."""
    gains = cancelling(0.5)
    begun = gains.problem.with_(plant={"initial_error": [1.0, -1.0]})
    verdict = replayed(tmp_path, uncertified(begun, gains.K, gains.H, method="none"), 20)
    assert verdict.agrees, verdict.text()
    note = next(proof.note for proof in verdict.proofs if proof.number == 5)
    assert note.endswith("; the bound has what x(0) leaves beside it")
    assert "at step 0" not in note
    assert verdict.path_margin is not None
    assert verdict.path_margin > -1e-12
    quiet = uncertified(begun.with_(disturbance={"kind": "none"}), gains.K, gains.H, method="none")
    (tmp_path / "run.mcap").unlink()
    verdict = replayed(tmp_path, quiet, 20)
    assert (outcome(verdict, 5), verdict.path_margin) == (True, None)
