"""The page has the recording's numbers, says what replay says, and needs nothing from anywhere."""

from __future__ import annotations

import base64
import hashlib
import json
import re
import zlib
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from made_recordings import random_gains, random_problem, record, simulate
from paced_runs import PacedRun
from places import GOLDEN
from reports import account_of, recorded
from rewriting import read, write

from designer.ladder import rounded_up
from designer.report.account import Account
from designer.report.page import CLOSE_UP, MOST_COLUMNS, page
from designer.report.page.words import divergence_sentence, error_sentence, verdict_sentence
from designer.report.scales import brief

VOID = {"meta", "img", "input", "br", "path", "circle"}


class Checked(HTMLParser):
    """Elements that are closed in order, ids, and every address that is asked for."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.ids: list[str] = []
        self.addresses: list[str] = []
        self.named: dict[str, list[dict[str, str | None]]] = {}
        self.words: list[str] = []
        self.feed(text)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        found = dict(attrs)
        self.named.setdefault(tag, []).append(found)
        self.ids += [found["id"]] if found.get("id") else []
        self.addresses += [found[name] or "" for name in ("src", "href", "action", "data") if name in found]
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        if tag not in VOID:
            assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if self.open[-1:] not in (["script"], ["style"]):
            self.words.append(data)

    @property
    def text(self) -> str:
        return " ".join("".join(self.words).split())


def numbers(text: str) -> dict[str, dict[str, object]]:
    found = re.search(r'<script type="application/json" id="data">(.*?)</script>', text, flags=re.DOTALL)
    assert found is not None
    return dict(json.loads(found[1])["charts"])


@pytest.fixture(scope="module")
def golden() -> Account:
    return Account.of(GOLDEN / "zhu2020-lossy.mcap")


def test_it_is_whole_and_asks_for_nothing(golden: Account) -> None:
    found = Checked(page(golden))
    assert found.open == []
    assert len(found.ids) == len(set(found.ids))
    assert all(address.startswith(("data:image/png;base64,", "#")) for address in found.addresses)
    assert "http" not in re.sub(r"http-equiv", "", page(golden))
    assert "default-src 'none'" in str(found.named["meta"])
    for picture in found.named["img"]:
        assert picture["alt"]
    for drawing in found.named["svg"]:
        assert drawing.get("aria-label") or drawing.get("aria-hidden") == "true"


def test_an_address_and_an_open_element_are_found() -> None:
    """So that the test above means something."""
    assert Checked('<p><img src="http://example.org/x.png"></p>').addresses == ["http://example.org/x.png"]
    assert Checked("<div><p></p>").open == ["div"]
    with pytest.raises(AssertionError):
        Checked("<div><p></div>")


def test_each_node_has_its_gain_and_its_noise(golden: Account) -> None:
    """As computed for the gains of the recording."""
    text, beyond = page(golden), golden.beyond
    assert beyond.gains is not None
    assert beyond.noise is not None
    for (_, high), mean_square in zip(beyond.gains, beyond.noise.nodes, strict=True):
        assert f"<td>{brief(high, 3)}</td><td>{brief(mean_square**0.5, 3)}</td></tr>" in text


def test_the_numbers_for_the_pointer_are_the_recording(golden: Account) -> None:
    data, log = numbers(page(golden)), golden.log
    for key, stop in (("outputs", golden.settled), ("outputs-all", log.steps)):
        series = [np.array(one["low"]) for one in data[key]["series"]]  # type: ignore[attr-defined, index]
        assert (data[key]["first"], data[key]["stop"], data[key]["stretch"]) == (0, stop, 1)
        np.testing.assert_allclose(series[4], log.z[:stop, 0], rtol=5e-4)
        for i in range(4):
            np.testing.assert_allclose(series[i], log.z_hat[:stop, i], rtol=5e-4)
    codes = np.frombuffer(base64.b64decode(str(data["losses-all"]["codes"])), dtype=np.uint8).reshape(4, -1)
    np.testing.assert_array_equal(codes.T & 1, golden.lost)


def test_the_steps_are_drawn_where_the_numbers_are(tmp_path: Path) -> None:
    """The path of a line, read back: one level for each step, to a thousandth of the axis."""
    account = account_of(tmp_path)
    (d,) = re.findall(r'<path class="line node-2" d="(M0 [^"]*)"', page(account).partition('id="errors"')[2])[:1]
    heights, at = [], 0
    for command, argument in re.findall(r"([MVh])([\d. ]+)", d):
        if command == "h":
            heights += [at] * int(argument)
        else:
            at = int(argument.split()[-1])
    errors = account.log.z[:, 0] - account.log.z_hat[:, 2]
    assert len(heights) == len(errors) == 50
    slope, offset = np.polyfit(heights, errors, 1)
    assert slope < 0.0, "up is more"
    np.testing.assert_allclose(slope * np.array(heights) + offset, errors, atol=1.1 * abs(slope))


def test_the_picture_of_a_map_is_its_cells(tmp_path: Path) -> None:
    """The pixels of the PNG, unpacked, are the levels that the pointer reads."""
    account = account_of(tmp_path, ny=(1,) * 8)
    text = page(account)
    (source,) = re.findall(r'<img class="cells sizes"[^>]*base64,([^"]+)"', text)
    data = base64.b64decode(source)
    at = data.index(b"IDAT")
    rows = zlib.decompress(data[at + 4 : at + 4 + int.from_bytes(data[at - 4 : at], "big")])
    cells = np.frombuffer(rows, dtype=np.uint8).reshape(8, 51)[:, 1:]
    told = numbers(text)["error-map"]
    np.testing.assert_array_equal(cells.tobytes(), base64.b64decode(str(told["cells"])))
    low, high, log = told["scale"]  # type: ignore[misc]
    shown = low + (high - low) * (cells - 1.0) / 254.0  # type: ignore[has-type]
    assert not log  # type: ignore[has-type]
    np.testing.assert_allclose(shown.T, account.sizes[:, account.ranking], atol=high / 254.0)  # type: ignore[has-type]


@pytest.mark.parametrize(("n", "steps", "most"), [(4, 1000, 1_500_000), (30, 60, 500_000)])
def test_it_is_small(tmp_path: Path, n: int, steps: int, most: int) -> None:
    assert len(page(account_of(tmp_path, ny=(1,) * n, steps=steps, modes=2)).encode()) < most


def test_a_long_run_has_a_part_and_the_whole_in_columns(tmp_path: Path) -> None:
    account = account_of(tmp_path, steps=2 * MOST_COLUMNS)
    data = numbers(page(account))
    part, whole = data["outputs"], data["outputs-all"]
    assert part["stop"] - part["first"] == CLOSE_UP  # type: ignore[operator]
    assert account.verdict.peak is not None
    assert part["first"] <= account.verdict.peak.step < part["stop"]  # type: ignore[operator]
    assert (whole["stretch"], len(whole["series"][0]["low"])) == (2, MOST_COLUMNS)  # type: ignore[arg-type, index]
    highest = max(max(one["high"]) for one in whole["series"])  # type: ignore[attr-defined]
    assert highest == pytest.approx(max(account.log.z.max(), account.log.z_hat.max()), rel=1e-3)


# what it says
def test_an_honest_run_is_believed(golden: Account) -> None:
    text = Checked(page(golden)).text
    assert verdict_sentence(golden.verdict).startswith("This recording can be believed: no message is missing, and")
    assert verdict_sentence(golden.verdict) in text
    assert error_sentence(golden) in text
    assert "that is proved" in error_sentence(golden)
    again, gamma = "peakmesh run gains.json --steps 60 --seed 2020", rounded_up(golden.log.gains.certificate.gamma)
    for fact in ("seed 2020", golden.log.gains.digest(), again, f"γ, proved{gamma}"):
        assert fact in text
    assert text.count("✓ holds") == 5


def test_a_moved_estimate_is_named(tmp_path: Path) -> None:
    account = Account.of(recorded(tmp_path, nudge=(17, "n1", 1e-3)))
    said, text = verdict_sentence(account.verdict), Checked(page(account)).text
    assert said.startswith('This recording is not a true account of the run: at step 17, x_hat[0] of node "n1" is ')
    assert said in text
    assert account.verdict.first_divergence is not None
    assert divergence_sentence(account.verdict.first_divergence) in said
    assert "✗ fails" in text
    assert "can be believed" not in text
    assert '{"start":17,' in page(account), "the pointer stands there"


def test_a_missing_message_is_named_and_a_cut_file_is_not_accused(tmp_path: Path) -> None:
    gains = random_gains(random_problem(3))
    sent = simulate(gains, steps=20)
    without = [message for message in sent if (message.topic, message.document["step"]) != ("node/n2/estimate", 7)]
    missing = Account.of(record(tmp_path / "missing.mcap", gains, without, steps=20))
    assert "1 message is missing; the first is node/n2/estimate of step 7." in verdict_sentence(missing.verdict)
    cut = Account.of(record(tmp_path / "cut.mcap", gains, sent[:100], steps=20, whole=False))
    said = verdict_sentence(cut.verdict)
    assert said.startswith("As far as it goes this recording can be believed: ")
    assert f"it has {cut.log.steps} of 20 steps" in said
    assert said in Checked(page(cut)).text


def test_a_message_that_is_not_what_was_sent_is_named(tmp_path: Path) -> None:
    """By its sender, whatever it says: spaces in its JSON change no number."""
    contents = read(recorded(tmp_path))
    items = list(contents.items)
    at = next(i for i, item in enumerate(items) if item.topic == "plant/state" and b'"step":7,' in item.payload)
    items[at] = items[at]._replace(payload=items[at].payload + b" ")
    account = Account.of(write(tmp_path / "altered.mcap", contents.with_items(items)))
    said = verdict_sentence(account.verdict)
    assert said.startswith("This recording is not a true account of the run: the plant, number ")
    assert "(plant/state, step 7)" in said
    assert said in Checked(page(account)).text


def test_gamma_is_not_promised_of_a_run_with_faults(tmp_path: Path, golden: Account) -> None:
    """A node that was away for a while: gamma is of runs as designed, and what the ledger says stands in its place."""
    gains = golden.log.gains
    faulty = PacedRun(gains, steps=40, away={"2": range(10, 20)}).messages
    account = Account.of(record(tmp_path / "run.mcap", gains, faulty, steps=40, period="0.1"))
    assert account.verdict.agrees
    assert golden.mean_bound is not None
    assert (account.mean_bound, account.verdict.chance) == (None, None)
    assert "that is proved" not in error_sentence(account)
    assert account.verdict.ledger is not None
    assert f"of this one it says: {account.verdict.ledger.text()}" in error_sentence(account)
    shown = Checked(page(account)).text
    assert "something happened that it does not cover" in shown
    assert account.verdict.pacing is not None
    for delays in account.verdict.pacing.delays:
        cells = "".join(f"{1e3 * seconds:.2f}" for seconds in (*delays.to_estimate, *delays.to_step))
        assert f"{delays.node}{cells}" in shown
    assert all(" ".join(line.split()) in shown for line in account.verdict.pacing.text())
    assert "Against the clock" not in Checked(page(golden)).text


def test_what_a_filter_left_out_is_named_and_accuses_nobody(tmp_path: Path) -> None:
    """A whole topic that is not there."""
    gains = random_gains(random_problem(3))
    kept = [message for message in simulate(gains, steps=20) if message.topic != "event"]
    account = Account.of(record(tmp_path / "run.mcap", gains, kept, steps=20))
    assert "But it is not whole: 2 messages of the run are not in it." in verdict_sentence(account.verdict)
    assert "Not in this file: topic event." in Checked(page(account)).text
    assert "✗" not in page(account)


def test_parts_of_a_run_are_one_report(tmp_path: Path) -> None:
    """Both files are named, each with its digest."""
    gains = random_gains(random_problem(3))
    sent = simulate(gains, steps=20)
    halves = [
        record(tmp_path / f"{name}.mcap", gains, half, steps=20, evidence=False)
        for name, half in (("first", sent[:90]), ("second", sent[90:]))
    ]
    account = Account.of(*halves)
    text = Checked(page(account)).text
    assert account.log.steps == 20
    assert verdict_sentence(account.verdict).startswith("This recording can be believed")
    for path in halves:
        assert f"recording {path.name}SHA-256 {hashlib.sha256(path.read_bytes()).hexdigest()}" in text


def test_of_real_sensors_it_claims_no_more_than_it_knows(tmp_path: Path) -> None:
    gains = random_gains(random_problem(3))
    sent = simulate(gains, steps=20, real_y={"n1": np.zeros((20, 2))})
    account = Account.of(record(tmp_path / "run.mcap", gains, sent, steps=20, external="n1"))
    text = Checked(page(account)).text
    assert "every number in it, but for what the real sensors measured," in text
    assert error_sentence(account) == (
        "How far off the estimates were is not known: real sensors measured, so nobody knows what was true."
    )
    assert "not possible: real sensors took part" in text


def test_words_of_a_file_cannot_become_part_of_the_page(tmp_path: Path) -> None:
    gains = random_gains(random_problem(3))
    sent, foul = simulate(gains, steps=5), "<script>alert(1)</script>"
    account = Account.of(record(tmp_path / "run.mcap", gains, sent, steps=5, run=foul, started=foul, peakmesh=foul))
    text = page(account)
    assert foul not in text
    assert text.count("&lt;script&gt;") >= 3
