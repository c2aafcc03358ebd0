"""The proof of certificates of both kinds, and mutants of good ones that it must refuse."""

from __future__ import annotations

import copy
import json
import math
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
from flint import arb, arb_mat, ctx
from networks import random_gains, random_problem, real_network
from places import ROOT

from agent.contract.arrays import Array
from agent.contract.errors import EXIT_GOOD, EXIT_NO, InputError
from agent.contract.gains import Certificate, Gains, LinkMatrices, Solver
from agent.contract.problem import Problem
from designer.cli import main
from designer.decay import decay
from designer.gain.exact import Operator, exact_gain, horizon_gain
from designer.invariants import scaled
from designer.lmi.back_off import back_off, coupled_lyapunov, inequality_17, least_gamma, relaxed
from designer.model.error_model import ErrorModel, error_model, link_gains, stacked_gains, stacked_links
from designer.problems import find
from designer.proof import balls, by_balls, findings, prover
from designer.proof import recursion as recursion_module
from designer.proof.ball_model import BallModel, Noise, Sensor
from designer.proof.balls import above, below, exact, floats, sign
from designer.proof.by_balls import ByBalls, symmetric
from designer.proof.by_floats import ByFloats
from designer.proof.certificate import lyapunov_matrix, verify
from designer.proof.findings import Verdict
from designer.proof.prover import BALLS, FLOATS, Make, Prover
from designer.proof.recursion import disproof, recursion
from designer.search.starts import consensus_gains

Document = dict[str, Any]
Kind = Literal["lyapunov", "exact"]
GOLDEN = ROOT / "recordings/golden/zhu2020-lossy.gains.json"


def networks() -> dict[str, Problem]:
    """The paper's; one that sees some losses and loses messages; one with an unstable plant, without x."""
    return {
        "paper": find("zhu2020-lossy"),
        "real": real_network(random_problem(3), seen=["n1"], delivery=0.8),
        "unbiased": real_network(random_problem(4), seen=True, delivery=0.9, unbiased=True, radius=1.02),
        "unbiased-hidden": real_network(random_problem(6), delivery=0.9, unbiased=True),
    }


def model_of(gains: Gains) -> ErrorModel:
    return error_model(gains.problem, *stacked_gains(gains))


def tight_P(model: ErrorModel) -> Array:
    """A P that changes of the gains or of the modes break: the sum of the powers of L from I, whatever the units."""
    operator = Operator(model)
    found = decay(operator.corner, model.modes, np.ones(model.size))
    assert found.total is not None
    assert found.rest is not None
    return scaled(operator.of, found.total, found.rest)


def certified(problem: Problem, kind: Kind) -> Gains:
    """Kalman-consensus gains with a certificate as tight as `design` makes it, by floats alone."""
    K, H = link_gains(problem, *consensus_gains(problem, weight=0.2))
    model = error_model(problem, *stacked_links(problem, K, H))
    gain, P = exact_gain(model), tight_P(model)
    gamma = gain.high if kind == "exact" else least_gamma(model.M, P) * (1.0 + 1e-9)
    return Gains(
        problem=problem,
        problem_digest=problem.digest(),
        method="consensus",
        K=K,
        H=H,
        certificate=Certificate(
            gamma=gamma,
            kind=kind,
            form="full",
            P=dict(zip(problem.mode_names, P, strict=True)),
            exact=(gain.low, gain.high),
            holds=True,
            verified="by nobody yet",
            margins={},
        ),
        solver=Solver(name="none", version="0", status="none", iterations=0, seconds=0.0),
        seconds={},
    )


KINDS: tuple[Kind, ...] = ("lyapunov", "exact")
ALL = {(name, kind): certified(problem, kind) for name, problem in networks().items() for kind in KINDS}
every_network = pytest.mark.parametrize("network", list(networks()))
every_kind = pytest.mark.parametrize("kind", KINDS)
every_arithmetic = pytest.mark.parametrize("makes", [FLOATS, BALLS], ids=["floats", "balls"])


def mutated(gains: Gains, mutate: Callable[[Document], None]) -> Gains:
    """The gains after an edit of their document, with a digest that fits the edited problem."""
    document = copy.deepcopy(gains.document())
    mutate(document)
    document["problem_digest"] = Problem.from_document(document["problem"]).digest()
    return Gains.model_validate(document)


# mutants
def lower_gamma(document: Document) -> None:
    proved = document["certificate"]
    proved["gamma"] = (proved["exact"][0] if proved["kind"] == "exact" else proved["gamma"]) * (1.0 - 1e-5)


def change_one_gain(document: Document) -> None:
    mode = document["problem"]["topology"][1]["name"]
    receiver, heard = next((i, heard) for i, heard in document["K"][mode].items() if len(heard) > 1)
    sender = next(j for j in heard if j != receiver)
    document["K"][mode][receiver][sender][0][1] += 1.0
    if document["problem"].get("unbiased"):  # A = sum of a_ij K_ij still
        names = [node["name"] for node in document["problem"]["node"]]
        a = dict(zip(names, document["problem"]["topology"][1]["adjacency"][names.index(receiver)], strict=True))
        document["K"][mode][receiver][receiver][0][1] -= a[sender] / a[receiver]


def change_one_measurement_gain(document: Document) -> None:
    mode, receiver = (document["problem"][part][0]["name"] for part in ("topology", "node"))
    document["H"][mode][receiver][receiver][0][0] += 1.5


def swap_arrival_and_loss(document: Document) -> None:
    for node in document["problem"]["node"]:
        beta = node["arrival_probability"]
        node["arrival_probability"] = 1.0 - beta if beta < 1.0 else beta


def permute_modes(document: Document) -> None:
    P, modes = document["certificate"]["P"], list(document["certificate"]["P"])
    document["certificate"]["P"] = {mode: P[modes[k - 1]] for k, mode in enumerate(modes)}


def change_transition(document: Document) -> None:
    """Always to the mode where P is largest."""
    traces = [np.trace(P) for P in document["certificate"]["P"].values()]
    document["problem"]["markov"]["transition"] = np.eye(len(traces))[[np.argmax(traces)] * len(traces)].tolist()


def make_P_indefinite(document: Document) -> None:
    P = next(iter(document["certificate"]["P"].values()))
    P[0][0] = -P[0][0]


