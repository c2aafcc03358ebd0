"""S(Y) and the recursion in floats, against filters written out for every outcome in fractions."""

from __future__ import annotations

from collections.abc import Iterator
from fractions import Fraction
from functools import cache
from itertools import product as every
from typing import Any

import numpy as np
import pytest
import rational
from flint import arb, ctx
from networks import own_noise, random_gains, random_problem, real_network
from products import honest, worst
from rational import Exact, plus, positive_definite, times, transposed

from agent.contract.arrays import Array
from agent.contract.problem import Problem
from designer.gain.exact import exact_gain
from designer.lmi.back_off import inequality_17
from designer.model.error_model import error_model, link_gains
from designer.proof import float64, float_model
from designer.proof.ball_model import BallModel
from designer.proof.by_floats import ByFloats, square
from designer.proof.float64 import Bounded
from designer.proof.float_model import FloatModel, enclosed
from designer.proof.prover import FLOATS, Prover
from designer.search.starts import consensus_gains

VARIANTS = [
    {"seen": seen, "delivery": delivery, "unbiased": unbiased}
    for seen in (False, ["n1"], True)
    for delivery in (None, 0.75)
    for unbiased in (False, True)
]


def network(variant: dict[str, Any]) -> Problem:
    """Two nodes with one and two measurements that hear each other in some mode; both lose measurements."""
    document = random_problem(5, n=2).document()
    document["node"][0]["arrival_probability"] = 0.7
    document["topology"][0]["adjacency"] = [[1.0, 0.5], [0.0, 1.5]]
    document["topology"][1]["adjacency"] = [[0.75, 1.25], [2.0, 1.0]]
    return real_network(Problem.from_document(document), **variant)


# the witness
def outcomes(problem: Problem, s: int) -> Iterator[tuple[Fraction, dict[int, int], dict[tuple[int, int], int]]]:
    """The probability of every theta and phi of a mode, which are 1 where nothing can get lost."""
    chances = {j: Fraction(float(beta)) for j, beta in enumerate(problem.beta)}
    links = {
        (i, j): Fraction(float(problem.delivery[i, j])) for i in range(problem.n) for j in problem.neighbours(s, i)
    }
    for theta in every(*([0, 1] if beta < 1 else [1] for beta in chances.values())):
        for phi in every(*([0, 1] if rho < 1 else [1] for rho in links.values())):
            chance = Fraction(1)
            for came, probability in zip((*theta, *phi), (*chances.values(), *links.values()), strict=True):
                chance *= probability if came else 1 - probability
            yield chance, dict(enumerate(theta)), dict(zip(links, phi, strict=True))


