"""Draws are a function of (seed, stream, step) alone, have the stated probabilities, and never change.

The draws are pinned to Philox4x64-10 as published (Salmon, Moraes, Dror, Shaw, "Parallel random numbers: as easy as
1, 2, 3", SC 2011), which is written out below: numpy's own streams of distributions may change between its versions,
the raw words of its Philox bit generator may not, and only those are used.
"""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from made_recordings import random_problem, real_problem

from agent.contract.problem import Problem
from agent.contract.schedule import (
    DELIVERIES,
    DISTURBANCE,
    LOSSES,
    MODES,
    Deliveries,
    DisturbanceSource,
    Losses,
    Stream,
    modes,
    normal,
)

MASK = 2**64 - 1
SEEDS = st.integers(0, 2**63 - 1)


def philox(counter: int, key: tuple[int, int]) -> list[int]:
    """Philox4x64-10: four words of 64 bits from a counter of 256 bits and a key of two words."""
    c0, c1, c2, c3 = ((counter >> shift) & MASK for shift in (0, 64, 128, 192))
    k0, k1 = key
    for _ in range(10):
        product_0, product_1 = 0xD2E7470EE14C6C93 * c0, 0xCA5A826395121157 * c2
        c0, c1, c2, c3 = (
            (product_1 >> 64) ^ c1 ^ k0,
            product_1 & MASK,
            (product_0 >> 64) ^ c3 ^ k1,
            product_0 & MASK,
        )
        k0, k1 = (k0 + 0x9E3779B97F4A7C15) & MASK, (k1 + 0xBB67AE8584CAA73B) & MASK
    return [c0, c1, c2, c3]


def disturbed(**disturbance: object) -> Problem:
    document = random_problem(2, ny=(1,), modes=1, nw=3).document()
    return Problem.from_document(document | {"disturbance": disturbance})


def chain(transition: list[list[float]]) -> Problem:
    """A problem of one node whose modes differ in nothing but their names."""
    document = random_problem(2, ny=(1,), modes=1).document()
    names = [f"m{s}" for s in range(len(transition))]
    topologies = [{"name": name, "adjacency": [[1.0]]} for name in names]
    markov = {"transition": transition, "initial": names[-1]}
    return Problem.from_document(document | {"topology": topologies, "markov": markov})


# addressed by (seed, stream, step)
def test_the_reference_gives_the_published_words() -> None:
    """The first known answers of Random123 for philox4x64-10."""
    assert philox(0, (0, 0)) == [0x16554D9ECA36314C, 0xDB20FE9D672D0FDC, 0xD7E772CEE186176B, 0x7E68B68AEC7BA23B]
    ones = philox(2**256 - 1, (MASK, MASK))
    assert ones == [0x87B092C3013FE90B, 0x438C3C67BE8D0224, 0x9CC7D7C69CD777B6, 0xA09CAEBF594F0BA0]


@given(SEEDS, st.integers(1, 3), st.integers(0, 2**40), st.integers(1, 9))
def test_a_draw_is_53_bits_of_philox(seed: int, stream: int, step: int, width: int) -> None:
    """Step k has ceil(width / 4) counts of its own; numpy counts from 1."""
    counts = math.ceil(width / 4)
    words = [word for c in range(counts) for word in philox(step * counts + c + 1, (seed, stream))]
    expected = [(word >> 11) / 2.0**53 for word in words[:width]]
    assert Stream(seed=seed, stream=stream, width=width).at(step).tolist() == expected


@given(SEEDS, st.lists(st.integers(0, 2000), min_size=1, max_size=12))
def test_any_order_of_steps_gives_the_same_draws(seed: int, steps: list[int]) -> None:
    stream = Stream(seed=seed, stream=LOSSES, width=5)
    for step in steps:
        assert stream.at(step).tolist() == Stream(seed=seed, stream=LOSSES, width=5).at(step).tolist()