def scale_P_up(document: Document) -> None:
    P = document["certificate"]["P"]
    document["certificate"]["P"] = {mode: (1.01 * np.array(matrix)).tolist() for mode, matrix in P.items()}


MUTANTS = [
    change_one_gain,
    change_one_measurement_gain,
    swap_arrival_and_loss,
    permute_modes,
    change_transition,
    make_P_indefinite,
    scale_P_up,
]


@every_arithmetic
@every_kind
@every_network
def test_true_certificates_are_proved(network: str, kind: Kind, makes: Sequence[Make]) -> None:
    """As tight as they are made, with every margin positive, through the bytes of the file."""
    gains = ALL[network, kind]
    verdict = verify(Gains.from_bytes(gains.canonical(), source="memory"), makes=makes)
    assert verdict.holds, verdict.failure
    assert verdict.failure is None
    assert verdict.gamma == gains.certificate.gamma
    parts = ["(17)", "(18)"] if kind == "lyapunov" else ["(17)", "P > 0", "recursion", "Y < g P"]
    assert set(verdict.margins) == {f"{part} mode {mode}" for part in parts for mode in gains.problem.mode_names}
    assert min(verdict.margins.values()) > 0.0


def test_the_golden_gains_are_proved() -> None:
    """P in structured form, as a solver gave it and the back-off left it."""
    gains = Gains.load(GOLDEN)
    assert gains.certificate.form == "structured"
    assert verify(gains).holds


@every_arithmetic
@every_network
def test_gamma_lowered_by_1e_5_is_proved_false(network: str, makes: Sequence[Make]) -> None:
    """Below the infimum for this P, (18) is false; below the exact gain, the recursion is."""
    for kind, inequality in (("lyapunov", "(18)"), ("exact", "recursion")):
        verdict = verify(mutated(ALL[network, kind], lower_gamma), makes=makes)
        assert not verdict.holds
        assert verdict.failure is not None
        assert verdict.failure.startswith(f'{inequality} fails in mode "')
        assert "it is false, its least scaled eigenvalue is -" in verdict.failure
        assert ("at step" in verdict.failure) is (kind == "exact")
        assert min(verdict.margins.values()) < 0.0


@every_arithmetic
@every_kind
@every_network
@pytest.mark.parametrize("mutate", MUTANTS)
def test_a_mutant_that_breaks_17_is_proved_false(
    network: str, kind: Kind, mutate: Callable[[Document], None], makes: Sequence[Make]
) -> None:
    """(17) is false for the mutant by floats too; the verdict is a value, not an exception, and names the mode."""
    mutant = mutated(ALL[network, kind], mutate)
    P = lyapunov_matrix(mutant)
    by_floats = np.linalg.eigvalsh(inequality_17(model_of(mutant), (P + P.swapaxes(1, 2)) / 2.0)).min(axis=1)
    false = [mode for mode, least in zip(mutant.problem.mode_names, by_floats, strict=True) if least < 0.0]
    assert false, "this mutant is no mutant"
    verdict = verify(mutant, makes=makes)
    assert not verdict.holds
    assert verdict.failure is not None
    assert verdict.failure.startswith(f'(17) fails in mode "{false[0]}": it is false, its least scaled eigenvalue is -')
    assert min(verdict.margins.values()) < 0.0


@every_arithmetic
@every_network
def test_a_horizon_that_is_too_short_is_not_proved(
    network: str, makes: Sequence[Make], monkeypatch: pytest.MonkeyPatch
) -> None:
    """With one step fewer than it takes, nothing is known of the rest; with as many, it is proved as without any.

    Nor is it where the size of the network admits no more.
    """
    gains = ALL[network, "exact"]
    problem, P = gains.problem, lyapunov_matrix(gains)
    by = makes[0](problem, gains.K, gains.H)

    def holds_within(most: int) -> bool:
        return findings.proved(recursion(by, problem.mode_names, gains.certificate.gamma, P, most=most))

    steps = next(most for most in range(1, 200) if holds_within(most))
    for horizon, holds in ((steps, True), (steps + 100, True), (steps - 1, False), (1, False)):
        claim = gains.certificate.model_copy(update={"horizon": horizon})
        verdict = verify(gains.model_copy(update={"certificate": claim}), makes=makes)
        assert verdict.holds is holds
        assert holds or "Y < g P fails in mode" in str(verdict.failure)
        assert holds or f"after {horizon} steps, and in none before: undecided" in str(verdict.failure)
    monkeypatch.setattr(recursion_module, "_FEWEST", 1)
    monkeypatch.setattr(
        recursion_module, "MOST_NUMBERS", by.cost * len(problem.topologies) * by.order**2 * (steps - 0.5)
    )
    assert verify(gains, makes=makes).failure == (
        f'Y < g P fails in mode "{problem.mode_names[0]}" after {steps - 1} steps, and in none before: undecided, and '
        "a proof gets no more steps; it takes fewer at a gamma a little larger"
    )
    with pytest.raises(InputError, match="horizon is 0"):
        verify(mutated(gains, lambda document: document["certificate"].update(horizon=0)))


@every_arithmetic
@every_kind
def test_gains_whose_bound_is_false_are_refused_whatever_P_is(kind: Kind, makes: Sequence[Make]) -> None:
    """One gain is changed and P made anew: (17) is true again, and gamma, which was true before, is not."""
    mutant = mutated(ALL["real", kind], change_one_measurement_gain_a_little)
    gain = exact_gain(model_of(mutant))
    assert gain.low > ALL["real", "exact"].certificate.gamma, "this mutant is no mutant"
    P = dict(zip(mutant.problem.mode_names, tight_P(model_of(mutant)), strict=True))
    claim = mutant.certificate.model_copy(update={"P": P})
    verdict = verify(mutant.model_copy(update={"certificate": claim}), makes=makes)
    assert verdict.failure is not None
    assert verdict.failure.startswith("(18)" if kind == "lyapunov" else "recursion")
    assert "it is false" in verdict.failure
    assert min(margin for name, margin in verdict.margins.items() if "(17)" in name) > 0.0


