"""One node's step is eqs. (4) and (5), and nothing else."""

from __future__ import annotations

import random

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from made_recordings import observer_gains, random_gains, random_problem, real_problem

from agent.contract.arrays import Array
from agent.contract.gains import Gains
from agent.filter import Pair, innovation, step
from agent.product import product


def random_pairs(gains: Gains, seed: int) -> dict[str, Pair]:
    """What every node tells the others."""
    rng, nx = np.random.default_rng(seed), gains.problem.nx
    return {node.name: Pair(rng.normal(size=nx), rng.normal(size=len(node.C))) for node in gains.problem.nodes}


def written_out(gains: Gains, mode: str, receiver: str, pairs: dict[str, Pair]) -> list[float]:
    """Eqs. (4)(5), entry by entry: sum_j a_ij (sum_c K_ij[r, c] x_hat_j[c] + sum_m H_ij[r, m] innovation_j[m])."""
    problem = gains.problem
    s, i = problem.mode_index(mode), problem.node_index(receiver)
    x_hat_next = [0.0] * problem.nx
    for j, sender in enumerate(problem.node_names):
        a_ij = float(problem.topologies[s].adjacency[i, j])
        if a_ij == 0.0:
            continue
        K_ij, H_ij = gains.K[mode][receiver][sender], gains.H[mode][receiver][sender]
        for r in range(problem.nx):
            heard = sum(K_ij[r, c] * pairs[sender].x_hat[c] for c in range(problem.nx))
            heard += sum(H_ij[r, m] * value for m, value in enumerate(pairs[sender].innovation))
            x_hat_next[r] += a_ij * heard
    return x_hat_next


@given(st.integers(0, 100))
def test_a_step_is_equations_4_and_5_written_out(seed: int) -> None:
    """Weights that differ from 1, different numbers of measurements, every mode and node."""
    gains = random_gains(random_problem(seed, ny=(1, 3, 2), modes=2, nx=3), seed)
    pairs = random_pairs(gains, seed)
    for mode in gains.problem.mode_names:
        for name in gains.problem.node_names:
            expected = written_out(gains, mode, name, pairs)
            np.testing.assert_allclose(step(gains.for_node(name), mode, pairs), expected, rtol=1e-12, atol=1e-14)


def test_a_node_alone_hears_itself() -> None:
    gains = random_gains(random_problem(1, ny=(2,), modes=1))
    pairs = random_pairs(gains, 0)
    K, H = gains.K["mode-0"]["n0"]["n0"], gains.H["mode-0"]["n0"]["n0"]
    expected = K @ pairs["n0"].x_hat + H @ pairs["n0"].innovation
    np.testing.assert_allclose(step(gains.for_node("n0"), "mode-0", pairs), expected, rtol=1e-14)


def test_who_is_not_heard_does_not_matter(gains: Gains) -> None:
    """Bit for bit: the pair of a node with a_ij = 0 may be anything, and may be absent."""
    pairs = random_pairs(gains, 1)
    for mode in gains.problem.mode_names:
        for name in gains.problem.node_names:
            own = gains.for_node(name)
            heard = {link.sender: pairs[link.sender] for link in own.links[mode]}
            assert step(own, mode, heard).tobytes() == step(own, mode, pairs).tobytes()


def test_a_node_must_be_among_those_it_heard(gains: Gains) -> None:
    own = gains.for_node("n0")
    with pytest.raises(KeyError, match="n0"):
        step(own, "mode-0", {})


# messages that do not arrive
@given(st.integers(0, 50))
def test_a_node_stands_in_for_whom_it_did_not_hear(seed: int) -> None:
    """Its own estimate, and no innovation: eqs. (4)(5) of a network in which the sender had said just that."""
    gains = random_gains(random_problem(seed, ny=(1, 3, 2), modes=2), seed)
    pairs = random_pairs(gains, seed)
    for mode in gains.problem.mode_names:
        for name in gains.problem.node_names:
            own = gains.for_node(name)
            for silent in {link.sender for link in own.links[mode]} - {name}:
                heard = {sender: pair for sender, pair in pairs.items() if sender != silent}
                pretended = pairs | {silent: Pair(pairs[name].x_hat, 0.0 * pairs[silent].innovation)}
                expected = written_out(gains, mode, name, pretended)
                np.testing.assert_allclose(step(own, mode, heard), expected, rtol=1e-12, atol=1e-14)


