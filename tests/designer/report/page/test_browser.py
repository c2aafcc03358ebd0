"""The page in a real browser: headless Chromium (Debian package chromium)."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from browser import Page, browser, executable
from places import GOLDEN
from reports import recorded, recorded_network

from designer.report.account import Account
from designer.report.page import page

pytestmark = pytest.mark.skipif(executable() is None, reason="no Chromium here: apt-get install chromium")

KINDS = ["golden", "network", "many", "wrong"]
SIZES = """
Array.from(document.querySelectorAll("figure")).filter((figure) => figure.checkVisibility()).map((figure) => {
  const box = figure.getBoundingClientRect();
  const pictures = Array.from(figure.querySelectorAll(".area > svg, .area > img, .topology svg"));
  return [figure.id, box.left, box.right, box.height, pictures.every((picture) => {
    const inner = picture.getBoundingClientRect();
    return inner.width > 60 && inner.height > 8 && (!picture.complete || picture.naturalWidth > 0);
  })];
})
"""


@pytest.fixture(scope="module")
def accounts(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Account]:
    """4 nodes that settle, losses of every kind, more nodes than have a line of their own, and a run that diverges."""
    folders = {kind: tmp_path_factory.mktemp(kind) for kind in KINDS}
    return {
        "golden": Account.of(GOLDEN / "zhu2020-lossy.mcap"),
        "network": Account.of(recorded_network(folders["network"])),
        "many": Account.of(recorded(folders["many"], ny=(1,) * 24, steps=40, modes=2)),
        "wrong": Account.of(recorded(folders["wrong"], nz=2, nudge=(17, "n1", 1e-3))),
    }


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory, accounts: dict[str, Account]) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("pages")
    for kind, account in accounts.items():
        (folder / f"{kind}.html").write_text(page(account))
    return {kind: folder / f"{kind}.html" for kind in KINDS}


@pytest.fixture(scope="module")
def chromium(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Page]:
    with browser(tmp_path_factory.mktemp("profile")) as opened:
        yield opened


def faults(chromium: Page, width: int) -> list[str]:
    """What is wrong with how the page stands in a window of this width."""
    whole = chromium.evaluate("document.documentElement.scrollWidth")
    found = [f"the page is {whole} wide"] if whole > width else []
    for name, left, right, height, pictured in chromium.evaluate(SIZES):
        if left < 0 or right > width or height < 40 or not pictured:
            found.append(f"{name or 'a figure'} from {left} to {right}, {height} high, pictured: {pictured}")
    return found


@pytest.mark.parametrize("dark", [False, True])
@pytest.mark.parametrize("width", [1280, 390])
@pytest.mark.parametrize("kind", KINDS)
def test_every_figure_is_there_and_nothing_is_asked_for(
    chromium: Page, files: dict[str, Path], kind: str, width: int, dark: bool
) -> None:
    chromium.requests.clear()
    chromium.complaints.clear()
    chromium.open(files[kind], width=width, dark=dark)
    assert faults(chromium, width) == []
    assert len(chromium.evaluate(SIZES)) >= 8
    assert chromium.complaints == []
    assert {address.partition(":")[0] for address in chromium.requests} <= {"file", "data"}
    assert [address for address in chromium.requests if address.startswith("file")] == [files[kind].as_uri()]


def test_a_page_that_is_wrong_is_found(chromium: Page, tmp_path: Path) -> None:
    """So that the test above means something."""
    wrong = tmp_path / "wrong.html"
    wrong.write_text(
        '<figure id="wide" style="width:2000px;height:80px"></figure><figure id="flat"></figure>'
        '<figure id="empty"><div class="area"><svg style="width:9px"></svg></div></figure>'
        '<img src="http://127.0.0.1:9/x.png"><script>console.error("no"); undefined.x;</script>'
    )
    chromium.requests.clear()
    chromium.complaints.clear()
    chromium.open(wrong, width=390)
    found = faults(chromium, 390)
    assert len(found) == 4
    assert all(word in text for word, text in zip(("page", "wide", "flat", "empty"), found, strict=True))
    assert "http://127.0.0.1:9/x.png" in chromium.requests
    assert len([text for text in chromium.complaints if "'no'" in text or "TypeError" in text]) == 2


def test_the_dark_page_is_dark(chromium: Page, files: dict[str, Path]) -> None:
    lightness = []
    for dark in (False, True):
        chromium.open(files["golden"], dark=dark)
        colours = [
            chromium.evaluate(f"getComputedStyle(document.querySelector('{what}')).{name}")
            for what, name in (("body", "backgroundColor"), ("body", "color"), (".area .plant", "stroke"))
        ]
        lightness.append([sum(map(int, re.findall(r"\d+", colour)[:3])) / 765 for colour in colours])
    (page_light, ink_light, plant_light), (page_dark, ink_dark, plant_dark) = lightness
    assert page_light > 0.9 > 0.2 > ink_light > -0.1
    assert page_dark < 0.2 < 0.8 < ink_dark
    assert plant_light < 0.2 < 0.8 < plant_dark


# the numbers of a step
def shown(chromium: Page, figure: str) -> list[str]:
    """What stands in the legend of a figure."""
    return list(chromium.evaluate(f"Array.from(document.querySelectorAll('#{figure} .legend b'), b => b.textContent)"))


def lit(chromium: Page) -> list[int]:
    return list(chromium.evaluate("Array.from(document.querySelectorAll('.topology.lit'), t => +t.dataset.mode)"))


def as_number(text: str) -> float:
    mantissa, _, power = text.replace("−", "-").partition("·10")
    raised = power.translate(str.maketrans("⁻⁰¹²³⁴⁵⁶⁷⁸⁹", "-0123456789"))
    return float(mantissa) * 10.0 ** int(raised or 0)


def test_the_pointer_shows_the_numbers_of_its_step(
    chromium: Page, files: dict[str, Path], accounts: dict[str, Account]
) -> None:
    """In every chart at once, and the topology of that step is lit; where it leaves, the largest error is shown."""
    account = accounts["golden"]
    chromium.open(files["golden"])
    log, peak = account.log, account.verdict.peak
    assert peak is not None
    box = chromium.evaluate(
        "(() => { const area = document.querySelector('#outputs .area'); area.scrollIntoView({block: 'center'});"
        "const box = area.getBoundingClientRect(); return [box.left, box.top, box.width, box.height]; })()"
    )
    for step in (3, 17, account.settled - 1):
        chromium.point(box[0] + (step + 0.5) / account.settled * box[2], box[1] + box[3] / 2)
        values = [as_number(text) for text in shown(chromium, "outputs")]
        np.testing.assert_allclose(values, [*log.z_hat[step], log.z[step, 0]], rtol=6e-3)
        norm = as_number(shown(chromium, "bounds")[-1])
        assert norm == pytest.approx(log.error_norms()[step], rel=6e-3)
        assert shown(chromium, "modes") == [log.gains.problem.mode_names[log.mode[step]]]
        assert lit(chromium) == [log.mode[step]]
    chromium.point(2, 2)
    assert as_number(shown(chromium, "bounds")[-1]) == pytest.approx(peak.size, rel=6e-3)


def test_the_keyboard_reaches_every_step(chromium: Page, files: dict[str, Path], accounts: dict[str, Account]) -> None:
    """By Tab to a chart, by arrows to the next step and the next node; a screen reader is told."""
    chromium.open(files["many"])
    account = accounts["many"]
    for _ in range(40):
        chromium.press("Tab")
        if chromium.evaluate("document.activeElement.closest('figure')?.id === 'error-map'"):
            break
    focused = "document.activeElement.getAttribute"
    assert chromium.evaluate(f"{focused}('role')") == "slider"
    chromium.press("Home")
    for key in ("ArrowRight", "ArrowRight", "ArrowDown"):
        chromium.press(key)
    assert chromium.evaluate(f"{focused}('aria-valuenow')") == "2"
    name = account.log.gains.problem.node_names[account.ranking[1]]
    said = chromium.evaluate("document.getElementById('said').textContent")
    assert said == chromium.evaluate(f"{focused}('aria-valuetext')")
    assert said.startswith("step 2: ")
    found = re.search(rf"node {name}: ≈ (\S+)", said)
    assert found is not None
    assert as_number(found[1]) == pytest.approx(
        account.sizes[2, account.ranking[1]], rel=0.05, abs=account.sizes.max() / 200
    )
    chromium.press("End")
    assert chromium.evaluate(f"{focused}('aria-valuenow')") == "39"


def test_what_was_lost_is_told_of_every_node(
    chromium: Page, files: dict[str, Path], accounts: dict[str, Account]
) -> None:
    chromium.open(files["network"])
    account = accounts["network"]
    chromium.evaluate("document.querySelector('#losses .area').focus()")
    chromium.press("Home")
    for i, name in enumerate(account.log.gains.problem.node_names):
        lost = "yes" if account.lost[0, i] else "no"
        without = "yes" if account.done_without[0, i] else "no"
        assert shown(chromium, "losses") == [f"node {name}: {lost}", f"node {name}: {without}"]
        chromium.press("ArrowDown")


def test_all_steps_can_be_chosen(chromium: Page, files: dict[str, Path]) -> None:
    chromium.open(files["golden"], width=390)
    before = [name for name, *_ in chromium.evaluate(SIZES)]
    chromium.evaluate("document.getElementById('view-all').click()")
    after = [name for name, *_ in chromium.evaluate(SIZES)]
    assert "outputs" in before
    assert "outputs-all" in after
    assert not {"outputs", "errors"} & set(after)
    assert faults(chromium, 390) == []


@pytest.mark.parametrize("kind", KINDS)
def test_it_can_be_printed(chromium: Page, files: dict[str, Path], kind: str) -> None:
    """On several pages of A4, light although the screen is dark, with everything that is not for a screen left out."""
    chromium.open(files[kind], dark=True)
    printed = chromium.pdf()
    assert printed.startswith(b"%PDF")
    boxes = re.findall(rb"/MediaBox \[0 0 ([\d.]+) ([\d.]+)\]", printed)
    assert 3 <= len(boxes) <= 12
    assert {(round(float(width)), round(float(height))) for width, height in boxes} == {(595, 842)}
    dark = {"name": "prefers-color-scheme", "value": "dark"}
    chromium.call("Emulation.setEmulatedMedia", media="print", features=[dark])
    assert chromium.evaluate("getComputedStyle(document.querySelector('.cursor')).display") == "none"
    assert chromium.evaluate("getComputedStyle(document.body).color") == "rgb(26, 26, 26)"
    assert chromium.evaluate("Array.from(document.querySelectorAll('details')).every(details => details.open)")
    chromium.call("Emulation.setEmulatedMedia", media="", features=[])
