"""Where M cancels: the same network in other coordinates, and the same answers as with 600 bits."""

from __future__ import annotations

import math
from fractions import Fraction
from typing import Any

import numpy as np
import pytest
from flint import arb, arb_mat, ctx
from networks import random_gains, random_problem, real_networks

from agent.contract.arrays import Array
from agent.contract.gains import LinkMatrices
from agent.contract.problem import Problem
from designer import problems
from designer.analysis import certified, given
from designer.beyond_gamma import beyond_gamma
from designer.box.extent import Box, box_of, corners, within
from designer.box.robust import proved_at, robust
from designer.box.worst import there_of, worst
from designer.coordinates import Coordinates, fractions
from designer.gain.exact import Operator, exact_gain, lyapunov, node_gains
from designer.gain.noise import long_run, steady_state
from designer.gain.worst_case import worst_fixed
from designer.ledger.deviation import Deviation
from designer.ledger.exact import Ledger
from designer.model.error_model import error_model, link_gains, model_of_gains, stacked_links
from designer.model.units import NaturalUnits
from designer.proof.ball_model import BallModel
from designer.proof.balls import part
from designer.proof.by_balls import ByBalls
from designer.proof.by_floats import ByFloats
from designer.proof.by_vertices import upper_bound
from designer.proof.certificate import verify
from designer.proof.cube import Cube
from designer.proof.least import at_least
from designer.search.exact_design import certify, design_exact
from designer.search.lmi_apart import design_apart
from designer.search.starts import consensus_gains, ignoring, least_variance_gains
from designer.start import from_start
from designer.undercut import undercut

KINDS: dict[str, dict[str, Any]] = {
    "hidden losses": {},
    "seen losses, links": {"loss": "seen", "link": 0.9},
    "hidden losses, links, two rows": {"link": 0.8, "rows": 2},
    "unbiased": {"loss": "seen", "unbiased": True, "link": 0.9},
}


def cancelling(
    epsilon: float, *, loss: str = "hidden", link: float = 1.0, rows: int = 1, unbiased: bool = False
) -> Problem:
    """Two nodes, and z = x_1 - (1 + epsilon) x_2, which w moves alike; with two rows epsilon x_3 beside it."""
    M = [[1.0, -1.0 - epsilon, 0.0], [0.0, 0.0, epsilon]][:rows]
    nodes = [
        {"name": "a", "C": [[0.2, -0.6, 0.3]], "D": [[0.6, 0.1]], "arrival_probability": 0.8},
        {"name": "b", "C": [[0.5, -0.1, 0.1]], "D": [[-0.7, 0.2]], "arrival_probability": 0.9},
    ]
    document: dict[str, Any] = {
        "name": "cancelling",
        "plant": {
            "A": [[0.5, 0.0, 0.0], [0.0, 0.5, 0.0], [0.1, 0.0, 0.6]],
            "B": [[0.7, 0.0]] * 2 + [[0.3, 1.0]],
            "M": M,
        },
        "node": [{**node, "loss": loss} for node in nodes],
        "topology": [{"name": name, "adjacency": [[1.0, 0.5], [a, 1.0]]} for name, a in (("one", 1.0), ("two", 0.0))],
        "markov": {"transition": [[0.7, 0.3], [0.4, 0.6]], "initial": "one"},
    }
    if link < 1.0:
        document["link"] = [{"sender": "b", "receiver": "a", "delivery_probability": link}]
    return Problem.from_document(document | ({"unbiased": True} if unbiased else {}))


def good_gains(problem: Problem) -> tuple[LinkMatrices, LinkMatrices]:
    """Gains that know that z is small, rounded as a file would."""
    coordinates = Coordinates.of(problem)
    assert coordinates is not None
    return coordinates.back(*link_gains(coordinates.problem, *consensus_gains(coordinates.problem, weight=0.3)))


