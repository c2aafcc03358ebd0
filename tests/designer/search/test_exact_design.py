"""From a problem to a file with a certificate of kind "exact", or to a sentence that says why there is none."""

from __future__ import annotations

from typing import Any

import pytest

from agent.contract.errors import Unattainable
from agent.contract.gains import Gains
from agent.contract.problem import Problem
from designer.gain.exact import exact_gain
from designer.gain.floor import floor
from designer.model.error_model import error_model, link_gains
from designer.patience import Budget
from designer.problems import find
from designer.proof.certificate import verify
from designer.proof.findings import Verdict
from designer.proof.prover import Prover
from designer.search import descent, effort, exact_design
from designer.search.exact_design import certify, confirmed, design_exact
from designer.search.starts import least_variance_gains
from designer.search.windows import Windowed
from designer.synthesis import design


def alone(beta: float) -> Problem:
    """One node before x+ = 2 x + w; no gains are mean-square stable unless beta > 1 - 1 / 2^2 = 0.75."""
    node = {"name": "only", "C": [[1.0]], "D": [[0.0, 0.1]], "arrival_probability": beta, "loss": "seen"}
    return Problem.from_document(
        {
            "name": "alone",
            "plant": {"A": [[2.0]], "B": [[1.0, 0.0]], "M": [[1.0]]},
            "node": [node],
            "topology": [{"name": "always", "adjacency": [[1.0]]}],
            "markov": {"transition": [[1.0]], "initial": "always"},
            "unbiased": True,
        }
    )


