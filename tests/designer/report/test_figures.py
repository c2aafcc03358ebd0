"""Figures for a paper: the recording's numbers, at the widths of journals, always the same."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from places import GOLDEN
from reports import account_of

from agent.contract.errors import InputError
from designer.report import figures
from designer.report.account import Account
from designer.report.chart import Chart
from designer.report.pictures import pictures
from designer.report.scales import columns


def drawn(account: Account) -> dict[str, Chart]:
    return {chart.key: chart for chart in pictures(account)}


def figure(account: Account, key: str, *, steps: int | None = None) -> object:
    return figures.figure(drawn(account)[key], columns(0, steps or account.log.steps, 2000), 3.5).axes[0]


def stairs(axes: object) -> dict[str, np.ndarray]:
    """Label -> values, of what is drawn as steps."""
    return {patch.get_label(): patch.get_data().values for patch in axes.patches}  # type: ignore[attr-defined]


def test_the_steps_and_dots_are_the_recording(tmp_path: Path) -> None:
    account = account_of(tmp_path)
    axes = figure(account, "outputs")
    (dots,) = axes.lines  # type: ignore[attr-defined]
    np.testing.assert_array_equal(dots.get_xydata(), np.column_stack([np.arange(50), account.log.z[:, 0]]))
    assert dots.get_linestyle() == "None", "discrete values are not joined"
    for i in range(4):
        steps = stairs(axes)[rf"$\hat{{z}}$ of node n{i}"]
        np.testing.assert_array_equal(steps, account.log.z_hat[:, i])
    errors = stairs(figure(account, "errors"))
    np.testing.assert_array_equal(errors["node n2"], account.log.z[:, 0] - account.log.z_hat[:, 2])


def test_a_map_has_every_error(tmp_path: Path) -> None:
    account = account_of(tmp_path, ny=(1,) * 8)
    (image,) = figure(account, "error-map").images  # type: ignore[attr-defined]
    np.testing.assert_array_equal(image.get_array().T, account.sizes[:, account.ranking])


def test_axes_end_near_the_data(tmp_path: Path) -> None:
    for account in (Account.of(GOLDEN / "zhu2020-lossy.mcap"), account_of(tmp_path)):
        low, high = figure(account, "outputs").get_ylim()  # type: ignore[attr-defined]
        values = np.hstack([account.log.z, account.log.z_hat])
        assert low <= values.min() <= values.max() <= high
        assert high - low < 1.1 * (values.max() - values.min())


def test_every_axis_has_a_label_with_a_unit_or_a_name(tmp_path: Path) -> None:
    account = account_of(tmp_path, nz=2)
    for key in drawn(account):
        axes = figure(account, key)
        assert axes.get_xlabel() == "step $k$"  # type: ignore[attr-defined]
        label = axes.get_ylabel()  # type: ignore[attr-defined]
        assert "dimensionless" in label or label in {"topology", "node", "relative gap"}, key


@pytest.mark.parametrize("kind", ["pdf", "svg", "png"])
def test_files_have_the_width_of_one_and_two_columns_and_are_always_the_same(tmp_path: Path, kind: str) -> None:
    account = Account.of(GOLDEN / "zhu2020-lossy.mcap")
    some = {key: chart for key, chart in drawn(account).items() if key == "outputs"}
    drawings = figures.drawings(some, stop=account.settled)
    drawings["topologies"] = lambda width: figures.topologies(account.log.gains.problem, width)
    drawings["ladder"] = lambda width: figures.ladder(account.rungs, width)
    paths = figures.write(drawings, tmp_path, kind=kind)
    assert [path.name for path in paths[:2]] == [f"outputs-one-column.{kind}", f"outputs-two-columns.{kind}"]
    for path in paths:
        wanted = 3.5 if "one" in path.name else 7.16
        assert width_of(path) == pytest.approx(wanted, abs=0.01), path.name
        assert path.stat().st_size < 300_000
    before = [path.read_bytes() for path in paths]
    with pytest.raises(InputError, match="--force"):
        figures.write(drawings, tmp_path, kind=kind)
    assert [path.read_bytes() for path in figures.write(drawings, tmp_path, kind=kind, force=True)] == before


def width_of(path: Path) -> float:
    """In inches, as the file itself says."""
    data = path.read_bytes()
    match path.suffix:
        case ".png":
            return int.from_bytes(data[16:20], "big") / figures.DPI
        case ".svg":
            found = re.search(rb'<svg [^>]*width="([\d.]+)pt"', data, flags=re.DOTALL)
        case _:
            found = re.search(rb"/MediaBox \[ ?0 0 ([\d.]+)", data)
    assert found is not None
    return float(found[1]) / 72.0


def test_letters_are_embedded_in_a_pdf(tmp_path: Path) -> None:
    account = account_of(tmp_path)
    drawing = figures.figure(drawn(account)["outputs"], columns(0, 50, 2000), 3.5)
    assert b"/FontFile2" in figures.rendered(drawing, "pdf")


def test_a_long_run_keeps_its_extremes(tmp_path: Path) -> None:
    account = account_of(tmp_path, steps=200)
    shown = columns(0, 200, 40)
    axes = figures.figure(drawn(account)["outputs"], shown, 3.5).axes[0]
    top = max(patch.get_data().values.max() for patch in axes.patches)
    assert top == max(account.log.z.max(), account.log.z_hat.max())
    (shares,) = figures.figure(drawn(account)["modes"], shown, 3.5).axes[0].images
    np.testing.assert_allclose(shares.get_array().sum(axis=0), 1.0)