@given(SEEDS, st.integers(0, 1000), st.integers(1, 300), st.integers(1, 9))
def test_many_steps_at_once_are_the_same_draws(seed: int, first: int, steps: int, width: int) -> None:
    stream = Stream(seed=seed, stream=MODES, width=width)
    bulk = stream.uniform(first, steps)
    assert bulk.tolist() == [stream.at(step).tolist() for step in range(first, first + steps)]


def test_no_two_seeds_streams_or_steps_share_a_draw() -> None:
    draws = [
        value
        for seed, stream in itertools.product((0, 1, 2, 2**63 - 1), (MODES, LOSSES, DISTURBANCE, DELIVERIES))
        for value in Stream(seed=seed, stream=stream, width=3).uniform(0, 300).ravel()
    ]
    assert len(set(draws)) == len(draws)


def test_draws_lie_in_0_to_1_and_are_even() -> None:
    """Ten bins of 100 000 draws; chi-square with 9 degrees of freedom exceeds 60 with probability 1e-9."""
    draws = Stream(seed=1, stream=MODES, width=4).uniform(0, 25_000).ravel()
    assert draws.min() >= 0.0
    assert draws.max() < 1.0
    counts = np.histogram(draws, bins=10, range=(0.0, 1.0))[0]
    assert ((counts - 10_000.0) ** 2 / 10_000.0).sum() < 60.0


# modes
def test_the_chain_begins_at_the_initial_mode_whatever_the_seed() -> None:
    problem = random_problem(3)
    for seed in range(20):
        assert next(modes(problem, seed=seed)) == problem.mode_index(problem.markov.initial)


def test_a_chain_begun_again_goes_the_same_way() -> None:
    problem = random_problem(3)
    first, again = modes(problem, seed=4), modes(problem, seed=4)
    assert list(itertools.islice(first, 600)) == list(itertools.islice(again, 600))
    assert list(itertools.islice(modes(problem, seed=5), 600)) != list(itertools.islice(again, 600))


def test_transitions_have_the_probabilities_of_the_chain() -> None:
    """Of each row, within 6 standard deviations: a false alarm once in 5e8."""
    transition = np.array([[0.5, 0.2, 0.1, 0.2], [0.2, 0.5, 0.2, 0.1], [0.2, 0.1, 0.6, 0.1], [0.1, 0.1, 0.1, 0.7]])
    gone = list(itertools.islice(modes(chain(transition.tolist()), seed=11), 40_001))
    counts = np.zeros((4, 4))
    np.add.at(counts, (gone[:-1], gone[1:]), 1.0)
    visits = counts.sum(axis=1, keepdims=True)
    deviation = np.sqrt(transition * (1.0 - transition) / visits)
    assert (np.abs(counts / visits - transition) < 6.0 * deviation).all()


def test_what_has_probability_0_never_happens_and_1_always() -> None:
    assert set(itertools.islice(modes(chain([[1.0]]), seed=0), 300)) == {0}
    ring = list(itertools.islice(modes(chain([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]]), seed=0), 300))
    assert ring == [(2 + step) % 3 for step in range(300)]


@pytest.mark.parametrize("draw", [0.0, 1.0 - 2.0**-53])
def test_the_rarest_draws_do_not_bring_what_has_probability_0(draw: float, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Stream, "at", lambda self, step: np.array([draw]))
    row = [0.0, 1.0, 0.0]
    assert list(itertools.islice(modes(chain([row, row, row]), seed=0), 4)) == [2, 1, 1, 1]


@pytest.mark.parametrize("miss", [-0.9e-9, 0.9e-9])
def test_a_row_that_misses_1_by_rounding_draws_a_mode_that_exists(miss: float, monkeypatch: pytest.MonkeyPatch) -> None:
    problem = chain([[0.5, 0.5 + miss], [0.5, 0.5 + miss]])
    monkeypatch.setattr(Stream, "at", lambda self, step: np.array([1.0 - 2.0**-53]))
    assert set(itertools.islice(modes(problem, seed=0), 10)) == {1}


