"""What is drawn is what was recorded."""

from __future__ import annotations

from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from made_recordings import random_gains, random_problem, record, simulate
from places import GOLDEN
from reports import account_of, recorded_network

from designer.report.account import Account
from designer.report.chart import LOOKS, Band, Chart, Level, Line, Map, Raster
from designer.report.colours import ramp, rgb
from designer.report.pictures import SINGLE, pictures
from designer.report.scales import columns


def drawn(account: Account) -> dict[str, Chart]:
    return {chart.key: chart for chart in pictures(account)}


def lines(chart: Chart) -> dict[str, np.ndarray]:
    return {mark.name: mark.values for mark in chart.marks if isinstance(mark, Line)}


@pytest.mark.parametrize("nz", [1, 3])
def test_the_lines_are_the_recording(tmp_path: Path, nz: int) -> None:
    account = account_of(tmp_path, nz=nz)
    charts, log = drawn(account), account.log
    for row in range(nz):
        number = "" if nz == 1 else f"-{row + 1}"
        shown, wrong = lines(charts[f"outputs{number}"]), lines(charts[f"errors{number}"])
        assert list(shown) == [*(f"ẑ of node n{i}" for i in range(4)), "z of the plant"]
        np.testing.assert_array_equal(shown["z of the plant"], log.z[:, row])
        for i in range(4):
            np.testing.assert_array_equal(shown[f"ẑ of node n{i}"], log.z_hat[:, i * nz + row])
            np.testing.assert_array_equal(wrong[f"node n{i}"], log.z[:, row] - log.z_hat[:, i * nz + row])
    np.testing.assert_array_equal(lines(charts["modes"])["topology"], log.mode)
    assert charts["modes"].categories == log.gains.problem.mode_names


def test_of_many_nodes_there_are_the_range_the_median_and_the_worst_by_name(tmp_path: Path) -> None:
    account = account_of(tmp_path, ny=(1,) * (SINGLE + 1))
    charts, sizes, worst = drawn(account), account.sizes, account.ranking
    band, _, *named = charts["errors"].marks
    assert isinstance(band, Band)
    np.testing.assert_array_equal(band.low, sizes.min(axis=1))
    np.testing.assert_array_equal(band.high, sizes.max(axis=1))
    np.testing.assert_array_equal(lines(charts["errors"])["median node"], np.median(sizes, axis=1))
    assert [mark.name for mark in named] == [
        f"node n{worst[0]} (worst)", f"node n{worst[1]} (second worst)", f"node n{worst[2]} (third worst)"
    ]  # fmt: skip
    rows = charts["error-map"].rows
    assert isinstance(rows, Map)
    assert rows.rows == tuple(f"n{i}" for i in worst)
    np.testing.assert_array_equal(rows.values, sizes[:, worst])


def test_the_three_envelopes_are_drawn_where_gamma_is_proved(tmp_path: Path) -> None:
    account = Account.of(GOLDEN / "zhu2020-lossy.mcap")
    chart = drawn(account)["bounds"]
    shown, (chance,) = lines(chart), [mark for mark in chart.marks if isinstance(mark, Level)]
    energies = (account.log.w**2).sum(axis=1)
    mean = account.log.gains.certificate.gamma * np.sqrt(np.cumsum(energies) - energies)
    np.testing.assert_allclose(shown["bound in the mean, γ"], mean, rtol=1e-12, atol=1e-16)
    np.testing.assert_array_equal(shown["this run's own bound, γ_path"], account.trace.path_bound)
    assert (chance.name, chance.value > mean.max()) == ("at least 95% of such runs stay below at every step", True)
    unproved = drawn(account_of(tmp_path))["bounds"]
    assert list(lines(unproved)) == ["this run's own bound, γ_path", "|z̃|, all nodes together"]
    assert unproved.remark == "No γ is drawn: none is proved for these gains."


def test_the_axis_of_the_bounds_shows_the_errors(tmp_path: Path) -> None:
    """Where the bounds are far above them it is logarithmic."""
    for account in (Account.of(GOLDEN / "zhu2020-lossy.mcap"), account_of(tmp_path, steps=200)):
        chart, log = drawn(account)["bounds"], account.log
        scale = chart.scale(columns(0, log.steps, 1000))
        assert scale.of(np.array(account.log.error_norms().max())) > 0.2
        assert scale.of(np.nanmax(account.trace.path_bound)) <= 1.0


