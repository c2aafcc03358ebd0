"""The paper's figures show runs as they are recorded."""

from __future__ import annotations

import numpy as np
from places import GOLDEN

from agent.contract.gains import Gains
from designer.replay.log import load
from designer.report import figures, paper
from designer.report.chart import Line

GAINS = Gains.load(GOLDEN / "zhu2020-lossy.gains.json")


def test_its_runs_are_those_of_the_network() -> None:
    """With the gains and the seed of the golden recording it gives what the processes of that run sent."""
    log = load(GOLDEN / "zhu2020-lossy.mcap")
    run = paper.run(GAINS, steps=log.steps, seed=log.seed)
    np.testing.assert_array_equal(run.mode, log.mode)
    np.testing.assert_allclose(run.z, log.z, atol=1e-16)
    np.testing.assert_allclose(run.z_tilde[:, :, 0], log.z - log.z_hat, atol=1e-15)


def test_there_are_figures_2_to_6_and_both_examples_have_the_modes_of_figure_2() -> None:
    charts = paper.charts(GAINS, GAINS)
    assert list(charts) == [f"figure-{number}" for number in range(2, 7)]
    run = paper.run(GAINS)
    outputs = {mark.name: mark.values for mark in charts["figure-4"].marks if isinstance(mark, Line)}
    errors = {mark.name: mark.values for mark in charts["figure-6"].marks if isinstance(mark, Line)}
    for i in range(4):
        gap = outputs["z of the plant"] - outputs[f"ẑ of node {i + 1}"] - errors[f"node {i + 1}"]
        assert np.abs(gap).max() < 1e-16
    np.testing.assert_array_equal(charts["figure-2"].marks[0].values, run.mode)  # type: ignore[union-attr]
    assert run.mode[0] == 0, "r(0) = 1 in the paper's numbers"
    assert list(figures.drawings(charts, stop=paper.STEPS)) == list(charts)
