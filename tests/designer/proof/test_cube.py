"""S(Y) of every model of a cube from above, against filters on unit vectors through every outcome of chance."""

from __future__ import annotations

from collections.abc import Callable
from itertools import product

import numpy as np
import pytest
from made_recordings import observer_gains, random_gains, real_problem
from outcomes import moment

from agent.contract.arrays import Array
from agent.contract.gains import Gains
from designer.box.extent import Box, truth_at
from designer.proof import cube, vertices_by_balls
from designer.proof.ball_model import told
from designer.proof.balls import exact
from designer.proof.cube import Chosen, Cube, chosen
from designer.proof.deviations import Deviations, Entry
from designer.proof.float64 import Bounded

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


def test_entries_of_one_column_add_up() -> None:
    """What two entries of a column are worth together must not be left out: deltas of 1, a of 0."""
    Q, radii = np.array([[[1.0, 0.9], [0.9, 1.0]]]), np.array([[1.0], [1.0]])
    S, a = Bounded(np.zeros((1, 1, 1)), np.zeros((1, 1))), np.zeros((1, 1, 2))
    right, wrong = (by(S, a, a, Q, radii, np.ones((1, 1, 1))).middle.item() for by in (ABOVE, only_by_itself))
    assert right >= 3.8 > wrong


def with_too_little(by: Chosen) -> Chosen:
    """Multipliers below Q: what is left of the entries has no largest value."""
    return by._replace(Lambda=0.5 * by.Lambda)


def with_the_wrong_sign(by: Chosen) -> Chosen:
    return by._replace(Lambda=-by.Lambda)


@pytest.mark.parametrize("mutant", [with_too_little, with_the_wrong_sign])
def test_multipliers_that_bound_nothing_prove_nothing_in_floats_and_in_balls(
    monkeypatch: pytest.MonkeyPatch, mutant: Callable[[Chosen], Chosen]
) -> None:
    """Two entries of a column, worth most to each other: there Lambda is near its least."""
    Q, radii, X = np.array([[1.0, 0.9], [0.9, 1.0]]), np.array([[1.0], [1.0]]), np.ones((1, 1))
    S, a = Bounded(np.zeros((1, 1, 1)), np.zeros((1, 1))), np.zeros((1, 1, 2))

    def proved() -> list[bool]:
        in_balls = vertices_by_balls.cubed(exact(S.middle[0]), exact(a[0]), exact(Q), radii, X)
        return [cube.cubed(S, a, a, Q[None], radii, X[None]) is not None, in_balls is not None]

    assert proved() == [True, True]
    for module in (cube, vertices_by_balls):
        monkeypatch.setattr(module, "chosen", lambda *of: mutant(chosen(*of)))
    assert proved() == [False, False]


def test_any_multipliers_bound_and_the_chosen_lose_least() -> None:
    """Along X, of Lambda a tenth more or less in any row, as long as all is proved."""
    rng = np.random.default_rng(5)
    half = rng.normal(size=(4, 3))
    a, Q, radii = rng.normal(size=(1, 5, 4)), 0.05 * (half @ half.T)[None], rng.uniform(0.1, 0.3, (4, 5))
    half = rng.normal(size=(1, 5, 5))
    X, S = half @ half.swapaxes(1, 2), np.zeros((1, 5, 5))
    best = chosen(a, Q, radii, X)

    def lost(by: Chosen) -> float:
        found = a @ np.linalg.solve(by.rest(Q), a.swapaxes(1, 2))
        return float((X * found).sum() + (X.diagonal(axis1=1, axis2=2) * cube.on_diagonal(by, radii)).sum())

    assert lost(best) == pytest.approx(float((X * cube.weighed(S, a, Q, radii, X)).sum()))
    for k in range(4):
        for share in (0.9, 1.1):
            Lambda = best.Lambda * np.where(np.arange(4) == k, share, 1.0)
            assert lost(best) < lost(best._replace(Lambda=Lambda)) * (1.0 + 1e-3)


def test_what_is_carried_is_the_slope_of_what_is_bounded() -> None:
    """By Y, in any direction: the weights of a step lead to those of the step before."""
    problem, gains = GAINS[False].problem, GAINS[False]
    found = Cube(problem, gains.K, gains.H, told(problem)._replace(carry=True), TOGETHER)
    rng = np.random.default_rng(6)
    half, of_X = (
        rng.normal(size=(2, found.order, found.order)),
        rng.normal(size=(2, found.model.order, found.model.order)),
    )
    Y, X, by = half @ half.swapaxes(1, 2), of_X @ of_X.swapaxes(1, 2), rng.normal(size=half.shape)
    by = by + by.swapaxes(1, 2)
    ahead, behind = (float((X * found.weigh(Y + step * by, X)).sum()) for step in (1e-6, -1e-6))
    assert (ahead - behind) / 2e-6 == pytest.approx(float((found.carry(Y, X) * by).sum()), rel=1e-4)


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
