"""The ledger against runs that are simulated node by node, against theory, and against its own mutants."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import pytest
from made_recordings import observer_gains, real_problem
from places import ROOT

from agent.contract.arrays import Array
from agent.contract.gains import Gains
from agent.contract.problem import Problem
from designer.gain.exact import exact_gain
from designer.gain.exact import step as backwards
from designer.ledger.account import account, deviations
from designer.ledger.deviation import AS_DESIGNED, Deviation, Models, Unabsorbed
from designer.ledger.exact import Ledger
from designer.ledger.promise import SHARE
from designer.model.error_model import error_model, measurement_slices, stacked_gains

GOLDEN = Gains.load(ROOT / "recordings" / "golden" / "zhu2020-lossy.gains.json")
PROBLEM, K_BAR, H_BAR = GOLDEN.problem, *stacked_gains(GOLDEN)
GAIN = exact_gain(error_model(PROBLEM, K_BAR, H_BAR))
RUNS = 20_000


def ledger() -> Ledger:
    """Of the exact gain, so that nothing is left over."""
    assert GAIN.P is not None
    return Ledger(PROBLEM, K_BAR, H_BAR, gamma=GAIN.high, P=GAIN.P)


def silent(j: int) -> Deviation:
    """Nobody gets the messages of node j, which goes on."""
    return Deviation(substituted=frozenset((i, j) for i in range(PROBLEM.n) if i != j))


def away(j: int) -> Deviation:
    return Deviation(absent=frozenset({j}))


# runs, node by node from (1)-(5)
class Runs(NamedTuple):
    """Means over the runs at every step, (steps + 1,)."""

    squares: Array  # of |z_tilde|^2 over the nodes that are there
    errors: Array  # the standard error of that mean
    energy: Array  # of sum over j < k of |w(j)|^2


def simulate(faults: Sequence[Deviation], policy: Callable[[int, Array, Array], Array], *, mode: int, delta: Array,
             at: int) -> Runs:  # fmt: skip
    """Runs from r(0) = mode; w(k) = policy(k, modes, eta); x_hat moves by -delta at step `at`, (n, nx)."""
    rng, p, n, nx = np.random.default_rng(8), PROBLEM, PROBLEM.n, PROBLEM.nx
    rows = measurement_slices(p)
    x, x_hat, r = np.zeros((RUNS, nx)), np.zeros((RUNS, n, nx)), np.full(RUNS, mode)
    energy, found = np.zeros(RUNS), []
    for k, fault in enumerate([*faults, AS_DESIGNED]):
        if k == at:
            x_hat = x_hat - delta
        before = x_hat.copy()
        for i, j in fault.begun:
            x_hat[:, i] = 0.0 if j is None else before[:, j]
        there = [i for i in range(n) if i not in fault.absent]
        squares = (((x[:, None] - x_hat[:, there]) @ p.plant.M.T) ** 2).sum(axis=(1, 2))
        found.append((squares.mean(), squares.std() / math.sqrt(RUNS), energy.mean()))
        eta = np.hstack([x, (x[:, None] - x_hat).reshape(RUNS, -1)])
        w = policy(k, r, eta)
        energy += (w**2).sum(axis=1)
        nu = []
        for i, node in enumerate(p.nodes):
            theta = (rng.random(RUNS) < p.beta[i])[:, None]
            y = theta * (x @ node.C.T) + w @ node.D.T
            nu.append((y - p.beta[i] * x_hat[:, i] @ node.C.T) * (i not in fault.unmeasured))
        after = np.zeros_like(x_hat)
        for s in range(len(K_BAR)):
            of = r == s
            for i in there:
                for j in p.neighbours(s, i):
                    lost = i != j and ((i, j) in fault.substituted or j in fault.absent)
                    K_ij = K_BAR[s, i * nx : (i + 1) * nx, j * nx : (j + 1) * nx]
                    after[of, i] += x_hat[of, i if lost else j] @ K_ij.T
                    if not lost:
                        after[of, i] += nu[j][of] @ H_BAR[s, i * nx : (i + 1) * nx, rows[j]].T
        x, x_hat = x @ p.plant.A.T + w @ p.plant.B.T, after
        steps = p.markov.transition.cumsum(axis=1)[r]
        r = (rng.random(RUNS)[:, None] >= steps[:, :-1]).sum(axis=1)
    return Runs(*np.array(found).T)


class Worst(NamedTuple):
    """A disturbance that is nearly worst for z_tilde after all of `faults`."""

    faults: list[Deviation]  # from its first step on
    mode: int
    policy: Callable[[int, Array, Array], Array]


def worst_for(faults: Sequence[Deviation], end: Deviation, gain: float) -> Worst:
    """w = Gamma eta of the recursion just above `gain`, from the step and mode where the least W is; end is now."""
    models, Gamma, least = Models(PROBLEM, K_BAR, H_BAR), [], []
    now = models.acting(end)
    Y, g = now.before(now.MM), gain**2 * (1.0 + 3e-4)
    for fault in reversed(faults):
        acting = models.acting(fault)
        taken = backwards(acting.operator, Y, g)
        assert taken is not None
        weakest = np.linalg.eigvalsh(np.linalg.inv(taken.W_inverse))[:, 0]
        Gamma.append(taken.Gamma)
        least.append((weakest.min(), int(weakest.argmin())))
        Y = acting.before(taken.Y)
    Gamma, least = Gamma[::-1], least[::-1]
    first = min(range(len(faults)), key=lambda k: least[k][0])

    def policy(k: int, r: Array, eta: Array) -> Array:
        if first + k >= len(faults):
            return np.zeros((len(r), PROBLEM.nw))
        return np.ones((len(r), PROBLEM.nw)) if k == 0 else np.einsum("rij,rj->ri", Gamma[first + k][r], eta)

    return Worst(list(faults[first:]), least[first][1], policy)


SCHEDULES = {
    "silent": ([silent(0)] * 5, AS_DESIGNED),
    "silent, and two steps later": ([silent(3)] * 6 + [AS_DESIGNED] * 2, AS_DESIGNED),
    "no measurements": ([Deviation(unmeasured=frozenset({0, 2, 3}))] * 6, AS_DESIGNED),
    "away": ([away(3)] * 5, away(3)),
    "away, and back with 0": ([away(0)] * 5, Deviation(begun=frozenset({(0, None)}))),
    "away, and back with a neighbour's": ([away(0)] * 5, Deviation(begun=frozenset({(0, 3)}))),
}


@pytest.mark.parametrize("name", SCHEDULES)
def test_the_bound_holds_and_is_attained(name: str) -> None:
    """Under a w that is made for these faults; what is certified as designed alone does not hold."""
    faults, end = SCHEDULES[name]
    book = ledger()
    run_through(book, faults, end)
    gain = book.gain()
    worst = worst_for([AS_DESIGNED] * 12 + faults, end, gain)
    length = len(worst.faults)
    runs = simulate([*worst.faults, end], worst.policy, mode=worst.mode, delta=np.zeros((4, 2)), at=-1)
    book = ledger()
    for k, fault in enumerate([*worst.faults, end]):
        book.tell(fault)
        assert runs.squares[k] - 4.0 * runs.errors[k] <= book.bound(float(runs.energy[k])) ** 2
        book.step()
    attained = math.sqrt(runs.squares[length] / runs.energy[length])
    assert 0.93 * gain < attained
    assert attained > 1.02 * GAIN.high  # the mutant that forgets the faults


def run_through(book: Ledger, faults: Sequence[Deviation], end: Deviation) -> None:
    for fault in faults:
        book.tell(fault)
        book.step()
    book.tell(end)


def jumped(book: Ledger, worst: Worst, delta: Array, at: int, runs: Runs) -> list[float]:
    """Bounds at every step from `at` on, over what was seen less four standard errors; below 1 is violated."""
    chances = np.eye(4)[worst.mode] @ np.linalg.matrix_power(PROBLEM.markov.transition, at)
    eta = np.concatenate([np.zeros(PROBLEM.nx), delta.reshape(-1)])
    found = []
    for k in range(len(runs.squares)):
        if k == at:
            book.jump(chances[:, None, None] * np.outer(eta, eta), "a jump")
        seen = math.sqrt(max(runs.squares[k] - 4.0 * runs.errors[k], 0.0))
        if k >= at:
            found.append(book.bound(float(runs.energy[k])) / max(seen, 1e-12))
        book.step()
    return found


def test_a_jump_is_added_and_a_ledger_that_forgets_it_is_caught(monkeypatch: pytest.MonkeyPatch) -> None:
    worst = worst_for([AS_DESIGNED] * 14, AS_DESIGNED, GAIN.high)
    at, delta = len(worst.faults), np.full((4, 2), 3.0)
    runs = simulate([*worst.faults, *[AS_DESIGNED] * 15], worst.policy, mode=worst.mode, delta=delta, at=at)
    assert min(jumped(ledger(), worst, delta, at, runs)) >= 1.0
    monkeypatch.setattr(Ledger, "jump", lambda *_, **__: None)
    assert min(jumped(ledger(), worst, delta, at, runs)) < 0.8


def test_a_jump_fades_as_it_says() -> None:
    book = ledger()
    eta = np.concatenate([np.zeros(2), np.ones(8)])
    start = np.zeros((4, 10, 10))
    start[0] = np.outer(eta, eta)
    book.jump(start, "the initial error")
    promise = book.promise()
    (owed,) = promise.owed
    assert promise.status == "valid plus"
    assert owed.size == pytest.approx(float(np.linalg.norm(np.tile(PROBLEM.plant.M @ np.ones(2), 4))))
    assert owed.within is not None
    most = 0.0
    for _ in range(owed.within):
        most = max(most, book.owed())
        assert book.promise().status == "valid plus"
        book.step()
    assert book.owed() <= SHARE * most
    assert book.promise().status == "valid"


# what theory says
def test_as_designed_nothing_is_added() -> None:
    book = ledger()
    for _ in range(20):
        assert book.promise().text() == "valid"
        assert book.gain() == GAIN.high
        book.step()


def test_after_faults_the_gain_comes_back_to_gamma_when_it_says() -> None:
    book = ledger()
    run_through(book, [silent(0)] * 5, AS_DESIGNED)
    within = book.promise().within
    assert within is not None
    factors = []
    while book.gain() > GAIN.high:
        factors.append(book.gain() / GAIN.high)
        book.step()
    above = [k for k, factor in enumerate(factors) if factor > 1.0 + SHARE]
    assert within == above[-1] + 1
    assert factors == sorted(factors, reverse=True)


def test_silence_for_ever_is_the_exact_gain_of_the_model_without_the_node() -> None:
    K, H = Models(PROBLEM, K_BAR, H_BAR)._gains(silent(0))
    for_ever = exact_gain(error_model(PROBLEM, K, H))
    book = ledger()
    run_through(book, [silent(0)] * 60, AS_DESIGNED)
    assert for_ever.low * (1.0 - 2e-4) < book.gain() < for_ever.high * (1.0 + 2e-4)


def test_a_short_memory_bounds_no_less(monkeypatch: pytest.MonkeyPatch) -> None:
    """What P says of the steps that are no longer kept one by one is above what they say themselves."""
    schedule = [silent(k % 4) if k % 7 < 2 else AS_DESIGNED for k in range(60)]
    schedule[30] = Deviation(begun=frozenset({(1, None)}))
    monkeypatch.setattr("designer.ledger.exact._LOOSE", 3.0)  # so that it is sought anew
    kept, short = ledger(), ledger()
    kept._memory, short._memory = 100, 8
    looser = 0
    for k, fault in enumerate(schedule):
        for book in (kept, short):
            book.tell(fault)
            book.step()
        assert short._c <= 40.0
        if k % 6 == 5:
            assert short.gain() >= kept.gain() * (1.0 - 2e-4)
            looser += short.gain() > kept.gain() * (1.0 + 2e-4)
    assert looser  # the memory was too short to know better


def test_faults_without_end_are_kept_in_bounds() -> None:
    """A memory of the usual length knows of thousands of faulty steps what one of all of them does."""
    book, all_of_them = ledger(), ledger()
    all_of_them._memory = 10_000
    rng = np.random.default_rng(4)
    for _ in range(400):
        fault = silent(int(rng.integers(4))) if rng.random() < 0.5 else AS_DESIGNED
        for each in (book, all_of_them):
            each.tell(fault)
            each.step()
    assert book._is_cut
    assert not all_of_them._is_cut
    assert book.gain() == pytest.approx(all_of_them.gain(), rel=2e-4)
    assert book.gain() < 2.0 * GAIN.high
    for _ in range(100):
        book.step()
    assert book.gain() == GAIN.high


def test_a_certificate_without_a_stored_P_has_a_ledger_too() -> None:
    changes = {"form": "summed", "P": None, "R": None, "Q": None, "kind": "exact", "gamma": GAIN.high, "horizon": 100}
    other = GOLDEN.model_copy(update={"certificate": GOLDEN.certificate.model_copy(update=changes)})
    book = Ledger.of(other)
    run_through(book, [silent(0)] * 5, AS_DESIGNED)
    same = ledger()
    run_through(same, [silent(0)] * 5, AS_DESIGNED)
    assert book.gain() == pytest.approx(same.gain(), rel=2e-4)


# what is void
def unbiased() -> Gains:
    """Of a network whose errors do not know x."""
    return observer_gains(real_problem(3, seen=True, links=True, unbiased=True, ny=(1, 1, 1)))


def seeing(problem: Problem) -> Problem:
    document = problem.document()
    for node in document["node"]:
        node["loss"] = "seen"
    return Problem.from_document(document)


def test_what_no_model_describes_is_void() -> None:
    """A node that begins with 0, where x is not in the errors; that of a neighbour's estimate is."""
    gains = observer_gains(seeing(unbiased().problem))
    K, H = stacked_gains(gains)
    gain = exact_gain(error_model(gains.problem, K, H))
    assert gain.P is not None
    book = Ledger(gains.problem, K, H, gamma=gain.high, P=gain.P)
    book.tell(Deviation(begun=frozenset({(1, 0)})))
    book.step()
    assert book.promise().status != "void"
    book.tell(Deviation(begun=frozenset({(1, None)})))
    assert book.promise().text().startswith('void since step 1: node "n1" began with 0')
    assert book.bound(1.0) == math.inf
    with pytest.raises(Unabsorbed):
        Models(gains.problem, K, H).acting(Deviation(begun=frozenset({(1, None)})))