def test_above_the_critical_arrival_probability_there_are_gains_and_below_there_is_no_design(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The refusal says how far the best gains are from stable: a^2 (1 - beta)."""
    for name, value in {"_WEIGHTS": descent._WEIGHTS[:5], "_HORIZON": 10, "_LONGEST": 20}.items():
        monkeypatch.setattr(descent, name, value)
    assert exact_gain(error_model(alone(0.8), *least_variance_gains(alone(0.8)))).stable
    with pytest.raises(Unattainable, match=r"^no mean-square stable gains .* multiply E\|error\|\^2 by 1\.2 "):
        design_exact(alone(0.7), starts={"least variance": least_variance_gains(alone(0.7))})


def test_a_plant_that_nobody_sees_grow_is_refused_in_one_sentence() -> None:
    document = alone(1.0).document()
    document["node"][0]["C"] = [[0.0]]
    with pytest.raises(Unattainable, match="all sensors together do not show an unstable part"):
        design_exact(Problem.from_document(document))


def test_method_exact_ends_in_a_certificate_of_kind_exact() -> None:
    """floor <= exact <= gamma, and the check confirms gamma for what a reader of the file has."""
    problem = find("two-nodes")
    gains = Gains.from_bytes(design(problem, method="exact").canonical(), source="memory")
    proved = gains.certificate
    assert (proved.kind, proved.form, gains.method) == ("exact", "summed", "exact")
    assert proved.holds
    assert proved.exact is not None
    assert proved.floor is not None
    assert proved.P is None
    assert proved.floor <= proved.exact[1] <= proved.gamma <= proved.exact[1] * (1.0 + 1e-4)
    assert verify(gains).holds
    lower = proved.model_copy(update={"gamma": proved.gamma * (1.0 - 1e-4)})
    verdict = verify(gains.model_copy(update={"certificate": lower}))
    assert not verdict.holds
    assert verdict.failure is not None


def test_ctrl_c_while_the_proof_is_made_does_not_lose_the_gains(monkeypatch: pytest.MonkeyPatch) -> None:
    pressed: list[bool] = []
    made = exact_design.confirmed

    def confirmed(*claim: Any, **more: Any) -> Verdict:
        if not pressed:
            pressed.append(True)
            raise KeyboardInterrupt
        return made(*claim, **more)

    monkeypatch.setattr(exact_design, "confirmed", confirmed)
    problem = find("two-nodes")
    gains = design_exact(problem, starts={"least variance": least_variance_gains(problem)}, budget=Budget(1e-9))
    assert pressed
    assert verify(gains).holds


def test_where_time_is_up_gamma_is_one_that_is_sooner(monkeypatch: pytest.MonkeyPatch) -> None:
    """True, a little above the exact gain, and said to be; where even that is not found the proof goes to its end."""
    problem, over = find("two-nodes", ["node.left.arrival_probability=0.9"]), Budget(0.0)
    K, H = link_gains(problem, *least_variance_gains(problem))
    gain = exact_gain(error_model(problem, *least_variance_gains(problem)))
    monkeypatch.setattr(exact_design, "_SECONDS_OF_A_PROOF", 0.0)
    soon = certify(problem, K, H, gain=gain, budget=over)
    assert soon.exact is None
    assert gain.low < soon.gamma < 1.001 * gain.high
    assert len(over.left_out) == 1
    assert Prover(problem, K, H).exact(soon.gamma).holds

    def refused(*_: Any, **__: Any) -> Any:
        raise Unattainable("nothing is proved at once")

    monkeypatch.setattr(exact_design, "certify_at_once", refused)
    at_length = certify(problem, K, H, gain=gain, budget=over)
    assert at_length.exact is not None
    assert at_length.gamma < soon.gamma


def test_a_design_by_theorem_2_shows_the_ladder_too() -> None:
    """floor <= exact gain of its gains <= its gamma <= what Theorem 1 certifies."""
    problem = find("two-nodes")
    proved = design(problem, method="theorem2-reduced").certificate
    assert proved.exact is not None
    assert proved.floor == floor(problem)
    assert proved.by_theorem1 is not None
    assert proved.floor <= proved.exact[1] <= proved.gamma * (1.0 + 1e-6) <= proved.by_theorem1 * (1.0 + 1e-6)


@pytest.mark.parametrize("why", ["interrupted", "out of time", "windows alone, for want of memory", "converged"])
def test_what_windows_led_to_is_certified_whatever_ends_the_search(why: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """And where nothing ends it, a search of the whole network goes on from there."""
    problem = find("two-nodes")
    start = least_variance_gains(problem)
    monkeypatch.setattr(effort, "MOST_NODES", 1)
    monkeypatch.setattr(descent, "_WEIGHTS", descent._WEIGHTS[:3])
    ended = why if why in ("interrupted", "out of time") else None
    if ended is not None:
        monkeypatch.setattr(exact_design, "window_gains", lambda *_, **__: Windowed(start, ended))
    if "memory" in why:
        monkeypatch.setattr(exact_design, "whole_fits", lambda problem: False)
    gains = design_exact(problem)
    assert gains.solver.status.startswith(f"{why}; from ")
    assert (gains.solver.iterations > 0) == (why == "converged")
    assert verify(gains).holds


@pytest.mark.parametrize("phase", ["_keep", "_follow", "_is_short", "_centre", "choose", "_near", "confirmed"])
def test_ctrl_c_in_any_phase_leaves_gains_that_are_certified(phase: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Pressed once, as the phase begins for the first time."""
    place = exact_design if phase == "confirmed" else descent._Search
    proper, pressed = getattr(place, phase), []

    def interrupted(*words: Any, **options: Any) -> Any:
        if not pressed:
            pressed.append(phase)
            raise KeyboardInterrupt
        return proper(*words, **options)

    monkeypatch.setattr(place, phase, interrupted)
    monkeypatch.setattr(descent, "_WEIGHTS", descent._WEIGHTS[:2])
    problem = find("two-nodes")
    gains = design_exact(problem, starts={"least variance": least_variance_gains(problem)})
    assert pressed
    assert verify(gains).holds


def test_ctrl_c_that_nobody_heeds_ends_a_design_that_has_nothing_yet(monkeypatch: pytest.MonkeyPatch) -> None:
    """As in a notebook; who heeds signals tells the budget, and gets gains."""

    def interrupted(*_: Any) -> Any:
        raise KeyboardInterrupt

    monkeypatch.setattr(exact_design, "least_variance_gains", interrupted)
    with pytest.raises(KeyboardInterrupt):
        design(find("two-nodes"))


@pytest.mark.parametrize("asked", [0, 1, 2])
def test_no_time_at_all_leaves_gains_that_are_certified(asked: int) -> None:
    budget = Budget(1e-9)
    budget.asked = asked
    gains = design(find("two-nodes"), budget=budget)
    assert ("ignore all measurements" in gains.solver.status) == (asked > 0)
    assert "the floor" in budget.left_out
    assert verify(gains).holds


@pytest.mark.parametrize(("floats", "above"), [(1e-6, 1e-6), (1e-5, 1e-5), (1e-4, 1e-6)])
def test_of_small_networks_floats_cost_no_digits(floats: float, above: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where they do not prove a gamma that is hardly above the exact gain, balls are asked for it first."""
    high, asked = 0.4, exact_design.FLOATS

    class Asked:
        def __init__(self, *of: Any, makes: Any = None, **more: Any) -> None:
            self._room = floats if makes is asked else 0.9e-6

        def exact(self, gamma: float, *, most: int) -> Verdict:
            return Verdict(gamma >= high * (1.0 + self._room) * (1.0 - 1e-15), gamma, "", None, {})

    monkeypatch.setattr(exact_design, "Prover", Asked)
    assert confirmed(alone(0.8), {}, {}, high).gamma == pytest.approx(high * (1.0 + above), rel=1e-12)