# unbiased gains
@given(st.integers(0, 50), st.booleans())
def test_an_unbiased_step_is_equations_4_and_5_written_out(seed: int, all_arrive: bool) -> None:
    """With K_ii as the file has it: the two differ by its rounding alone. Lost messages are stood in for."""
    gains = observer_gains(real_problem(seed, radius=1.02, ny=(1, 3, 2), nx=3))
    pairs = random_pairs(gains, seed)
    for mode in gains.problem.mode_names:
        for name in gains.problem.node_names:
            own = gains.for_node(name)
            lost = set() if all_arrive else set(gains.problem.node_names[:2]) - {name}
            heard = {sender: pair for sender, pair in pairs.items() if sender not in lost}
            stood_in = {sender: Pair(pairs[name].x_hat, 0.0 * pairs[sender].innovation) for sender in lost}
            expected = written_out(gains, mode, name, pairs | stood_in)
            np.testing.assert_allclose(step(own, mode, heard), expected, rtol=1e-11, atol=1e-12)


def test_nodes_that_agree_follow_the_plant_bit_for_bit() -> None:
    """x_hat_j = x for all and no innovation gives A x exactly, however large x: K_ii is not the rounded one."""
    gains = observer_gains(real_problem(2, radius=1.02))
    x = np.array([1e12 / 3.0, -1e12 / 7.0])
    agreed = {node.name: Pair(x, np.zeros(len(node.C))) for node in gains.problem.nodes}
    rounded = 0
    for mode in gains.problem.mode_names:
        for name in gains.problem.node_names:
            assert step(gains.for_node(name), mode, agreed).tolist() == product(gains.problem.plant.A, x).tolist()
            rounded += written_out(gains, mode, name, agreed) != product(gains.problem.plant.A, x).tolist()
    assert rounded > 0  # by the gains of the file it would not have been exact


@given(st.integers(0, 50), st.randoms(use_true_random=False))
def test_the_order_of_the_links_matters_to_rounding_only(seed: int, chance: random.Random) -> None:
    gains = random_gains(random_problem(seed, ny=(1, 1, 1, 1, 1), modes=1), seed)
    own, pairs = gains.for_node("n0"), random_pairs(gains, seed)
    links = list(own.links["mode-0"])
    chance.shuffle(links)
    rows = np.hstack([block for _, a_ij, K, H in links for block in (a_ij * K, a_ij * H)])
    shuffled = own._replace(links={"mode-0": tuple(links)}, rows={"mode-0": rows})
    np.testing.assert_allclose(step(shuffled, "mode-0", pairs), step(own, "mode-0", pairs), rtol=1e-12, atol=1e-14)


@given(st.integers(0, 50))
def test_the_order_of_arrival_does_not_matter_at_all(seed: int) -> None:
    """Same seed, same run: the sum goes by the file, not by who came first."""
    gains = random_gains(random_problem(seed, ny=(1, 1, 1), modes=1), seed)
    own, pairs = gains.for_node("n0"), random_pairs(gains, seed)
    backwards = dict(reversed(pairs.items()))
    assert step(own, "mode-0", backwards).tobytes() == step(own, "mode-0", pairs).tobytes()


@given(st.integers(0, 50), st.floats(-100.0, 100.0))
def test_a_step_is_linear(seed: int, factor: float) -> None:
    gains = random_gains(random_problem(seed, ny=(1, 2), modes=1), seed)
    own, one, two = gains.for_node("n1"), random_pairs(gains, seed), random_pairs(gains, seed + 1)

    def added(a: Array, b: Array) -> Array:
        return a + factor * b

    both = {name: Pair(*map(added, one[name], two[name])) for name in one}
    expected = step(own, "mode-0", one) + factor * step(own, "mode-0", two)
    np.testing.assert_allclose(step(own, "mode-0", both), expected, rtol=1e-9, atol=1e-9)