def test_the_first_reason_stays() -> None:
    book = ledger()
    book.step()
    book.void("a mode outside the chain")
    book.step()
    book.void("another reason")
    assert book.promise().text() == "void since step 1: a mode outside the chain"


# a whole run
def test_an_account_of_a_run_tells_the_worst_and_the_end() -> None:
    substituted = np.zeros((40, 4, 4), dtype=bool)
    substituted[10:15, :, 0] = True
    none, goes_on = np.zeros((40, 4), dtype=bool), np.full((40, 4), -1)
    found = account(GOLDEN, steps=40, faults=deviations(substituted, none, none, goes_on))
    book = Ledger.of(GOLDEN)
    run_through(book, [silent(0)] * 5, AS_DESIGNED)
    assert found.worst is not None
    assert found.worst.factor == pytest.approx(book.gain() / book.gamma)
    assert (found.worst_step, found.faulty, found.last.status) == (15, 5, "valid")
    assert account(GOLDEN, steps=40, faults={}).text() == "valid"


def test_arrays_become_deviations() -> None:
    substituted, none = np.zeros((3, 4, 4), dtype=bool), np.zeros((3, 4), dtype=bool)
    substituted[1, 0, 3] = True
    substituted[1, 0, 0] = True  # a node is no neighbour of itself
    origin = np.full((3, 4), -1)
    origin[2] = [-1, 0, 4, -1]
    assert deviations(substituted, none, none, origin) == {
        1: Deviation(substituted=frozenset({(0, 3)})),
        2: Deviation(begun=frozenset({(1, 0), (2, None)})),
    }
