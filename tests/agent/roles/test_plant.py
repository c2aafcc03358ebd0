"""The simulated plant: eqs. (1)-(3), step after step."""

from __future__ import annotations

import numpy as np
import pytest
from made_recordings import random_problem, real_problem

from agent.contract.errors import RunBroken
from agent.contract.schedule import DisturbanceSource, Losses
from agent.roles.plant import SimulatedPlant


def test_states_and_measurements_are_equations_1_and_2() -> None:
    """Hidden losses leave the disturbance; of a node that sees its losses the measurement is whole, or empty."""
    problem = real_problem(4, radius=1.02)
    losses, source = Losses(problem, seed=2), DisturbanceSource(problem, seed=2)
    plant = SimulatedPlant(problem, seed=2)
    x, empty = np.zeros(problem.nx), 0
    for k in range(60):
        state, measurements = plant.advance(k)
        w, theta = source.at(k), losses.at(k)
        np.testing.assert_allclose(state.x, x, rtol=1e-12, atol=1e-12)
        assert (state.step, state.w, state.arrived) == (k, w.tolist(), theta.tolist())
        for node, theta_i in zip(problem.nodes, theta, strict=True):
            y = measurements[node.name].y
            expected = theta_i * node.C @ x + node.D @ w
            if node.seen and theta_i == 0.0:
                expected, empty = np.empty(0), empty + 1
            np.testing.assert_allclose(y, expected, rtol=1e-12, atol=1e-12)
        x = problem.plant.A @ x + problem.plant.B @ w
    assert empty > 0


def test_hidden_losses_are_never_empty() -> None:
    problem = random_problem(4)
    plant = SimulatedPlant(problem, seed=2)
    lost = 0
    for k in range(60):
        state, measurements = plant.advance(k)
        lost += state.arrived.count(0)
        assert [len(measurements[node.name].y) for node in problem.nodes] == [len(node.C) for node in problem.nodes]
    assert lost > 0


def test_a_step_out_of_turn_is_refused() -> None:
    plant = SimulatedPlant(random_problem(4), seed=2)
    plant.advance(0)
    with pytest.raises(RunBroken, match="the mode of step 2 came where that of step 1 was due"):
        plant.advance(2)


def test_a_state_that_outgrows_float64_ends_the_run_in_one_sentence() -> None:
    plant = SimulatedPlant(real_problem(4, radius=10.0), seed=2)
    with pytest.raises(RunBroken, match=r"^the state of the plant is beyond 1e\+140 at step \d+; its A lets it grow$"):
        all(plant.advance(k) for k in range(400))