class Filters:
    """Equations (1) to (5), and what docs/theory.md adds to them, as maps of [x; e_1; ...; e_n; w]."""

    def __init__(self, problem: Problem, K_bar: Array, H_bar: Array) -> None:
        self.problem, self.nx, self.nw = problem, problem.nx, problem.nw
        self.width = problem.nx * (problem.n + 1) + problem.nw
        self.K, self.H = link_gains(problem, K_bar, H_bar)
        plant = problem.plant
        self.A, self.B, self.M = rational.exact(plant.A), rational.exact(plant.B), rational.exact(plant.M)

    def pick(self, first: int, rows: int) -> Exact:
        return [[Fraction(int(j == first + i)) for j in range(self.width)] for i in range(rows)]

    def step(self, s: int, theta: dict[int, int], phi: dict[tuple[int, int], int]) -> Exact:
        """[x; e] one step later."""
        problem, nx = self.problem, self.nx
        x, w = self.pick(0, nx), self.pick(nx * (problem.n + 1), self.nw)
        x_hat = [plus(x, self.pick(nx * (i + 1), nx), -1) for i in range(problem.n)]
        innovation = []
        for j, node in enumerate(problem.nodes):
            C, D, beta = rational.exact(node.C), rational.exact(node.D), Fraction(node.arrival_probability)
            if node.seen:
                y = plus(times(C, plus(x, x_hat[j], -1)), times(D, w))
                innovation.append([[theta[j] * entry for entry in row] for row in y])
            else:
                expected = times(C, plus(rational.zeros(nx, self.width), x_hat[j], beta))
                y = plus(times(D, w), times(C, x), theta[j])
                innovation.append(plus(y, expected, -1))
        x_next = plus(times(self.A, x), times(self.B, w))
        rows = list(x_next)
        for i, receiver in enumerate(problem.node_names):
            topology, x_hat_next, left = problem.topologies[s], rational.zeros(nx, self.width), self.A
            heard = sorted(problem.neighbours(s, i), key=lambda j, i=i: j == i)  # itself last
            for j in heard:
                a, sender = Fraction(float(topology.adjacency[i, j])), problem.node_names[j]
                K = [[a * k for k in row] for row in rational.exact(self.K[topology.name][receiver][sender])]
                H = [[a * h for h in row] for row in rational.exact(self.H[topology.name][receiver][sender])]
                if problem.unbiased:
                    K = left if j == i else K
                    left = plus(left, K, -1)
                taken = x_hat[j] if phi[i, j] else x_hat[i]
                x_hat_next = plus(x_hat_next, times(K, taken))
                x_hat_next = plus(x_hat_next, times(H, innovation[j]), phi[i, j])
            rows += plus(x_next, x_hat_next, -1)
        return rows

    def joint(self, Y: list[Exact]) -> list[Exact]:
        """S(Y)(s) over [eta; w], the mean over all outcomes."""
        p, found = self.problem.plant_states, []
        for s, row in enumerate(rational.exact(self.problem.markov.transition)):
            size = len(Y[0])
            Y_bar, total = rational.zeros(size, size), rational.zeros(self.width, self.width)
            for t, pi in enumerate(row):
                Y_bar = plus(Y_bar, Y[t], pi / sum(row))
            for chance, theta, phi in outcomes(self.problem, s):
                G = self.step(s, theta, phi)[self.nx - p :]
                total = plus(total, times(transposed(G), times(Y_bar, G)), chance)
            if not p:
                assert all(entry == 0 for row in total[: self.nx] for entry in row)
                total = [row[self.nx :] for row in total[self.nx :]]
            found.append(total)
        return found

    def MM(self) -> Exact:
        p, nx, out = self.problem.plant_states, self.nx, rational.zeros(*2 * [self.width - self.nw - self.nx])
        block = times(transposed(self.M), self.M)
        for i in range(self.problem.n):
            for a, b in every(range(nx), range(nx)):
                out[i * nx + a][i * nx + b] = block[a][b]
        width = len(out) + p
        padded = rational.zeros(width, width)
        for i, row in enumerate(out):
            padded[p + i][p:] = row
        return padded

    def grown(self, Y: list[Exact], g: Fraction) -> list[Exact]:
        """One step of the recursion."""
        found = []
        for S in self.joint(Y):
            n = len(S) - self.nw
            W = [[g * (i == j) - S[n + i][n + j] for j in range(self.nw)] for i in range(self.nw)]
            assert positive_definite(W)
            cross = rational.block(S, range(n), range(n, len(S)))
            more = times(cross, rational.solved(W, transposed(cross)))
            found.append(plus(rational.block(S, range(n), range(n)), more))
        return found


def gains(problem: Problem) -> tuple[Array, Array]:
    """Random, and as they are stored: K_ij of (5), times a_ij."""
    return random_gains(problem, 7)


def random_Y(modes: int, size: int) -> Array:
    V = np.random.default_rng(3).normal(size=(modes, size, size))
    return float64.symmetric(V @ V.swapaxes(1, 2))


@cache
def witness(variant: int) -> tuple[Problem, Array, list[Exact]]:
    """A network, a Y, and S(Y) by every outcome."""
    problem = network(VARIANTS[variant])
    filters = Filters(problem, *gains(problem))
    Y = random_Y(2, len(filters.MM()))
    return problem, Y, filters.joint([rational.exact(Y_s) for Y_s in Y])