def change_one_measurement_gain_a_little(document: Document) -> None:
    mode, receiver = (document["problem"][part][0]["name"] for part in ("topology", "node"))
    document["H"][mode][receiver][receiver][0][0] -= 0.2


def test_an_edited_problem_is_refused() -> None:
    """Without a new digest the file is not even read."""
    document = copy.deepcopy(ALL["paper", "exact"].document())
    document["problem"]["node"][0]["arrival_probability"] = 0.8
    with pytest.raises(InputError, match="the problem was edited afterwards"):
        Gains.from_bytes(json.dumps(document).encode(), source="memory")


def test_a_certificate_without_its_matrices_is_malformed_input() -> None:
    """A missing Q of one node is bad input, named; so is a P of the wrong size."""
    golden = Gains.load(GOLDEN)
    with pytest.raises(InputError, match='Q of mode "2", node "3", is missing'):
        verify(mutated(golden, lambda document: document["certificate"]["Q"]["2"].pop("3")))
    with pytest.raises(InputError, match="it must be 2 x 2"):
        verify(mutated(golden, lambda document: document["certificate"].update(R=[[1.0]])))


@pytest.mark.parametrize(
    ("certificate", "why"),
    [
        ({"form": "summed"}, 'form "summed" has nothing stored for these errors, and no P'),
        ({"horizon": 10**9}, "horizon is 1000000000; a proof takes from 1 to 100000 steps"),
        ({"horizon": -3}, "horizon is -3"),
        ({"R": [[1.0, 0.0], [0.0, 1.0]]}, 'form "full" has "P" for these errors, and no R'),
        ({"form": "structured"}, 'form "structured" has "Q" and "R" for these errors, and no P'),
        ({"P": {"1": [[1.0]]}}, "it must be 10 x 10"),
        ({"P": {}}, 'P of mode "1" is missing; it must be 10 x 10'),
    ],
)
def test_a_certificate_that_no_proof_can_be_read_from_is_refused(certificate: Document, why: str) -> None:
    """At once, in one sentence: a horizon that would take for ever, and matrices of the other form."""
    with pytest.raises(InputError, match=why):
        verify(mutated(ALL["paper", "exact"], lambda document: document["certificate"].update(certificate)))


def test_matrices_that_the_proof_would_not_use_are_refused() -> None:
    """Of modes and nodes that do not exist; an R where the errors do not contain x."""
    golden = Gains.load(GOLDEN)
    with pytest.raises(InputError, match='Q of mode 2: node "9" does not exist; there are "1", "2", "3" and "4"'):
        verify(mutated(golden, lambda document: document["certificate"]["Q"]["2"].update({"9": [[1.0]]})))
    for part, edit in (("Q", {"9": {}}), ("P", {"9": [[1.0]]})):
        gains = golden if part == "Q" else ALL["paper", "exact"]
        with pytest.raises(InputError, match=f'{part}: mode "9" does not exist'):
            verify(mutated(gains, lambda document, part=part, edit=edit: document["certificate"][part].update(edit)))  # type: ignore[misc]
    structured = {"form": "structured", "P": None, "Q": {}, "R": [[1.0]]}
    with pytest.raises(InputError, match='form "structured" has "Q" for these errors, and no R'):
        verify(mutated(ALL["unbiased", "exact"], lambda document: document["certificate"].update(structured)))


@pytest.mark.parametrize("horizon", ["60", 60.0, True])
def test_a_horizon_is_a_whole_number(horizon: object) -> None:
    document = ALL["paper", "exact"].document()
    document["certificate"]["horizon"] = horizon
    with pytest.raises(InputError, match="certificate: horizon: must be a whole number"):
        Gains.from_bytes(json.dumps(document).encode(), source="memory")


@pytest.mark.parametrize("network", ["real", "unbiased"])
def test_with_few_bits_nothing_false_is_proved_and_nothing_true_is_proved_false(network: str) -> None:
    """Every rounding is to the safe side, although over a whole horizon few bits lose more than gamma is off."""
    gains = ALL[network, "exact"]
    assert gains.certificate.exact is not None
    low = gains.certificate.exact[0] * (1.0 - 1e-8)
    false = gains.model_copy(update={"certificate": gains.certificate.model_copy(update={"gamma": low})})
    for bits in (26, 28):
        makes = (partial(ByBalls, bits=bits),)
        assert not verify(false, makes=makes).holds
        assert "it is false" not in str(verify(gains, makes=makes).failure)


@every_arithmetic
@pytest.mark.parametrize("horizon", [1, 2, 3])
def test_the_recursion_has_as_many_steps_as_it_is_given(horizon: int, makes: Sequence[Make]) -> None:
    """Where a step counts: at g below gamma_T^2 a W is false at step T, and above it none is."""
    gains = ALL["real", "exact"]
    by, modes = makes[0](gains.problem, gains.K, gains.H), gains.problem.mode_names
    low, high = (math.sqrt(g) for g in horizon_gain(Operator(model_of(gains)), horizon))
    assert disproof(by, modes, low * (1.0 - 1e-6), most=horizon) is not None
    assert disproof(by, modes, low * (1.0 - 1e-6), most=horizon - 1) is None
    P = lyapunov_matrix(gains)
    for gamma, proved_up_to in ((high * (1.0 + 1e-6), horizon), (low * (1.0 - 1e-6), horizon - 1)):
        found = [finding for finding in recursion(by, modes, gamma, P, most=horizon) if finding.sign.proved]
        assert len(found) == len(modes) * proved_up_to or gamma < low
        assert len(found) < len(modes) * horizon or gamma > low


@every_arithmetic
def test_only_the_symmetric_part_of_P_counts(makes: Sequence[Make]) -> None:
    """x'Px does not see the rest."""
    gains = ALL["real", "lyapunov"]
    P = lyapunov_matrix(gains)
    skew = np.abs(P).max() * np.triu(np.ones_like(P), 1)
    P = P + skew - skew.swapaxes(1, 2)
    verdict = Prover(gains.problem, gains.K, gains.H, P=P, makes=makes).theorem1(gains.certificate.gamma)
    assert verdict.holds
    assert verdict.margins == pytest.approx(verify(gains, makes=makes).margins, rel=1e-3)


