"""S(Y) of every model of a cube from above, against filters on unit vectors through every outcome of chance."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from made_recordings import observer_gains, random_gains, real_problem
from outcomes import moment

from agent.contract.arrays import Array
from agent.contract.gains import Gains
from designer.box.extent import Box, truth_at
from designer.proof import cube
from designer.proof.ball_model import told
from designer.proof.cube import Cube
from designer.proof.deviations import Deviations, Entry

ALONE = [  # one entry of every letter; node 1 sees its losses
    Entry("A", 0, 1, 0, 0.1),
    Entry("B", 0, 0, 1, 0.2),
    Entry("C", 0, 0, 1, 0.1),
    Entry("C", 1, 0, 0, 0.1),
    Entry("D", 0, 0, 0, 0.3),
    Entry("D", 1, 0, 1, 0.3),
]
TOGETHER = (*ALONE, Entry("A", 0, 0, 0, 0.05), Entry("C", 1, 0, 1, 0.02))


def network(*, unbiased: bool) -> Gains:
    """Two nodes that hear each other over links that lose messages, and lose measurements, one of them seen."""
    problem = real_problem(4, unbiased=unbiased, ny=(1, 1), modes=2)
    return observer_gains(problem) if unbiased else random_gains(problem)


GAINS = {unbiased: network(unbiased=unbiased) for unbiased in (True, False)}


def least(gains: Gains, entries: tuple[Entry, ...], *, meant: tuple[Entry, ...] | None = None) -> float:
    """The least eigenvalue of the bound for `entries` less S(Y) at the corners of the cube that is meant."""
    problem = gains.problem
    truth = told(problem)._replace(carry=True)
    found = Cube(problem, gains.K, gains.H, truth, entries)
    rng = np.random.default_rng(0)
    half = rng.normal(size=(2, found.order, found.order))
    X = rng.normal(size=(2, found.model.order, found.model.order))
    Y, X = half @ half.swapaxes(1, 2), X @ X.swapaxes(1, 2)
    above = found.joint(Y, X)
    assert above is not None
    assert above.spread.max() < 1e-9 * above.middle.max()
    box = Box((), tuple((tuple(row),) for row in truth.transition), "", entries if meant is None else meant, carry=True)
    smallest = np.inf
    for signs in product((-1, 1), repeat=len(box.entries)):
        real = truth_at(problem, box, [], [0, 0], signs).matrices
        for s, mode in enumerate(problem.mode_names):
            Y_bar = np.asarray(sum(float(pi) * Y_t for pi, Y_t in zip(truth.transition[s], Y, strict=True)))
            rest = above.middle[s] - moment(gains, mode, problem.beta, problem.delivery, Y_bar, real)
            smallest = min(smallest, float(np.linalg.eigvalsh(rest)[0]))
    return smallest


@pytest.mark.parametrize("unbiased", [True, False])
@pytest.mark.parametrize("entry", ALONE, ids=lambda entry: f"{entry.matrix} {entry.node}")
def test_the_bound_of_one_entry_touches_both_of_its_ends(entry: Entry, unbiased: bool) -> None:
    """And that of a cube that is 1 % too small does not reach them."""
    gains = GAINS[unbiased]
    assert -1e-9 < least(gains, (entry,)) < 1e-9
    assert least(gains, (entry._replace(radius=0.99 * entry.radius),), meant=(entry,)) < -1e-5


@pytest.mark.parametrize("unbiased", [True, False])
def test_the_bound_of_a_cube_is_above_all_of_its_corners(unbiased: bool) -> None:
    assert least(GAINS[unbiased], TOGETHER) > -1e-9


# mutants
def without_squares(*arguments: Array) -> Array:
    """Q is forgotten: what the deviations are worth to each other."""
    S, a, a_off, Q, radii, X = arguments
    return ABOVE(S, a, a_off, 0.0 * Q, radii, X)


def without_cross(*arguments: Array) -> Array:
    """a is forgotten."""
    S, a, a_off, Q, radii, X = arguments
    return ABOVE(S, 0.0 * a, a_off, Q, radii, X)


def only_by_itself(*arguments: Array) -> Array:
    """Off the diagonal Q is forgotten."""
    S, a, a_off, Q, radii, X = arguments
    return ABOVE(S, a, a_off, Q * np.eye(Q.shape[-1]), radii, X)


ABOVE = cube.cubed


@pytest.mark.parametrize("mutant", [without_squares, without_cross])
@pytest.mark.parametrize("entry", ALONE, ids=lambda entry: f"{entry.matrix} {entry.node}")
def test_a_bound_that_forgets_a_term_is_none(monkeypatch: pytest.MonkeyPatch, entry: Entry, mutant: Array) -> None:
    monkeypatch.setattr(cube, "cubed", mutant)
    assert least(GAINS[False], (entry,)) < -1e-5


def test_entries_of_one_column_add_up(monkeypatch: pytest.MonkeyPatch) -> None:
    """What two entries of a column are worth together must not be left out: deltas of 1, a of 0."""
    from designer.proof.float64 import Bounded

    Q, radii = np.array([[[1.0, 0.9], [0.9, 1.0]]]), np.array([[1.0], [1.0]])
    S, a = Bounded(np.zeros((1, 1, 1)), np.zeros((1, 1))), np.zeros((1, 1, 2))
    right, wrong = (by(S, a, a, Q, radii, np.ones((1, 1, 1))).middle.item() for by in (ABOVE, only_by_itself))
    assert right >= 3.8 > wrong


@pytest.mark.parametrize("forgotten", ["mean", "noise"])
def test_a_deviation_that_misses_a_term_has_a_bound_that_is_none(
    monkeypatch: pytest.MonkeyPatch, forgotten: str
) -> None:
    terms = Deviations.terms

    def fewer(self: Deviations, s: int) -> list[object]:
        found = terms(self, s)
        cut = {0} if forgotten == "mean" else set(range(1, len(found)))
        return [term._replace(U=term.U * 0) if k in cut else term for k, term in enumerate(found)]

    monkeypatch.setattr(Deviations, "terms", fewer)
    assert least(GAINS[False], (ALONE[3],)) < -1e-5


def test_what_m_may_be_is_above_the_peak_of_every_m() -> None:
    problem, gains = GAINS[False].problem, GAINS[False]
    entry = Entry("M", 0, 0, 1, 0.3)
    truth = told(problem)
    found = Cube(problem, gains.K, gains.H, truth, (entry,))
    X = np.tile(np.eye(found.model.order), (2, 1, 1))
    for size, right in ((1.0, True), (0.99, False)):
        above = Cube(problem, gains.K, gains.H, truth, (entry._replace(radius=size * entry.radius),)).ended(X)
        rests = []
        for sign in (-1.0, 1.0):
            off = np.zeros_like(problem.plant.M)
            off[0, 1] = sign * entry.radius
            M = np.hstack([np.tile(off, (problem.n, 1)), np.kron(np.eye(problem.n), problem.plant.M)])
            M *= np.repeat(problem.weights, problem.nz)[:, None]
            rests.append(np.linalg.eigvalsh(above[0] - M.T @ M)[0])
        assert bool(min(rests) > -1e-9) is right