def test_losses_and_substitutions_are_marked(tmp_path: Path) -> None:
    account = Account.of(recorded_network(tmp_path))
    rows = drawn(account)["losses"].rows
    assert isinstance(rows, Raster)
    (lost, _, where_lost), (without, _, where_without) = rows.layers
    assert (lost, without) == ("measurement lost", "message not used")
    np.testing.assert_array_equal(where_lost, account.lost)
    np.testing.assert_array_equal(where_without > 0.0, account.done_without > 0.0)


def test_without_a_plant_no_error_is_shown(tmp_path: Path) -> None:
    gains = random_gains(random_problem(3))
    sent = simulate(gains, steps=20, real_y={"n1": np.zeros((20, 2))})
    charts = drawn(Account.of(record(tmp_path / "run.mcap", gains, sent, steps=20, external="n1")))
    assert "bounds" not in charts
    assert "z of the plant" not in lines(charts["outputs"])
    assert charts["errors"].title == "How far every node is from the others"


# colours
VISIONS = {  # Machado, Oliveira and Fernandes 2009, severity 1: of linear red, green and blue
    "normal": [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
    "protan": [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]],
    "deutan": [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]],
    "tritan": [[1.255528, -0.076749, -0.178779], [-0.078411, 0.930809, 0.147602], [0.004733, 0.691367, 0.303900]],
}  # fmt: skip
TOGETHER = [  # what one chart may have
    ["plant", *(f"node-{i}" for i in range(SINGLE))],
    ["range", "median", "worst-0", "worst-1", "worst-2", "plant"],
    ["path", "mean", "chance", "plant"],
    ["proof-1", "proof-2", "proof-3", "tolerance"],
    ["lost", "without"],
]


def linear_light(colour: str) -> np.ndarray:
    part = np.array(rgb(colour)) / 255.0
    return np.where(part <= 0.04045, part / 12.92, ((part + 0.055) / 1.055) ** 2.4)


def lab(light: np.ndarray) -> np.ndarray:
    """CIELAB of linear sRGB, white D65."""
    to_xyz = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])
    xyz = to_xyz @ np.clip(light, 0.0, 1.0) / to_xyz.sum(axis=1)
    f = np.where(xyz > 0.008856, np.cbrt(xyz), 7.787 * xyz + 16.0 / 116.0)
    return np.array([116.0 * f[1] - 16.0, 500.0 * (f[0] - f[1]), 200.0 * (f[1] - f[2])])


def distance(one: str, other: str, vision: str) -> float:
    seen = [lab(np.array(VISIONS[vision]) @ linear_light(colour)) for colour in (one, other)]
    return float(np.linalg.norm(seen[0] - seen[1]))


@pytest.mark.parametrize("theme", ["light", "dark"])
@pytest.mark.parametrize("vision", VISIONS)
def test_what_stands_in_one_chart_is_told_apart(vision: str, theme: str) -> None:
    """By colour in every colour vision; 10 units of CIELAB are plain to see. Or by dashes."""
    for looks in TOGETHER:
        for one, other in combinations(looks, 2):
            by_dashes = LOOKS[one].dashes != LOOKS[other].dashes
            apart = distance(getattr(LOOKS[one], theme), getattr(LOOKS[other], theme), vision)
            assert by_dashes or apart > 10.0, (one, other, apart)


def test_colours_that_are_not_told_apart_are_found() -> None:
    """So that the test above means something: red and green of the same lightness."""
    assert distance("#c00000", "#007a00", "normal") > 60.0
    assert distance("#a05a00", "#5a7d00", "deutan") < 20.0


def test_a_map_grows_darker_all_the_way() -> None:
    light = [lab(linear_light("#" + bytes(colour[:3]).hex()))[0] for colour in ramp(64)]
    assert (np.diff(light) < 0.0).all()
    assert light[0] > 95.0
    assert light[-1] < 20.0