def test_rows_of_the_chain_are_divided_by_their_sums() -> None:
    """A row may miss 1 by 1e-9, and then stands for the one that does not."""
    document = find("two-nodes").document()
    document["markov"]["transition"] = [[1.0 - 9e-10]]
    problem = Problem.from_document(document)
    zero = np.zeros((1, 2, 2))
    (row,) = BallModel(problem, *link_gains(problem, zero, zero)).transition
    assert float(abs(sum(row) - 1)) < 1e-30


# both arithmetics
def mutated_at_random(document: Document, rng: np.random.Generator) -> None:
    """Gamma, an entry of P, all of P, a gain, the arrivals, or the chain, by anything from 1 to 1e-9."""
    size = float(rng.choice([-1.0, 1.0]) * 10.0 ** -rng.uniform(0.0, 9.0))
    problem, certificate = document["problem"], document["certificate"]
    mode = str(rng.choice(list(certificate["P"])))
    match int(rng.integers(6)):
        case 0:
            certificate["gamma"] *= 1.0 + 0.1 * size
        case 1:
            i, j = rng.integers(len(certificate["P"][mode]), size=2)
            certificate["P"][mode][i][j] *= 1.0 + size
        case 2:
            certificate["P"] = {name: ((1.0 + size) * np.array(P)).tolist() for name, P in certificate["P"].items()}
        case 3:
            receiver = str(rng.choice(list(document["H"][mode])))
            sender = str(rng.choice(list(document["H"][mode][receiver])))
            document["H"][mode][receiver][sender][0][0] += size
        case 4:
            for node in problem["node"]:
                node["arrival_probability"] = float(
                    np.clip(node["arrival_probability"] * (1.0 + 0.1 * size), 0.01, 1.0)
                )
        case 5:
            chain = np.abs(np.array(problem["markov"]["transition"]) + 0.1 * size * rng.uniform(size=(1, 1)))
            problem["markov"]["transition"] = (chain / chain.sum(axis=1, keepdims=True)).tolist()


def said(verdict: Verdict) -> str:
    return "proved" if verdict.holds else "false" if "it is false" in str(verdict.failure) else "open"


@every_kind
@every_network
def test_both_arithmetics_say_the_same_of_mutants(network: str, kind: Kind) -> None:
    """30 of each certificate, some of which hold still; floats may leave open what balls decide, and nothing else."""
    rng, answers = np.random.default_rng(len(network)), set()
    for _ in range(30):
        mutant = mutated(ALL[network, kind], lambda document: mutated_at_random(document, rng))
        by_floats, by_balls = (said(verify(mutant, makes=makes)) for makes in (FLOATS, BALLS))
        assert by_floats in (by_balls, "open")
        answers.add(by_floats)
    assert answers >= {"proved", "false"}


@every_network
def test_a_P_that_is_not_stored_is_summed(network: str) -> None:
    """The same gamma is proved, in both arithmetics; a lower one is false, and so is that of gains that have more."""
    gains = ALL[network, "exact"]
    claim = gains.certificate.model_copy(update={"form": "summed", "P": None})
    summed = gains.model_copy(update={"certificate": claim})
    assert len(summed.canonical()) < 0.8 * len(gains.canonical())
    worse = mutated(summed, change_one_measurement_gain)
    gain = exact_gain(model_of(worse))
    assert gain.low > gains.certificate.gamma, "this mutant is no mutant"
    for makes in (FLOATS, BALLS):
        assert verify(summed, makes=makes).holds
        assert said(verify(mutated(summed, lower_gamma), makes=makes)) == "false"
        assert said(verify(worse, makes=makes)) == "false"


@every_arithmetic
def test_gains_that_are_not_stable_have_no_P(makes: Sequence[Make]) -> None:
    """Their gamma is false if w reaches what grows; with H = 0 no estimate ever leaves 0, and nothing is said."""
    problem = find("two-nodes")
    K, H = link_gains(problem, 1.5 * np.eye(2)[None], np.eye(2)[None])
    idle = Prover(problem, K, link_gains(problem, np.zeros((1, 2, 2)), np.zeros((1, 2, 2)))[1], makes=makes)
    for prover_of, answer in ((Prover(problem, K, H, makes=makes), "false"), (idle, "open")):
        assert prover_of.P is None
        for verdict in (prover_of.exact(10.0), prover_of.theorem1(10.0)):
            assert said(verdict) == answer
            why = "recursion fails" if answer == "false" else "the errors are not mean-square stable, which is proved"
            assert str(verdict.failure).startswith(why)


@every_arithmetic
@every_network
def test_the_interval_of_the_exact_gain_is_proved(network: str, makes: Sequence[Make]) -> None:
    """Both ends; one that is off by 1e-5 in the wrong direction is proved false, though gamma itself allows for it."""
    gains = ALL[network, "exact"]
    low, high = gains.certificate.exact or (0.0, 0.0)
    proved = low * (1.0 - 1e-9)

    def saying(low: float, gamma: float = high, high: float = high) -> Verdict:
        claim = gains.certificate.model_copy(update={"exact": (low, high), "gamma": gamma})
        return verify(gains.model_copy(update={"certificate": claim}), makes=makes)

    assert saying(proved).low == proved
    assert saying(low / 2.0).low == low / 2.0
    assert saying(high * (1.0 + 1e-5), 2.0 * high).failure == (
        f"the exact gain is below {high * (1.0 + 1e-5)}, where the file says it begins"
    )
    assert not saying(high * (1.0 + 1e-5)).holds
    assert saying(high * (1.0 + 1e-5), 2.0 * high).interval_is_false
    assert not saying(proved, 0.9 * high).interval_is_false
    assert saying(proved, 2.0 * high).low == proved
    ended = low * (1.0 - 1e-5)
    assert saying(0.9 * low, high=ended).failure == (
        f"the exact gain is not below {ended}, where the file says it ends"
    )
    assert saying(proved, high=ended).interval_is_false


def test_what_no_w_attains_is_not_proved_to_be_attained(monkeypatch: pytest.MonkeyPatch) -> None:
    """Neither without steps, nor where the recursion is rounded the other way."""
    gains = ALL["real", "exact"]
    low = (gains.certificate.exact or (0.0, 0.0))[0] * (1.0 - 1e-9)
    prover = Prover(gains.problem, gains.K, gains.H)
    assert prover.at_least(low) is not None
    assert prover.at_least(low, most=1) is None
    assert prover.at_least(gains.certificate.gamma * (1.0 + 1e-6)) is None


