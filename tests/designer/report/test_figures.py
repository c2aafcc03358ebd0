"""Pictures show what was recorded: the numbers in their lines are the recording's."""

from __future__ import annotations

import math
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from made_recordings import random_gains, random_problem, record, simulate
from places import ROOT

from agent.contract.errors import InputError
from designer.replay.log import Log, load
from designer.report import figures

STEPS = 50
GOLDEN = ROOT / "recordings" / "golden" / "zhu2020-lossy.mcap"


def make(folder: Path, *, ny: tuple[int, ...] = (1, 2, 1, 1), nz: int = 1, steps: int = STEPS) -> Path:
    gains = random_gains(random_problem(3, ny=ny, nz=nz))
    return record(folder / "run.mcap", gains, simulate(gains, steps=steps), steps=steps)


def lines(axes: object, names: list[str]) -> dict[str, np.ndarray]:
    """Label -> values, of the lines with these labels."""
    return {line.get_label(): line.get_ydata() for line in axes.lines if line.get_label() in names}  # type: ignore[attr-defined]


@pytest.mark.parametrize("nz", [1, 3])
def test_the_lines_are_the_recording(tmp_path: Path, nz: int) -> None:
    log = load(make(tmp_path, nz=nz))
    names = [f"node {name}" for name in log.gains.problem.node_names]
    estimates = [rf"$\hat{{z}}$ of {name}" for name in names]
    outputs, errors = figures.outputs_figure(log), figures.errors_figure(log)
    assert len(outputs.axes) == len(errors.axes) == nz + 1
    for row in range(nz):
        shown = lines(outputs.axes[row], [*estimates, "$z$"])
        np.testing.assert_array_equal(shown["$z$"], log.z[:, row])
        wrong = lines(errors.axes[row], names)
        assert len(shown) == len(names) + 1
        assert len(wrong) == len(names)
        for i, (name, estimate) in enumerate(zip(names, estimates, strict=True)):
            np.testing.assert_array_equal(shown[estimate], log.z_hat[:, i * nz + row])
            np.testing.assert_array_equal(wrong[name], log.z[:, row] - log.z_hat[:, i * nz + row])
    np.testing.assert_array_equal(outputs.axes[-1].lines[0].get_ydata(), log.mode)
    norms = [line.get_ydata() for line in errors.axes[-1].lines]
    assert max(norms[0]) == norms[1][0], "the dot is the peak"
    assert len(norms) == 2, "where gamma is not proved, no bound is drawn"


def test_the_bound_is_drawn_where_gamma_is_proved() -> None:
    log = load(GOLDEN)
    figure = figures.errors_figure(log)
    bound, norm, peak = (line.get_ydata() for line in figure.axes[-1].lines)
    energy = np.square(log.w).sum()
    assert bound[-1] == pytest.approx(log.gains.certificate.gamma * np.sqrt(energy), rel=1e-6)
    assert (norm <= bound).all()
    assert peak[0] == max(norm)


def test_the_caption_says_what_is_shown_and_a_note_what_is_not() -> None:
    log = load(GOLDEN)
    gamma = math.ceil(1e6 * log.gains.certificate.gamma) / 1e6
    for figure in (figures.outputs_figure(log), figures.errors_figure(log)):
        assert figure.get_supxlabel() == f"zhu2020-lossy, seed 2020, γ = {gamma:.6f}"
        panel, strip = figure.axes
        last = round(strip.get_xlim()[1])
        assert panel.get_title("right").startswith(f"steps {last + 1} to {log.steps - 1}, where")
        hidden = np.abs(np.hstack([log.z, log.z_hat])[last + 1 :]).max()
        assert hidden <= 0.01 * np.abs(np.hstack([log.z, log.z_hat])).max()


def test_modes_are_a_staircase_where_few_steps_of_a_long_run_are_shown(monkeypatch: pytest.MonkeyPatch) -> None:
    log = load(GOLDEN)
    monkeypatch.setattr(figures, "STAIRS", log.steps - 1)
    strip = figures.outputs_figure(log).axes[-1]
    shown = round(strip.get_xlim()[1]) + 1
    assert shown < figures.STAIRS
    np.testing.assert_array_equal(strip.lines[0].get_ydata(), log.mode[:shown])