def test_nothing_known_and_nothing_measured_stays_nothing(gains: Gains) -> None:
    own = gains.for_node("n1")
    silent = {node.name: Pair(np.zeros(2), np.zeros(len(node.C))) for node in gains.problem.nodes}
    assert step(own, "mode-1", silent).tolist() == [0.0, 0.0]


def test_a_step_changes_nothing_it_was_given(gains: Gains) -> None:
    pairs = random_pairs(gains, 2)
    before = {name: [part.tobytes() for part in pair] for name, pair in pairs.items()}
    step(gains.for_node("n0"), "mode-0", pairs)
    assert {name: [part.tobytes() for part in pair] for name, pair in pairs.items()} == before


# the innovation
@given(st.integers(0, 50))
def test_an_innovation_is_the_bracket_of_equation_4(seed: int) -> None:
    """y - beta C x_hat, with beta: the node is not told whether its measurement arrived."""
    gains = random_gains(random_problem(seed, ny=(1, 3), modes=1), seed)
    rng, node = np.random.default_rng(seed), gains.problem.nodes[1]
    assert node.arrival_probability == 0.8
    y, x_hat = rng.normal(size=3), rng.normal(size=2)
    expected = [y[m] - 0.8 * sum(node.C[m, c] * x_hat[c] for c in range(2)) for m in range(3)]
    np.testing.assert_allclose(innovation(gains.for_node("n1"), y, x_hat), expected, rtol=1e-12, atol=1e-14)


def test_a_lost_measurement_leaves_the_disturbance_only(gains: Gains) -> None:
    """Eq. (2) with theta = 0 is y = D w: what the innovation then lacks is C x, all of it and nothing else."""
    node, own = gains.problem.nodes[1], gains.for_node("n1")
    rng = np.random.default_rng(0)
    x, w, x_hat = rng.normal(size=2), rng.normal(size=2), rng.normal(size=2)
    lost = innovation(own, 0.0 * (node.C @ x) + node.D @ w, x_hat)
    arrived = innovation(own, 1.0 * (node.C @ x) + node.D @ w, x_hat)
    assert lost.tolist() == (node.D @ w - node.arrival_probability * (node.C @ x_hat)).tolist()
    np.testing.assert_allclose(arrived - lost, node.C @ x, rtol=1e-12)


def test_a_perfect_estimate_without_loss_leaves_the_noise() -> None:
    gains = random_gains(random_problem(2, ny=(2,), modes=1))
    node, rng = gains.problem.nodes[0], np.random.default_rng(0)
    x, w = rng.normal(size=2), rng.normal(size=2)
    assert node.arrival_probability == 1.0
    left = innovation(gains.for_node("n0"), node.C @ x + node.D @ w, x)
    np.testing.assert_allclose(left, node.D @ w, rtol=1e-12, atol=1e-14)


# a node that sees its losses
def test_a_node_that_sees_its_losses_takes_the_whole_of_what_arrives() -> None:
    """y - C x_hat whatever beta is, and 0 where nothing arrived."""
    problem = real_problem(2, ny=(1, 3), modes=1)
    node, own = problem.nodes[1], observer_gains(problem).for_node("n1")
    assert (node.seen, node.arrival_probability) == (True, 0.8)
    rng = np.random.default_rng(0)
    x, w, x_hat = rng.normal(size=2), rng.normal(size=2), rng.normal(size=2)
    arrived = innovation(own, node.C @ x + node.D @ w, x_hat)
    np.testing.assert_allclose(arrived, node.C @ (x - x_hat) + node.D @ w, rtol=1e-12, atol=1e-14)
    assert innovation(own, np.empty(0), x_hat).tolist() == [0.0, 0.0, 0.0]