@every_arithmetic
@every_network
def test_both_claims_are_proved_of_one_P(network: str, makes: Sequence[Make]) -> None:
    """The exact gain and Theorem 1's bound; each lowered alone is proved false, and named."""
    exact, theorem1 = ALL[network, "exact"], ALL[network, "lyapunov"].certificate.gamma
    both = mutated(exact, lambda document: document["certificate"].update(theorem1_gamma=theorem1))
    verdict = verify(both, makes=makes)
    assert verdict.holds, verdict.failure
    assert verdict.gamma == exact.certificate.gamma < theorem1
    assert {name.split(" mode")[0] for name in verdict.margins} == {"(17)", "(18)", "P > 0", "recursion", "Y < g P"}
    for field, inequality in (("gamma", "recursion"), ("theorem1_gamma", "(18)")):
        lower = (exact.certificate.exact or (0.0, 0.0))[0] if field == "gamma" else theorem1
        claim = both.certificate.model_copy(update={field: lower * (1.0 - 1e-5)})
        verdict = verify(both.model_copy(update={"certificate": claim}), makes=makes)
        assert said(verdict) == "false"
        assert str(verdict.failure).startswith(f"{inequality} fails")


def test_theorem_1_is_the_proof_in_no_steps() -> None:
    """At its own gamma M'M < g P from the start."""
    for makes in (FLOATS, BALLS):
        gains = ALL["paper", "lyapunov"]
        P = lyapunov_matrix(gains)
        verdict = Prover(gains.problem, gains.K, gains.H, P=P, makes=makes).exact(gains.certificate.gamma)
        assert verdict.holds
        assert not any("recursion" in name for name in verdict.margins)


@pytest.mark.parametrize("kind", ["lyapunov", "summed"])
def test_a_second_gamma_needs_a_P_that_is_stored(kind: str) -> None:
    update = {"kind": "lyapunov"} if kind == "lyapunov" else {"form": "summed", "P": None}
    with pytest.raises(ValueError, match='theorem1_gamma stands beside the gamma of kind "exact"'):
        mutated(ALL["paper", "exact"], lambda document: document["certificate"].update(theorem1_gamma=9.0, **update))


def test_what_floats_leave_open_is_asked_of_balls_up_to_a_size(monkeypatch: pytest.MonkeyPatch) -> None:
    """1e-14 below the exact gain of two nodes that hear nothing; beyond that size one sentence says what is open."""
    problem = find("two-nodes")
    K, H = link_gains(problem, np.zeros((1, 2, 2)), np.zeros((1, 2, 2)))
    P = np.diag([2.0**-6, 2.0**-12, 2.0**-12])[None]
    gamma = 2.0**6 * (1.0 + 2.0**-52)
    assert said(Prover(problem, K, H, P=P, makes=FLOATS).theorem1(gamma)) == "open"
    verdict = Prover(problem, K, H, P=P).theorem1(gamma)
    assert verdict.holds
    assert "ball arithmetic" in verdict.arithmetic
    monkeypatch.setattr(prover, "_LARGEST_INEQUALITY", 2)
    verdict = Prover(problem, K, H, P=P).theorem1(gamma)
    assert not verdict.holds
    assert "(18) fails" in str(verdict.failure)
    assert "(ball arithmetic, which sees further, is asked up to 2 states of the errors) leaves open" in str(
        verdict.failure
    )
    assert Prover(problem, K, H, P=P, makes=BALLS).theorem1(gamma).holds