@pytest.mark.parametrize("n", [2, 8])
def test_nodes_that_coincide_are_told_apart(tmp_path: Path, n: int) -> None:
    log = load(make(tmp_path, ny=(1,) * n, steps=200))
    drawn = [line for line in figures.outputs_figure(log).axes[0].lines if line.get_label() != "$z$"]
    assert len({line.get_marker() for line in drawn}) == n
    assert all(line.get_linewidth() > after.get_linewidth() for line, after in pairwise(drawn))
    assert max(len(line.get_markevery()) for line in drawn) <= figures.MARKED


def test_ticks_cover_the_curves(tmp_path: Path) -> None:
    for log in (load(GOLDEN), load(make(tmp_path, nz=3))):
        for figure in (figures.outputs_figure(log), figures.errors_figure(log)):
            for axes in figure.axes[:-1]:
                ticks = axes.get_yticks()
                values = np.concatenate([line.get_ydata() for line in axes.lines])
                assert len(ticks) >= 4
                assert ticks[0] <= values.min() < values.max() <= ticks[-1]


def test_the_pictures_of_the_documents_are_small(tmp_path: Path) -> None:
    assert all(path.stat().st_size < 100_000 for path in figures.write(GOLDEN, tmp_path) if path.suffix == ".svg")


def test_every_node_stands_in_the_legend(tmp_path: Path) -> None:
    log = load(make(tmp_path, ny=(1,) * 7))
    nodes = [f"node n{i}" for i in range(7)]
    estimates = ["$z$", *(rf"$\hat{{z}}$ of {node}" for node in nodes)]
    for figure, expected in ((figures.outputs_figure(log), estimates), (figures.errors_figure(log), nodes)):
        assert [text.get_text() for text in figure.legends[0].get_texts()] == expected
        assert figure.axes[-1].get_xlabel() == "step $k$"


@pytest.mark.parametrize(("ny", "steps"), [((1,), 10), ((1,) * 30, 20), ((1, 1), 5000)])
def test_files_are_written_and_small(tmp_path: Path, ny: tuple[int, ...], steps: int) -> None:
    paths = figures.write(make(tmp_path, ny=ny, steps=steps), tmp_path)
    assert [path.name for path in paths] == ["run-outputs.svg", "run-outputs.png", "run-errors.svg", "run-errors.png"]
    written = [path.read_bytes() for path in paths]
    assert written[0].startswith(b"<?xml")
    assert written[1].startswith(b"\x89PNG")
    assert max(map(len, written)) < 1_000_000


def test_files_are_always_the_same(tmp_path: Path) -> None:
    """And they are replaced only where that is asked for."""
    recording = make(tmp_path, steps=20)
    before = [path.read_bytes() for path in figures.write(recording, tmp_path)]
    with pytest.raises(InputError, match="--force"):
        figures.write(recording, tmp_path)
    assert [path.read_bytes() for path in figures.write(recording, tmp_path, force=True)] == before


def test_a_long_line_keeps_its_extremes() -> None:
    values = np.random.default_rng(0).normal(size=100_000)
    values[77_777] = 9.0
    steps, kept = figures.thinned(values)
    assert len(kept) <= figures.POINTS
    assert (np.diff(steps) > 0).all()
    np.testing.assert_array_equal(kept, values[steps.astype(int)])
    assert (kept.min(), kept.max()) == (values.min(), 9.0)


def test_a_line_with_holes_is_drawn_with_holes() -> None:
    values = np.arange(10_000.0)
    values[3000:4000] = np.nan
    _, kept = figures.thinned(values)
    assert np.isnan(kept).any()
    assert np.nanmax(kept) == 9999.0


def test_a_cut_recording_can_be_drawn(tmp_path: Path) -> None:
    gains = random_gains(random_problem(3))
    sent = simulate(gains, steps=STEPS)
    path = record(tmp_path / "run.mcap", gains, sent[:200], steps=STEPS, whole=False)
    assert len(figures.write(path, tmp_path)) == 4


def test_without_a_plant_there_are_no_errors_to_draw(tmp_path: Path) -> None:
    gains = random_gains(random_problem(3))
    real = {"n1": np.zeros((STEPS, 2))}
    sent = simulate(gains, steps=STEPS, real_y=real)
    path = record(tmp_path / "run.mcap", gains, sent, steps=STEPS, external="n1")
    assert [path.name for path in figures.write(path, tmp_path)] == ["run-outputs.svg", "run-outputs.png"]
    log: Log = load(path)
    assert lines(figures.outputs_figure(log).axes[0], ["$z$"]) == {}