# losses
def test_measurements_arrive_with_probability_beta_independently() -> None:
    """Frequencies of every node and of every pair, within 6 standard deviations."""
    problem = random_problem(6, ny=(1, 1, 1, 1, 1), modes=1)
    source, steps = Losses(problem, seed=3), 20_000
    arrived = np.array([source.at(step) for step in range(steps)])
    assert set(np.unique(arrived)) == {0.0, 1.0}
    beta = problem.beta
    pairs = np.outer(beta, beta)
    np.fill_diagonal(pairs, beta)
    deviation = np.sqrt(pairs * (1.0 - pairs) / steps)
    assert (np.abs(arrived.T @ arrived / steps - pairs) <= 6.0 * deviation).all()


def test_where_beta_is_1_nothing_is_lost() -> None:
    problem = random_problem(6, ny=(1, 1), modes=1)
    source = Losses(problem, seed=0)
    assert problem.beta[0] == 1.0
    assert all(source.at(step)[0] == 1.0 for step in range(2000))


# deliveries
def test_messages_arrive_with_the_probability_of_their_link_independently() -> None:
    """Frequencies of every link and of every pair of links, within 6 standard deviations; other messages always."""
    problem, steps = real_problem(6, ny=(1, 1, 1, 1), modes=3), 20_000
    links = problem.links or ()
    assert len({link.delivery_probability for link in links}) > 1
    source, rho = Deliveries(problem, seed=3), problem.delivery
    delivered = np.array([source.at(step) for step in range(steps)])
    assert delivered[:, rho == 1.0].all()
    assert (rho < 1.0).sum() == len(links)
    arrived, rho = delivered[:, rho < 1.0].astype(float), rho[rho < 1.0]
    pairs = np.outer(rho, rho)
    np.fill_diagonal(pairs, rho)
    deviation = np.sqrt(pairs * (1.0 - pairs) / steps)
    assert (np.abs(arrived.T @ arrived / steps - pairs) <= 6.0 * deviation).all()


@given(SEEDS, st.lists(st.integers(0, 2000), min_size=1, max_size=12))
def test_deliveries_are_addressed_by_their_step(seed: int, steps: list[int]) -> None:
    """A node that has followed the run and a replay that begins anywhere see the same; each link has its own draw."""
    problem = real_problem(6)
    names, followed = problem.node_names, Deliveries(problem, seed=seed)
    draws = Stream(seed=seed, stream=DELIVERIES, width=len(problem.links or ()))
    for step in steps:
        delivered = followed.at(step)
        assert delivered.tolist() == Deliveries(problem, seed=seed).at(step).tolist()
        for draw, link in zip(draws.at(step), problem.links or (), strict=True):
            arrives = delivered[names.index(link.receiver), names.index(link.sender)]
            assert arrives == (draw < link.delivery_probability)


def test_without_links_every_message_arrives() -> None:
    assert all(Deliveries(random_problem(6), seed=0).at(step).all() for step in range(300))


# disturbance
def test_without_disturbance_w_is_0() -> None:
    assert DisturbanceSource(disturbed(kind="none"), seed=1).at(7).tolist() == [0.0, 0.0, 0.0]


@given(st.integers(0, 500))
def test_a_damped_sine_is_its_formula(step: int) -> None:
    problem = disturbed(kind="damped-sine", amplitude=3.0, decay=0.2, frequency=0.7)
    expected = 3.0 * math.exp(-0.2 * step) * math.sin(0.7 * step)
    np.testing.assert_allclose(DisturbanceSource(problem, seed=1).at(step), [expected] * 3, rtol=1e-15, atol=0.0)


def test_a_damped_sine_is_by_default_that_of_the_paper() -> None:
    """w(k) = exp(-0.2 k) sin k."""
    w = DisturbanceSource(disturbed(kind="damped-sine", decay=0.2), seed=1).at(2)
    np.testing.assert_allclose(w, math.exp(-0.4) * math.sin(2.0), rtol=1e-15)


def test_an_impulse_is_there_once() -> None:
    source = DisturbanceSource(disturbed(kind="impulse", amplitude=2.5, at=3), seed=1)
    assert [source.at(step).tolist() for step in range(5)] == [[0.0] * 3] * 3 + [[2.5] * 3] + [[0.0] * 3]