# the recursion has teeth: with a part of the proof believed, a gamma that is false passes
@every_arithmetic
@pytest.mark.parametrize("believed", ["inequality_17", "below"])
def test_17_and_the_end_of_the_recursion_are_what_refuses(
    believed: str, makes: Sequence[Make], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A P that is too large is above every Y and not invariant; one that is invariant is not above Y at once."""
    gains = ALL["real", "exact"]
    assert gains.certificate.exact is not None
    gamma, P = 0.5 * gains.certificate.exact[0], lyapunov_matrix(gains)
    P = 1e6 * P if believed == "inequality_17" else P
    monkeypatch.setattr(recursion_module, "seems_below", lambda Y, P, gamma: True)
    assert said(Prover(gains.problem, gains.K, gains.H, P=P, makes=makes).exact(gamma)) == "false"
    for arithmetic in (ByFloats, ByBalls):
        monkeypatch.setattr(arithmetic, believed, lambda self, *given: [balls.Sign(True, False, 1.0)] * 2)
    assert Prover(gains.problem, gains.K, gains.H, P=P, makes=makes).exact(gamma).holds


# the checker has teeth: with a part of the model taken away, what is false passes
@every_arithmetic
@pytest.mark.parametrize(
    ("network", "kept"),
    [("paper", "nothing"), *((name, kept) for name in list(networks())[1:] for kept in ("losses", "links", "nothing"))],
)
def test_without_some_chance_a_false_certificate_would_pass(
    network: str, kept: str, makes: Sequence[Make], monkeypatch: pytest.MonkeyPatch
) -> None:
    """P and gamma made for errors without some of their chance are proved once the checker forgets that chance too."""
    gains, model = ALL[network, "exact"], model_of(ALL[network, "exact"])
    without: dict[str, Any] = {"losses": {"links": None}, "links": {"alpha": 0.0 * model.alpha}}
    if kept == "links" and model.links is not None:
        links = model.links
        without["links"]["links"] = replace(links, variance=np.where(links.with_loss, 0.0, links.variance))
    without["nothing"] = without["losses"] | {"alpha": 0.0 * model.alpha}
    gain = exact_gain(replace(model, **without[kept]))
    assert gain.P is not None
    P = dict(zip(gains.problem.mode_names, gain.P, strict=True))
    updated = {"P": P, "gamma": gain.high * (1.0 + 1e-6), "exact": None}
    false = gains.model_copy(update={"certificate": gains.certificate.model_copy(update=updated)})
    assert not verify(false, makes=makes).holds
    for module in ("by_balls", "by_floats"):
        monkeypatch.setattr(f"designer.proof.{module}.BallModel", forgetful(kept))
    assert verify(false, makes=makes).holds


def forgetful(kept: str) -> type[BallModel]:
    """The checker's model with only some of its noise."""

    class Forgetful(BallModel):
        def _sensor(self, problem: Problem, j: int) -> Sensor:
            sensor = super()._sensor(problem, j)
            return sensor if kept == "losses" else sensor._replace(alpha=arb(0))

        def _mode(self, problem: Problem, s: int, K: LinkMatrices, H: LinkMatrices) -> list[Noise]:
            noise = super()._mode(problem, s, K, H)
            of_sensors = sum(sensor.alpha > 0 for sensor in self.sensors)  # they come last
            return noise if kept == "links" else noise[len(noise) - of_sensors :]

    return Forgetful


def test_the_implied_gain_counts_not_the_stored_one(monkeypatch: pytest.MonkeyPatch) -> None:
    """Unbiased nodes step by a_ii K_ii = A - sum of the others, so K_ii of the file changes nothing."""
    gains = ALL["unbiased", "lyapunov"]
    K = copy.deepcopy(gains.K)
    for links in K.values():
        for receiver, heard in links.items():
            heard[receiver] = heard[receiver] + 1e-3
    model, other = (BallModel(gains.problem, stored, gains.H) for stored in (gains.K, K))
    assert all(a.overlaps(b) for a, b in zip(model.AB, other.AB, strict=True))
    biased = ALL["real", "lyapunov"]
    K = copy.deepcopy(biased.K)
    K["m0"]["n0"]["n0"] = K["m0"]["n0"]["n0"] + 1e-3
    model, other = (BallModel(biased.problem, stored, biased.H) for stored in (biased.K, K))
    assert not model.AB[0].overlaps(other.AB[0])


# the model in balls
VARIANTS = [
    {"seen": seen, "delivery": delivery, "unbiased": unbiased}
    for seen in (False, ["n1"], True)
    for delivery in (None, 0.75)
    for unbiased in (False, True)
]


@pytest.mark.parametrize("variant", VARIANTS, ids=str)
def test_both_error_models_are_one(variant: dict[str, Any]) -> None:
    """Link by link in balls and by stacked matrices in floats, written independently: midpoints within rounding."""
    problem = real_network(random_problem(7, n=4), **variant)
    K_bar, H_bar = random_gains(problem, 7)
    if problem.unbiased:
        blocks = K_bar.reshape(2, problem.n, problem.nx, problem.n, problem.nx)
        for i in range(problem.n):
            blocks[:, i, :, i] += problem.plant.A - blocks[:, i].sum(axis=2)
    model = error_model(problem, K_bar, H_bar)
    operator = Operator(model)
    Y = np.random.default_rng(7).normal(size=(2, model.size, model.size))
    Y += Y.swapaxes(1, 2)
    ball_model = BallModel(problem, *link_gains(problem, K_bar, H_bar))
    joint = np.array([floats(S) for S in ball_model.joint([exact(Y_s) for Y_s in Y])])
    np.testing.assert_allclose(joint, operator.joint(operator.bar(Y)), rtol=0, atol=1e-13 * np.abs(joint).max())
    AB = np.concatenate([model.A, model.B], axis=2)
    np.testing.assert_allclose([floats(each) for each in ball_model.AB], AB, rtol=0, atol=1e-14)
    np.testing.assert_array_equal(floats(ball_model.M), model.M)


def partly_joined(problem: Problem) -> Array:
    """P = diag{R, Q_1(s), ...} with diagonal blocks, but for one entry that joins the first two nodes in one mode."""
    p, nx = problem.plant_states, problem.nx
    P = np.tile(2.0 * np.eye(p + problem.n * nx), (len(problem.mode_names), 1, 1))
    P[-1, p, p + nx] = P[-1, p + nx, p] = 0.5
    return P


@pytest.mark.parametrize("variant", VARIANTS, ids=str)
def test_the_blocks_of_P_change_nothing(variant: dict[str, Any]) -> None:
    """What is summed by the blocks of P is what the whole matrix gives; that of other blocks differs."""
    problem = real_network(random_problem(7, n=4), **variant)
    zero = np.zeros((2, problem.n * problem.nx, problem.n * problem.nx))
    model = BallModel(problem, *link_gains(problem, zero + 0.1, random_gains(problem, 7)[1]))
    P = partly_joined(problem)
    P_balls, found = symmetric(P), by_balls._blocks(model, P)
    joined = [block for block in found if model.e[0][0] in block]
    assert joined == [model.e[0] + model.e[1]]
    assert sorted(k for block in found for k in block) == model.eta
    whole, by_blocks = model.joint(P_balls), model.joint(P_balls, found)
    assert all(a.overlaps(b) for a, b in zip(whole, by_blocks, strict=True))
    wrong = model.joint(P_balls, [[k] for k in model.eta])
    assert not all(a.overlaps(b) for a, b in zip(whole, wrong, strict=True))
    assert all(((AB != 0.0) <= filled).all() for AB, filled in zip(map(floats, model.AB), model.filled, strict=True))


def test_18_sees_what_joins_the_states_of_a_node() -> None:
    """Every diagonal entry of P is above that of M'M / gamma^2, and P is not above it."""
    document = find("two-nodes").document()
    document["plant"].update(A=[[0.5, 0.0], [0.0, 0.5]], B=[[1.0], [1.0]], M=[[1.0, 1.0]])
    for node in document["node"]:
        node.update(C=[[1.0, 0.0]], D=[[1.0]])
    problem = Problem.from_document(document)
    zero = np.zeros((1, 4, 4))
    for make, (p, holds) in product(FLOATS + BALLS[:1], ((1.5, False), (2.5, True))):
        by = make(problem, *link_gains(problem, zero, zero[:, :, :2]))
        (sign,) = by.inequality_18(p * np.eye(6)[None], 1.0)
        assert (sign.proved, sign.refuted) == (holds, not holds)


# signs
def with_eigenvalues(values: list[float], seed: int) -> tuple[arb_mat, Array]:
    """A symmetric matrix of these eigenvalues but for roundings of 2^-100, exactly as stored; and its diagonal."""
    with ctx.workprec(100):
        rng = np.random.default_rng(seed)
        S, order = exact(np.diag(values)), len(values)
        for _ in range(3):  # reflections by rational vectors, exactly orthogonal but for the 100 bits
            v = exact(rng.integers(-9, 10, size=(order, 1)).astype(float))
            length = (v.transpose() * v)[0, 0]
            reflection = balls.identity(order) - v * v.transpose() * (2 / length)
            S = reflection * S * reflection
        S = ((S + S.transpose()) * arb(0.5)).mid()
    return S, np.ones(order)


@pytest.mark.parametrize("least", [1e-3, 1e-12, 1e-20, 1e-24])
def test_the_sign_of_a_matrix_is_found_far_below_what_floats_resolve(least: float) -> None:
    """Positive: proved. Its negative counterpart: proved false. Neither is ever said of the other."""
    for seed in range(5):
        positive = sign(*with_eigenvalues([1.0, 0.7, 0.7, 2.0, 1.5, least], seed))
        assert positive.proved
        assert not positive.refuted
        assert positive.least == pytest.approx(least, rel=1e-2)
        negative = sign(*with_eigenvalues([1.0, 0.7, 0.7, 2.0, 1.5, -least], seed))
        assert negative.refuted
        assert not negative.proved
        assert negative.least == pytest.approx(-least, rel=1e-2)


def test_a_singular_matrix_has_neither_sign() -> None:
    """vv' is not positive definite, and no direction shows it: both answers would be wrong."""
    v = np.random.default_rng(1).integers(-9, 10, size=(5, 3)).astype(float)
    found = sign(exact(v @ v.T), (v @ v.T).diagonal())
    assert not found.proved
    assert not found.refuted


def test_a_matrix_that_falls_apart_has_the_sign_of_its_blocks() -> None:
    """Blocks mixed by a permutation: the least counts; a radius joins blocks whose entries between them are 0."""
    order = [3, 0, 4, 1, 2]
    for least, proved in ((1e-20, True), (-1e-20, False)):
        S = np.diag([1.0, 1.0, 1.0, 2.0, least])
        S[:2, :2] = [[1.0, 0.5], [0.5, 1.0]]
        found = sign(exact(S[order][:, order]), np.ones(5))
        assert (found.proved, found.refuted, found.least) == (proved, not proved, least)
    joined = exact(np.diag([1e-3, 1e-3]))
    assert sign(joined, np.ones(2)).proved
    joined[0, 1] = joined[1, 0] = arb(0, 1e-2)
    assert not sign(joined, np.ones(2)).proved


def test_radii_count() -> None:
    """The midpoint alone is positive definite, and stays so with small radii; with larger ones nothing is said."""
    for radius, proved in ((1e-6, True), (1e-3, False)):
        S = arb_mat(2, 2, [arb(1, radius), arb(0.999, radius), arb(0.999, radius), arb(1, radius)])
        found = sign(S, np.ones(2))
        assert found.proved is proved
        assert not found.refuted


def test_a_ball_with_members_of_either_sign_has_none() -> None:
    """Off the diagonal radii below 1 leave the identity positive; on it, one beyond the middle says nothing."""
    for radius, proved in ((0.9, True), (1.1, False)):
        S = arb_mat(2, 2, [arb(1), arb(0, radius), arb(0, radius), arb(1)])
        assert sign(S, np.ones(2)).proved is proved
    for middle in (-0.1, 0.1):
        found = sign(arb_mat(1, 1, [arb(middle, 0.2)]), np.ones(1))
        assert (found.proved, found.refuted) == (False, False)


@pytest.mark.parametrize("probability", [1e-300, 1.0 - 2.0**-53])
def test_no_chance_is_too_small_to_count(probability: float) -> None:
    """Every probability below 1, however near to 0 or 1, has its terms."""
    document = find("two-nodes").document()
    for node in document["node"]:
        node["arrival_probability"] = probability
    document["link"] = [{"receiver": "left", "sender": "right", "delivery_probability": probability}]
    zero = np.zeros((1, 2, 2))
    problem = Problem.from_document(document)
    (noise,) = BallModel(problem, *link_gains(problem, zero, zero)).noise
    assert len(noise) == 4  # of two sensors, of the link, and of the link and its sender


def test_what_overflows_is_left_undecided() -> None:
    """Numbers outside the range of floats are no sign and no exception."""
    found = sign(exact(np.eye(2)) * arb(2) ** 5000, np.full(2, np.inf))
    assert found == balls.UNDECIDED


def test_above_and_below_enclose_every_matrix_of_the_ball() -> None:
    """Radius 0, symmetric, and on its side of extreme members of the ball."""
    rng = np.random.default_rng(2)
    for _ in range(20):
        Y = rng.normal(size=(4, 4))
        Y += Y.T
        radii = np.exp2(-rng.integers(1, 30, size=(4, 4)))
        radii = np.maximum(radii, radii.T)
        ball = arb_mat(4, 4, [arb(m, r) for m, r in zip(Y.ravel().tolist(), radii.ravel().tolist(), strict=True)])
        signs = np.sign(rng.normal(size=4))
        upper, lower = above(ball), below(ball)
        for matrix in (upper, lower):
            assert all(entry.rad() == 0 for entry in matrix.entries())
            assert (floats(matrix) == floats(matrix).T).all()
        extreme = radii * signs * signs[:, None]  # its largest eigenvalue is the largest of all, up to the signs
        assert sign(upper - exact(Y + extreme) + balls.identity(4) * arb(2) ** -60, np.ones(4)).proved
        assert sign(exact(Y - extreme) - lower + balls.identity(4) * arb(2) ** -60, np.ones(4)).proved


def test_too_few_bits_are_doubled() -> None:
    """(18) with 1e-9 to spare cannot be told with 20 bits: not proved with those alone, proved with more."""
    gains, few = ALL["paper", "lyapunov"], partial(ByBalls, bits=20)
    verdict = verify(gains, makes=[few])
    assert not verdict.holds
    assert verdict.failure is not None
    assert "it is not proved" in verdict.failure
    assert "which ball arithmetic of 20 bits (flint" in verdict.failure
    assert min(verdict.margins.values()) <= 0.0
    verdict = verify(gains, makes=[few, *BALLS])
    assert verdict.holds
    assert "128 bits" in verdict.arithmetic


@every_arithmetic
def test_what_is_singular_in_exact_arithmetic_is_not_proved_and_not_refuted(makes: Sequence[Make]) -> None:
    """P = M'M / gamma^2 on one state meets (18) with equality; with 1e-12 to spare it is proved, or proved false."""
    problem = find("two-nodes")
    K, H = link_gains(problem, np.zeros((1, 2, 2)), np.zeros((1, 2, 2)))
    P = np.diag([2.0**-6, 2.0**-12, 2.0**-12])[None]
    for spare, text in ((0.0, "it is not proved"), (1e-12, None), (-1e-12, "it is false")):
        verdict = Prover(problem, K, H, P=P, makes=makes).theorem1(2.0**6 * (1.0 + spare))
        assert verdict.holds is (text is None), verdict
        assert text is None or f'(18) fails in mode "linked": {text}' in str(verdict.failure)


# backing off
@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("real", [False, True])
def test_gains_without_any_lmi_get_a_certificate_from_the_lyapunov_equation(seed: int, real: bool) -> None:
    """For mean-square stable gains a small enough multiple of P0 satisfies (17), so the back-off has a start."""
    problem = random_problem(seed)
    if real:
        problem = real_network(problem, seen=True, delivery=0.9)
    K_bar, H_bar = random_gains(problem, seed, size=0.1)
    model = error_model(problem, K_bar, H_bar)
    P0 = coupled_lyapunov(model, np.tile(np.eye(len(model.A[0])), (2, 1, 1)))
    assert P0 is not None
    confirmed = back_off(problem, *link_gains(problem, K_bar, H_bar), 1e-3 * P0 / np.abs(P0).max())
    assert confirmed.verdict.holds


@every_network
def test_a_P_that_misses_17_by_a_little_is_backed_off(network: str) -> None:
    """P on the boundary of (17), moved 1e-9 out of it: what comes back is proved, and gamma hardly grew."""
    gains = ALL[network, "lyapunov"]
    problem, K, H, model = gains.problem, gains.K, gains.H, model_of(gains)
    P = np.array([gains.certificate.P[mode] for mode in problem.mode_names])  # type: ignore[index]
    inside, outside = 1.0, 2.0
    for _ in range(60):
        middle = (inside + outside) / 2.0
        inside, outside = (
            (middle, outside) if np.linalg.eigvalsh(inequality_17(model, middle * P)).min() > 0.0 else (inside, middle)
        )
    P *= outside * (1.0 + 1e-9)
    verdict = Prover(problem, K, H, P=P).theorem1(2.0 * gains.certificate.gamma)
    assert verdict.failure is not None
    assert verdict.failure.startswith("(17)")
    confirmed = back_off(problem, K, H, P)
    assert confirmed.verdict.holds, confirmed.verdict.failure
    assert confirmed.t > 0.0
    assert confirmed.verdict.gamma < least_gamma(model.M, P) * (1.0 + 1e-4)


@every_network
def test_a_backed_off_P_has_t_to_spare(network: str) -> None:
    """(1 - t)(P + tau P0) has at least about t I more than (1 - t) P in w, wherever noise acts."""
    model = model_of(ALL[network, "lyapunov"])
    P = np.tile(np.eye(model.size), (model.modes, 1, 1))
    P0 = coupled_lyapunov(model, P)
    assert P0 is not None
    for t in (1e-3, 1e-1):
        gained = inequality_17(model, relaxed(model, P, P0, t)) - (1.0 - t) * inequality_17(model, P)
        assert np.linalg.eigvalsh(gained).min() > 0.0


def test_unstable_gains_are_never_confirmed() -> None:
    """Gains whose error grows in the mean square have no P, and the back-off says so."""
    problem = random_problem(1)
    K_bar, H_bar = random_gains(problem, 1, size=0.1)
    K_bar = K_bar + 1.5 * np.eye(len(K_bar[0]))
    model = error_model(problem, K_bar, H_bar)
    P = np.tile(np.eye(len(model.A[0])), (2, 1, 1))
    assert coupled_lyapunov(model, P) is None
    confirmed = back_off(problem, *link_gains(problem, K_bar, H_bar), P)
    assert not confirmed.verdict.holds
    assert confirmed.verdict.failure is not None


# the command
def test_the_command_says_what_is_proved_and_in_which_arithmetic(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Both kinds; with --json the keys that other tools rely on."""
    for kind, proved in (("lyapunov", "(17) and (18) of Theorem 1"), ("exact", "the recursion of the exact gain")):
        path = tmp_path / f"{kind}.json"
        gains = ALL["paper", kind]  # type: ignore[index]
        gains.save(path)
        assert main(["verify", str(path)]) == EXIT_GOOD
        out = capsys.readouterr().out
        for part in (
            f"holds: gamma = {gains.certificate.gamma} is proved",
            "mean-square stability",
            proved,
            "in      float64 with a bound on every rounding",
            " s\n",
        ):
            assert part in out
    false = tmp_path / "false.json"
    mutated(ALL["paper", "exact"], lower_gamma).save(false)
    assert main(["verify", str(false), "--json"]) == EXIT_NO
    said = json.loads(capsys.readouterr().out)
    assert said["holds"] is False
    assert {"gamma", "arithmetic", "failure"} <= set(said)
    assert main(["verify", str(false)]) == EXIT_NO
    assert "does not hold: " in capsys.readouterr().out


@every_kind
def test_verifying_imports_no_solver(kind: Kind, tmp_path: Path) -> None:
    """The proof runs in a process that never loads cvxpy, a conic solver or what scipy has of them."""
    path = tmp_path / "gains.json"
    ALL["paper", kind].save(path)
    code = (
        "import sys; from pathlib import Path; from agent.contract.gains import Gains;"
        "from designer.proof.certificate import verify; assert verify(Gains.load(Path(sys.argv[1]))).holds;"
        "print(sorted({'cvxpy', 'clarabel', 'scs', 'scipy.optimize'} & set(sys.modules)))"
    )
    root = ROOT
    done = subprocess.run([sys.executable, "-c", code, path], cwd=root, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