def holds(S: Bounded, s: int, exact: Exact) -> bool:
    off, room = plus(exact, rational.exact(S.middle[s]), -1), rational.diagonal(S.spread[s])
    return all(positive_definite(plus(room, off, side)) for side in (1, -1))


@pytest.mark.parametrize("variant", range(len(VARIANTS)), ids=lambda variant: str(VARIANTS[variant]))
def test_S_is_between_its_bounds(variant: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever may get lost, seen or not, unbiased or not: the mean over every outcome of the filters as they step.

    As numpy multiplies, and as inexactly as is assumed at most; without the roundings it is not between them then.
    """
    problem, Y, exact = witness(variant)
    for product, rounded in ((honest, True), (worst(0), True), (worst(1), True), (worst(0), False)):
        monkeypatch.setattr(float64, "product", product)
        monkeypatch.setattr(float_model, "product", product)
        model = ByFloats(problem, *link_gains(problem, *gains(problem))).model
        model.rounded *= rounded
        found = model.joint(Y)
        assert found is not None
        assert found.spread.max() < 1e-12 * np.abs(found.middle).max()
        assert all(holds(found, s, exact_s) for s, exact_s in enumerate(exact)) is rounded
    MM = Bounded(model.peak.middle[None], model.peak.spread[None])
    assert holds(MM, 0, Filters(problem, *gains(problem)).MM())


@pytest.mark.parametrize("variant", [VARIANTS[5], VARIANTS[11]], ids=str)
def test_two_steps_of_the_recursion_are_on_their_sides_of_the_truth(
    variant: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    problem = network(variant)
    for module in (float64, float_model):
        monkeypatch.setattr(module, "product", worst(0))
    by, filters, gamma = (
        ByFloats(problem, *link_gains(problem, *gains(problem))),
        Filters(problem, *gains(problem)),
        9.0,
    )
    for up in (True, False):
        Y, exact = by.start(up=up), [filters.MM()] * by.model.modes
        for _ in range(2):
            signs, Y = by.step(Y, gamma, up=up)
            assert all(sign.proved for sign in signs)
            assert Y is not None
            exact = filters.grown(exact, Fraction(square(gamma, up=up)))
            for Y_s, exact_s in zip(Y, exact, strict=True):
                above, below = (rational.exact(Y_s), exact_s) if up else (exact_s, rational.exact(Y_s))
                assert positive_definite(plus(above, below, -1))


def test_a_W_that_is_not_positive_is_known_from_both_sides() -> None:
    """Just above the gain of one step every W is proved, just below one is proved false."""
    problem = own_noise(network(VARIANTS[7]))
    by, filters = ByFloats(problem, *link_gains(problem, *gains(problem))), Filters(problem, *gains(problem))
    S = filters.joint([filters.MM()] * by.model.modes)
    n = by.model.size
    largest = max(
        np.linalg.eigvalsh(np.array(rational.block(S_s, *2 * [range(n, len(S_s))]), dtype=float))[-1] for S_s in S
    )
    gamma = float(np.sqrt(largest))
    up, down = by.step(by.start(up=True), gamma * (1.0 + 1e-11), up=True)[0], by.start(up=False)
    assert all(sign.proved for sign in up)
    assert any(sign.refuted for sign in by.step(down, gamma * (1.0 - 1e-11), up=False)[0])
    near = by.step(by.start(up=True), gamma, up=True)[0] + by.step(down, gamma, up=False)[0]
    assert not all(sign.proved for sign in near) or not any(sign.refuted for sign in near)


# numbers
def test_numbers_are_enclosed() -> None:
    """The float, and u times the size, reach as far as the ball; exact ones have their own size."""
    with ctx.workprec(128):
        balls = [arb(0.1), arb(1) / 3, arb(0, 1e-30), arb(1, 1e-20), arb(2) ** -1060, arb(0)]
    found = enclosed(balls)
    for ball, middle, size in zip(balls, *found, strict=True):
        assert abs(middle) <= size
        reach = Fraction(float64.U) * Fraction(float(size)) + Fraction(float64.TINY)
        low, high = (Fraction(*(int(part) for part in _ratio(end))) for end in (ball.lower(), ball.upper()))
        assert Fraction(float(middle)) - reach <= low <= high <= Fraction(float(middle)) + reach
    assert found.size[0] == 0.1
    assert found.size[1] == found.middle[1]
    assert found.size[2] == pytest.approx(1e-30 / float64.U)


def _ratio(number: Any) -> tuple[int, int]:
    man, exp = number.man_exp()
    return (int(man) << int(exp), 1) if exp >= 0 else (int(man), 1 << -int(exp))


@pytest.mark.parametrize("number", [1e40, 1e300, float("inf")])
def test_numbers_out_of_range_decide_nothing(number: float) -> None:
    """Beyond 2^100, and beyond float64 itself, where products of stored floats may lie."""
    problem = network(VARIANTS[0])
    K_bar, H_bar = gains(problem)
    K_bar[0, 0, 0] = min(number, 1e308)
    H_bar[0, 0, 0] = 1e308 if number == float("inf") else H_bar[0, 0, 0]
    by = ByFloats(problem, *link_gains(problem, K_bar, H_bar))
    P = np.tile(np.eye(by.model.size), (by.model.modes, 1, 1))
    for signs in (by.inequality_17(P), by.positive(P), by.below(0.0 * P, P, 1.0), by.step(0.0 * P, 1.0, up=False)[0]):
        assert not any(sign.proved or sign.refuted for sign in signs)


@pytest.mark.parametrize("variant", [VARIANTS[0], VARIANTS[11]], ids=str)
def test_P_satisfies_17_and_hardly_more_of_it_does(variant: dict[str, Any]) -> None:
    """By the other error model, in floats."""
    problem = real_network(random_problem(3), **variant)
    gains = consensus_gains(problem, weight=0.2)
    P = ByFloats(problem, *link_gains(problem, *gains)).model.invariants[0]
    assert P is not None
    for factor, holds in ((1.0, True), (1.01, False)):
        least = np.linalg.eigvalsh(inequality_17(error_model(problem, *gains), factor * P)).min()
        assert bool(least > 0.0) is holds


def test_P_does_not_depend_on_units() -> None:
    """x in units 2^40 apart: every entry of P is what it was, in the new units, and floats prove as much."""
    problem = random_problem(3)
    K_bar, H_bar = consensus_gains(problem, weight=0.2)
    units = np.array([2.0**20, 2.0**-20])
    document, every_e = problem.document(), np.tile(units, problem.n)
    document["plant"]["A"] = (problem.plant.A * units[:, None] / units).tolist()
    document["plant"]["B"] = (problem.plant.B * units[:, None]).tolist()
    document["plant"]["M"] = (problem.plant.M / units).tolist()
    for node, said in zip(problem.nodes, document["node"], strict=True):
        said["C"] = (node.C / units).tolist()
    other = Problem.from_document(document)
    found = ByFloats(problem, *link_gains(problem, K_bar, H_bar)).model.invariants[0]
    K, H = link_gains(other, K_bar * every_e[:, None] / every_e, H_bar * every_e[:, None])
    in_units, every_eta = ByFloats(other, K, H).model.invariants[0], np.tile(units, problem.n + 1)
    assert found is not None
    assert in_units is not None
    np.testing.assert_allclose(in_units * every_eta * every_eta[:, None], found, rtol=1e-12)
    gamma = 10.0
    assert Prover(problem, *link_gains(problem, K_bar, H_bar), makes=FLOATS).exact(gamma).holds
    assert Prover(other, K, H, makes=FLOATS).exact(gamma).holds


def test_errors_that_grow_have_no_P() -> None:
    problem = random_problem(1)
    K_bar, H_bar = random_gains(problem, 1, size=0.1)
    K_bar += 1.5 * np.eye(K_bar.shape[1])
    assert not exact_gain(error_model(problem, K_bar, H_bar)).stable
    with ctx.workprec(128):
        assert FloatModel(BallModel(problem, *link_gains(problem, K_bar, H_bar))).invariants == []