def test_samples_are_the_rows_of_the_file_and_then_0() -> None:
    rows = [[1.0, -2.0, 3.0], [4.0, 5.0, -0.5]]
    source = DisturbanceSource(disturbed(kind="csv", file="w.csv", values=rows), seed=1)
    assert [source.at(step).tolist() for step in range(4)] == [*rows, [0.0] * 3, [0.0] * 3]
    source.at(0)[0] = 9.0  # what is given out is a copy
    assert source.at(0).tolist() == rows[0]


def test_white_noise_is_gaussian_with_its_deviation() -> None:
    """Mean, variance, correlations and fourth moment of 60 000 numbers, within 6 standard deviations."""
    source, steps = DisturbanceSource(disturbed(kind="white", deviation=2.0), seed=5), 20_000
    w = np.array([source.at(step) for step in range(steps)]) / 2.0
    count = w.size
    assert abs(w.mean()) < 6.0 / math.sqrt(count)
    assert abs((w**2).mean() - 1.0) < 6.0 * math.sqrt(2.0 / count)
    assert abs((w**4).mean() - 3.0) < 6.0 * math.sqrt(96.0 / count)
    correlation = (w[:, :2] * w[:, 1:]).mean(axis=0), (w[:-1] * w[1:]).mean(axis=0)  # of components, of steps
    assert np.abs(np.concatenate(correlation)).max() < 6.0 / math.sqrt(steps)


def test_normal_draws_are_those_of_box_and_muller() -> None:
    u = np.array([0.3, 0.0, 0.25, 0.5])
    expected = [math.sqrt(-2.0 * math.log(0.7)) * math.cos(0.5 * math.pi), 0.0]
    np.testing.assert_allclose(normal(u), expected, atol=1e-15)
    assert np.isfinite(normal(np.array([1.0 - 2.0**-53, 0.0]))).all()


# Known answers. They must never change: a recording's seed is worth nothing where they do.
LOSSY = [[0.5, 0.2, 0.1, 0.2], [0.2, 0.5, 0.2, 0.1], [0.2, 0.1, 0.6, 0.1], [0.1, 0.1, 0.1, 0.7]]


def test_draws_are_those_of_every_version() -> None:
    stream = Stream(seed=7, stream=1, width=3)
    assert [u.hex() for u in stream.at(0)] == ["0x1.c3d2b13f7efedp-1", "0x1.79e52f699b24ap-2", "0x1.08bd5be6daadep-1"]
    assert stream.at(1000)[0].hex() == "0x1.22ee0b6a186d2p-2"
    far = Stream(seed=2**63 - 1, stream=3, width=5).at(2**31)
    assert [far[0].hex(), far[4].hex()] == ["0x1.bb091f289ffe4p-1", "0x1.06335d6ebb057p-1"]


def test_modes_losses_and_noise_are_those_of_every_version() -> None:
    gone = list(itertools.islice(modes(chain(LOSSY), seed=1), 30))
    assert gone == [3, 0, 3, 3, 3, 2, 2, 2, 2, 0, 3, 1, 1, 3, 3, 3, 3, 3, 3, 3, 3, 3, 3, 3, 3, 3, 2, 3, 3, 1]
    losses = Losses(random_problem(6, ny=(1, 1, 1, 1), modes=1), seed=1)
    lost = [step for step in range(40) if losses.at(step)[1] == 0.0]
    assert lost == [11, 15, 20, 21, 22, 27, 28, 35]
    problem = real_problem(6, ny=(1, 1, 1, 1), modes=1)
    link = (problem.links or ())[0]
    deliveries, i, j = Deliveries(problem, seed=1), problem.node_index(link.receiver), problem.node_index(link.sender)
    assert link.delivery_probability == 0.6
    assert [step for step in range(20) if not deliveries.at(step)[i, j]] == [0, 3, 5, 7, 9, 10, 17]
    noise = DisturbanceSource(disturbed(kind="white", deviation=1.0), seed=1)
    # the last bits of log and cos are the mathematics library's
    np.testing.assert_allclose(noise.at(0), [1.4175525599465526, -0.6315636844319794, 0.20813939571956022], rtol=1e-14)