class ManyBits:
    """The recursions with 600 bits, of the states as they are."""

    def __init__(self, problem: Problem, K: LinkMatrices, H: LinkMatrices) -> None:
        self.by = ByBalls(problem, K, H, bits=600)
        self.often = long_run(problem.markov.transition, 0)

    def holds(self, M: arb_mat, gamma: float, steps: int) -> bool:
        """Whether gamma_T is not above gamma."""
        with ctx.workprec(600):
            Y = [M.transpose() * M] * len(self.by.model.AB)
            for _ in range(steps):
                signs, Y = self.by.step(Y, gamma, up=False)
                if not all(sign.proved for sign in signs):
                    assert any(sign.refuted for sign in signs), "600 bits decide"
                    return False
        return True

    def noise(self, M: arb_mat, steps: int) -> float:
        """E|M eta|^2 of white w, from as many steps before."""
        model, total = self.by.model, arb(0)
        with ctx.workprec(600):
            Y = [M.transpose() * M] * len(model.AB)
            for _ in range(steps):
                S = model.joint(Y)
                for often, S_s in zip(self.often, S, strict=True):
                    total += sum((S_s[k, k] for k in model.w), arb(0)) * float(often)
                Y = [part(S_s, model.eta, model.eta) for S_s in S]
        return float(total)


# the coordinates
def test_where_nothing_cancels_there_are_none() -> None:
    known = [problems.find(name) for name in problems.names()] + [random_problem(seed) for seed in range(5)]
    assert [problem.name for problem in known if Coordinates.of(problem) is not None] == []


@pytest.mark.parametrize("rows", [1, 2])
@pytest.mark.parametrize("epsilon", [1e-3, 1e-6, 1e-10])
def test_a_row_that_cancels_becomes_a_state(epsilon: float, rows: int) -> None:
    problem = cancelling(epsilon, rows=rows)
    coordinates = Coordinates.of(problem)
    assert coordinates is not None
    assert np.count_nonzero(coordinates.problem.plant.M, axis=1).tolist() == [1] * rows
    assert Coordinates.of(coordinates.problem) is None
    assert {tuple(row) for row in coordinates.T} <= {*map(tuple, problem.plant.M), *map(tuple, np.eye(3))}


def test_rows_that_cancel_against_each_other_become_a_state_each() -> None:
    document = cancelling(0.25).document()
    document["plant"]["M"] = [[1.0, -1.0000001, 0.0], [1.0, -1.0, -1e-13]]
    coordinates = Coordinates.of(Problem.from_document(document))
    assert coordinates is not None
    assert (np.count_nonzero(coordinates.problem.plant.M, axis=1) == 1).all()


@pytest.mark.parametrize("epsilon", [1e-3, 1e-10])
def test_every_number_is_rounded_once(epsilon: float) -> None:
    """T A = A' T and the like, in fractions, but for half a unit in the last place of each entry of A'."""
    problem = cancelling(epsilon, rows=2)
    coordinates = Coordinates.of(problem)
    assert coordinates is not None
    T, identity = fractions(coordinates.T), fractions(np.eye(3))
    there, given = coordinates.problem, problem
    assert (T @ coordinates.inverse == identity).all()
    pairs = [
        (T @ fractions(given.plant.B), there.plant.B),
        (T @ fractions(given.plant.A) @ coordinates.inverse, there.plant.A),
    ]
    pairs += [(fractions(given.plant.M) @ coordinates.inverse, there.plant.M)]
    pairs += [(fractions(a.C) @ coordinates.inverse, b.C) for a, b in zip(given.nodes, there.nodes, strict=True)]
    for exact, rounded in pairs:
        assert (abs(exact - fractions(rounded)) <= abs(fractions(rounded)) * Fraction(1, 2**53)).all()


@pytest.mark.parametrize("kind", KINDS)
def test_gains_come_back_as_they_went(kind: str) -> None:
    """But for a rounding, of which K_ij in these coordinates makes at most what its largest entry makes of it."""
    problem = cancelling(1e-6, **KINDS[kind])
    coordinates = Coordinates.of(problem)
    assert coordinates is not None
    gains = link_gains(problem, *consensus_gains(problem))
    back = coordinates.back(*coordinates.there(*gains))
    for before, after in zip(gains, back, strict=True):
        np.testing.assert_allclose(stacked(problem, after), stacked(problem, before), rtol=0.0, atol=1e-15)


def stacked(problem: Problem, matrices: LinkMatrices) -> Array:
    return np.array([G for of_mode in matrices.values() for row in of_mode.values() for G in row.values()])


def test_powers_of_two_change_no_bit_of_the_problem_that_is_searched() -> None:
    problem, units = cancelling(1e-6, rows=2), np.array([2.0**20, 2.0**-7, 2.0**3])
    document = problem.document()
    plant = problem.plant
    document["plant"] |= {
        "A": (plant.A * units / units[:, None]).tolist(),
        "B": (plant.B / units[:, None]).tolist(),
        "M": (plant.M * units * 2.0**-9).tolist(),
    }
    for node in document["node"]:
        node["C"] = (np.array(node["C"]) * units).tolist()
    here, there = (NaturalUnits(each, Coordinates.of(each)) for each in (problem, Problem.from_document(document)))
    assert here.problem.document() == there.problem.document()
    assert here.held is not None
    assert there.held is not None
    assert (here.held == there.held).all()


# the proof's model
@pytest.mark.parametrize("kind", real_networks(1))
def test_the_model_of_a_proof_is_the_same_in_any_coordinates(kind: str) -> None:
    """S(T'YT) of the states as they are is S(Y) of [T x; T e], seen from there, whatever may get lost."""
    problem = real_networks(1)[kind]
    K, H = link_gains(problem, *random_gains(problem, 2))
    T = np.array([[1.0, -1.25], [0.0, 1.0]])
    given, turned = BallModel(problem, K, H), BallModel(problem, K, H, T=T)
    whole = np.kron(np.eye(given.size // 2), T)
    both = np.block([[whole, np.zeros((given.size, given.nw))], [np.zeros((given.nw, given.size)), np.eye(given.nw)]])
    Y = np.random.default_rng(0).normal(size=(2, given.size, given.size))
    Y = Y + Y.swapaxes(1, 2)
    there, here = (ByFloats(problem, K, H, T=each).model.weigh for each in (T, None))
    np.testing.assert_allclose(both.T @ there(Y) @ both, here(whole.T @ Y @ whole), rtol=0.0, atol=1e-12)
    with ctx.workprec(128):
        assert (turned.M * arb_mat(whole.tolist()) - given.M).contains(arb_mat(given.M.nrows(), given.size))


# the answers
@pytest.mark.parametrize(
    ("epsilon", "kind"),
    [(1e-3, "unbiased"), (1e-6, "seen losses, links"), (1e-10, "hidden losses, links, two rows"), (1e-10, "unbiased")],
)
def test_what_is_said_of_gains_is_what_600_bits_say(epsilon: float, kind: str) -> None:
    problem = cancelling(epsilon, **KINDS[kind])
    K, H = good_gains(problem)
    model, bits = model_of_gains(problem, K, H), ManyBits(problem, K, H)
    gain, nodes, noise = exact_gain(model), node_gains(model), steady_state(model, initial=0)
    assert nodes is not None
    assert noise is not None
    with ctx.workprec(600):
        M = bits.by.model.M
        rows = [part(M, range(i * problem.nz, (i + 1) * problem.nz), range(M.ncols())) for i in range(2)]
    for of_M, steps, (low, high) in zip((M, *rows), (gain.horizon, 60, 60), (gain[:2], *nodes), strict=True):
        assert bits.holds(of_M, high, 60)
        assert not bits.holds(of_M, low * (1.0 - 1e-9), steps)
        assert high < low * (1.0 + 1e-4)
    assert [bits.noise(M_i, 60) for M_i in rows] == pytest.approx(noise.nodes, rel=1e-9)
    certificate = certify(problem, K, H)
    assert certificate.exact is not None
    assert certificate.gamma < gain.high * (1.0 + 1e-8)
    assert certificate.exact[0] >= gain.low * (1.0 - 1e-8)


def test_the_worst_fixed_w_is_below_the_exact_gain_and_not_nothing() -> None:
    problem = cancelling(1e-10)
    model = model_of_gains(problem, *good_gains(problem))
    assert 0.5 * exact_gain(model).low < worst_fixed(model, initial=0).gain < exact_gain(model).high


def test_the_search_finds_gains_that_a_file_can_hold() -> None:
    """Less than half of what there is without measurements, and no entry of theirs is large."""
    problem = cancelling(1e-10)
    natural = NaturalUnits(problem, Coordinates.of(problem))
    assert natural.held is not None
    assert natural.held.any()
    start = least_variance_gains(natural.problem, natural.held)
    found = design_exact(natural.problem, starts={"start": start}, first=3e-3, last=3e-3, held=natural.held)
    K, H = natural.back(found.K, found.H)
    assert max(np.abs(stacked(problem, gains)).max() for gains in (K, H)) < 10.0
    idle = exact_gain(model_of_gains(problem, *link_gains(problem, *ignoring(problem)))).high
    assert certify(problem, K, H).gamma < 0.5 * idle
    bound = found.certificate.gamma * natural.output
    assert certify(problem, K, H).gamma == pytest.approx(bound, rel=1e-3)


def test_gains_of_each_node_and_noise_are_told() -> None:
    problem = cancelling(1e-10)
    facts = beyond_gamma(problem, *good_gains(problem))
    assert facts.noise is not None
    assert facts.gains is not None
    assert math.sqrt(facts.noise.total) < 1e-8


def test_what_an_initial_error_adds_is_what_sums_of_it_add() -> None:
    """The gains forget it; at step 0 it leaves |M x(0)| of each node, which is what is found and what P knows of."""
    document = cancelling(1e-10).document()
    document["plant"]["initial_error"] = [0.1, 0.1, 0.0]
    problem = Problem.from_document(document)
    gains = good_gains(problem)
    start = from_start(problem, *gains)
    assert start is not None
    assert start.alone is not None
    assert start.gamma_P is not None
    assert start.V is not None
    assert start.alone == pytest.approx(0.2 * math.sqrt(2.0), rel=1e-8)
    assert start.gamma_P**2 * start.V >= start.alone**2
    assert exact_gain(model_of_gains(problem, *gains)).low < start.gamma_P < 1e-8


# the LMI
@pytest.fixture(scope="module")
def driven() -> Problem:
    """One node whose noise is its own, and a w of its own in z: the LMI has an optimum with weights everywhere."""
    return Problem.from_document(
        {
            "name": "driven",
            "plant": {
                "A": [[0.5, 0.1], [0.1, 0.5]],
                "B": [[0.7, 0.0, 3e-7], [0.7, 0.0, 0.0]],
                "M": [[1.0, -1.0000001]],
            },
            "node": [{"name": "a", "C": [[0.2, -0.6]], "D": [[0.0, 0.6, 0.0]], "arrival_probability": 0.8}],
            "topology": [{"name": "one", "adjacency": [[1.0]]}],
            "markov": {"transition": [[1.0]], "initial": "one"},
        }
    )


def test_what_the_LMI_cannot_undercut_is_proved_of_the_states_as_they_are(driven: Problem) -> None:
    """Weights on [T x; T e; w] prove the same of both; too much weight on w proves less, and none that is not >= 0."""
    coordinates = Coordinates.of(driven)
    assert coordinates is not None
    weights = undercut(driven).weights
    assert weights is not None
    V, T = weights.matrices(driven.mode_names), weights.states
    units = np.diag(1.0 / NaturalUnits(driven, coordinates).state)
    there, here = at_least(coordinates.problem, V, units), at_least(driven, V, T)
    assert there is not None
    assert here == pytest.approx(there, rel=1e-9)
    assert at_least(driven, V) is None, "which are no weights on [x; e; w]"
    V[0, -1, -1] *= 1.01
    less = at_least(driven, V, T)
    assert less is not None
    assert less < there
    V[0, -1, -1] *= -1.0
    assert at_least(driven, V, T) is None


def test_gains_of_the_LMI_come_near_its_optimum(driven: Problem) -> None:
    """Which lies between what is proved from below and what the solver says, not a thousandfold above."""
    gains, least = design_apart(driven, "decomposed"), undercut(driven).gamma
    assert gains is not None
    assert least is not None
    assert gains.certificate.lmi_gamma == pytest.approx(least, rel=1e-3)
    assert gains.certificate.gamma < 1.01 * least
    assert verify(gains).holds


def test_the_P_of_an_LMI_is_stored_where_it_proves_something() -> None:
    document = cancelling(1e-3).document()
    document["topology"] = document["topology"][:1]
    document["markov"] = {"transition": [[1.0]], "initial": "one"}
    gains = design_apart(Problem.from_document(document), "decomposed")
    assert gains is not None
    assert gains.certificate.kind == "lyapunov"
    assert gains.certificate.lmi_gamma is not None
    assert gains.certificate.gamma < 1.002 * gains.certificate.lmi_gamma
    assert verify(gains).holds


def test_where_nothing_cancels_the_LMI_is_solved_as_ever() -> None:
    assert design_apart(problems.find("two-nodes"), "decomposed") is None


# the box
@pytest.fixture(scope="module")
def boxed() -> tuple[Problem, LinkMatrices, LinkMatrices, Box]:
    problem = cancelling(1e-10)
    return problem, *good_gains(problem), box_of(problem, within(["probabilities=0.001", "D=0.1%"]))


def test_a_box_of_probabilities_is_proved_where_M_cancels(
    boxed: tuple[Problem, LinkMatrices, LinkMatrices, Box],
) -> None:
    """The worst model found has no less than the model of the file and no more than what is proved, by balls too."""
    problem, K, H, box = boxed
    found = robust(problem, K, H, box)
    gain = exact_gain(model_of_gains(problem, K, H))
    assert found.gamma is not None
    assert gain.low < found.found < found.gamma < 1.1 * gain.high
    for gamma, holds in ((found.gamma, True), (gain.low, False)):
        again = proved_at(problem, K, H, box, found.worst, gamma, found.recipe, balls=True)
        assert (again is not None and again.holds) is holds


def test_the_worst_model_of_a_box_is_what_600_bits_say_it_is(
    boxed: tuple[Problem, LinkMatrices, LinkMatrices, Box],
) -> None:
    problem, K, H, box = boxed
    found = worst(problem, K, H, box)
    bits = ManyBits(problem, K, H)
    with ctx.workprec(600):
        bits.by.model = BallModel(problem, K, H, found.truth)
    assert not bits.holds(bits.by.model.M, found.gain * (1.0 - 1e-6), 40)
    assert bits.holds(bits.by.model.M, found.gain * (1.0 + 1e-4), 40)


def test_an_entry_that_is_off_is_one_of_the_matrices_as_they_are(
    boxed: tuple[Problem, LinkMatrices, LinkMatrices, Box],
) -> None:
    """So a box of entries is seen among the states, and T is refused for it."""
    problem, K, H, _ = boxed
    box = box_of(problem, within(["B=1%"]))
    assert there_of(problem, K, H, box).T is None
    with pytest.raises(ValueError, match="an entry that is off"):
        Cube(problem, K, H, corners(problem, box)[0], box.entries, np.eye(3))


def test_what_is_above_all_corners_does_not_depend_on_units() -> None:
    rng = np.random.default_rng(0)
    X, S = (V @ V.swapaxes(-1, -2) for V in (rng.normal(size=(2, 4, 4)), rng.normal(size=(3, 2, 4, 4))))
    units = np.array([2.0**20, 1.0, 2.0**-20, 2.0**3])
    both = np.outer(units, units)
    np.testing.assert_allclose(upper_bound(S * both, X / both), upper_bound(S, X) * both, rtol=1e-12)


# the ledger
def test_the_ledger_says_the_same_of_both_coordinates_while_floats_know_both() -> None:
    """After a fault and a jump: at 1e-3, among the states as they are; at 1e-10 nothing else has become of it."""
    factors = []
    for epsilon in (1e-3, 1e-10):
        problem = cancelling(epsilon)
        K, H = good_gains(problem)
        gains = certified(problem, given(problem, K, H, source="here", file=None))
        stacks = stacked_links(problem, gains.K, gains.H)
        P, _ = lyapunov(Operator(error_model(problem, *stacks)))
        assert P is not None
        books = [Ledger.of(gains), Ledger(problem, *stacks, gamma=gains.certificate.gamma, P=P)]
        jump = np.zeros((2, 9, 9))
        jump[0, 3, 3] = epsilon**2
        for book in books:
            book.tell(Deviation(unmeasured=frozenset({0})))
            book.step()
            book.tell(Deviation())
            book.jump(jump, "a push")
            book.step()
        if epsilon == 1e-3:
            assert books[0].owed() == pytest.approx(books[1].owed(), rel=1e-9)
            assert books[0].gain() == pytest.approx(books[1].gain(), rel=1e-3)
        factors.append(books[0].gain() / gains.certificate.gamma)
    assert factors[1] == pytest.approx(factors[0], rel=0.05)
