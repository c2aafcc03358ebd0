"""Tables have every number of a recording, bit for bit, and other programs read them in two lines."""

from __future__ import annotations

import copy
import json
import re
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from here import here
from made_recordings import Sent, random_gains, real_problem, record, simulate
from places import GOLDEN, ROOT
from scipy.io import loadmat

from agent.contract.arrays import Array
from agent.contract.errors import InputError
from agent.contract.gains import Gains
from designer.export import FORMATS, tables
from designer.export import export as export_log
from designer.export.columns import FIELDS
from designer.replay.log import load

STEPS = 7
DOCUMENT = (ROOT / "docs" / "export.md").read_text()
NETWORK = random_gains(real_problem(2, unbiased=False, nx=3, nz=2))  # seen losses, lossy links, weights, vectors


@pytest.fixture(scope="module")
def sent() -> list[Sent]:
    return simulate(NETWORK, steps=STEPS)


@pytest.fixture
def run(sent: list[Sent], tmp_path: Path) -> Path:
    return record(tmp_path / "run.mcap", NETWORK, sent, steps=STEPS)


def numbers(sent: list[Sent], gains: Gains) -> Iterator[tuple[int, str, str, float]]:
    """Step, whose, field and value of every number of the messages, taken from their documents alone."""
    names, modes = gains.problem.node_names, gains.problem.mode_names
    for message in sent:
        document, topic = message.document, message.topic.split("/")
        step = document["step"]
        if topic == ["mode"]:
            yield step, "coordinator", "mode", modes.index(document["mode"])
        elif topic == ["plant", "state"]:
            for field in "xzw":
                yield from ((step, "plant", f"{field}[{i}]", value) for i, value in enumerate(document[field]))
            yield from ((step, name, "arrived", value) for name, value in zip(names, document["arrived"], strict=True))
        elif topic[0] == "node":
            for field in {"y", "innovation", "x_hat", "z_hat"} & set(document):
                yield from ((step, topic[1], f"{field}[{i}]", value) for i, value in enumerate(document[field]))
            if topic[2] == "estimate":
                if step:
                    yield step, topic[1], "made_in", modes.index(document["mode"])
                for j in gains.problem.ever_heard(names.index(topic[1])):
                    yield step, topic[1], f"heard[{names[j]}]", names[j] in document["heard"]


def export(path: Path, output: Path, **options: Any) -> dict[str, Any]:
    return export_log(load(path), output, **options)


def bits(value: float) -> bytes:
    return struct.pack("<d", value)


def expected(sent: list[Sent], gains: Gains = NETWORK) -> dict[tuple[int, str, str], bytes]:
    return {(step, whose, field): bits(value) for step, whose, field, value in numbers(sent, gains)}


def long(table: pd.DataFrame) -> dict[tuple[int, str, str], bytes]:
    """What is in a long table, but for NaN."""
    table = table[table["value"].notna()]
    rows = zip(table["step"], table["node"].astype(str), table["field"].astype(str), table["value"], strict=True)
    found = {(int(step), node, field): bits(value) for step, node, field, value in rows}
    assert len(found) == len(table)
    return found


def wide(table: pd.DataFrame) -> dict[tuple[int, str, str], bytes]:
    found = {}
    for title in table.columns:
        if title not in {"step", "mode_name"}:
            *_, whose, field = ("coordinator/" * (title == "mode") + title).split("/")
            pairs = zip(table["step"], table[title], strict=True)
            found |= {(int(k), whose, field): bits(value) for k, value in pairs if not np.isnan(value)}
    return found


def read(path: Path, **options: Any) -> pd.DataFrame:
    if path.suffix == ".parquet":
        return pd.read_parquet(path)
    return pd.read_csv(path, **options)


# the numbers
@pytest.mark.parametrize("to", ["csv", "parquet"])
def test_a_table_has_every_number_bit_for_bit(to: str, run: Path, sent: list[Sent], tmp_path: Path) -> None:
    facts = export(run, tmp_path / f"long.{to}", to=to)
    table = read(tmp_path / f"long.{to}")
    assert list(table.columns) == ["step", "node", "field", "value"]
    assert long(table) == expected(sent)
    assert facts["rows"] == len(table)
    export(run, tmp_path / f"wide.{to}", to=to, wide=True)
    table = read(tmp_path / f"wide.{to}")
    assert table["step"].tolist() == list(range(STEPS))
    assert table["mode_name"].tolist() == [m.document["mode"] for m in sent if m.topic == "mode"]
    assert wide(table) == expected(sent)


@pytest.mark.parametrize("wide", [False, True])
def test_csv_and_parquet_are_the_same_table(wide: bool, run: Path, tmp_path: Path) -> None:
    for to in ("csv", "parquet"):
        export(run, tmp_path / f"table.{to}", to=to, wide=wide)
    one, two = read(tmp_path / "table.csv"), read(tmp_path / "table.parquet")
    words = ["mode_name"] if wide else ["node", "field"]
    pd.testing.assert_frame_equal(one, two.astype(dict.fromkeys(words, one[words[0]].dtype)), check_exact=True)


def test_a_mat_file_has_every_number_bit_for_bit(run: Path, sent: list[Sent], tmp_path: Path) -> None:
    problem = NETWORK.problem
    export(run, tmp_path / "run.mat", to="mat")
    arrays = loadmat(tmp_path / "run.mat")
    names = [str(cell[0]) for cell in arrays["node_names"][0]]
    assert names == list(problem.node_names)
    assert [str(cell[0]) for cell in arrays["mode_names"][0]] == list(problem.mode_names)
    y_node = arrays["y_node"][0].astype(int) - 1

    def entry(step: int, whose: str, field: str) -> Array:
        name, _, place = field.rstrip("]").partition("[")
        i = names.index(whose) if whose in names else -1
        match name:
            case "mode":
                return np.asarray(arrays["mode"][step, 0] - 1)
            case "x" | "z" | "w":
                return np.asarray(arrays[name][step, int(place)])
            case "arrived":
                return np.asarray(arrays["arrived"][step, i])
            case "y" | "innovation":
                return np.asarray(arrays[name][step, np.flatnonzero(y_node == i)[int(place)]])
            case "x_hat" | "z_hat":
                return np.asarray(arrays[name][step, int(place), i])
            case "heard":
                return np.asarray(arrays["heard"][step, i, names.index(place)])
        raise AssertionError(field)

    for (step, whose, field), value in expected(sent).items():
        if field != "made_in":
            assert bits(float(entry(step, whose, field))) == value, (step, whose, field)
    for name in "ABM":
        assert np.array_equal(arrays[name], getattr(problem.plant, name))
    assert arrays["step"].ravel().tolist() == list(range(STEPS))


def test_golden_recordings_are_exported(tmp_path: Path) -> None:
    for name in ("zhu2020-lossy", "zhu2020-ideal"):
        facts = export(GOLDEN / f"{name}.mcap", tmp_path / f"{name}.csv", to="csv")
        table = read(tmp_path / f"{name}.csv")
        assert (facts["steps"], facts["absent"], facts["finished"]) == (60, 0, True)
        assert sorted(set(table["node"])) == ["1", "2", "3", "4", "coordinator", "plant"]
        assert table["value"].notna().sum() == len(table) - 4  # made_in at step 0


# what is missing
@pytest.mark.parametrize("to", ["csv", "parquet"])
def test_what_is_missing_is_not_a_number(to: str, sent: list[Sent], tmp_path: Path) -> None:
    gone = {("mode", 2), ("plant/state", 3), ("node/n1/measurement", 4), ("node/n2/estimate", 5)}
    fewer = [message for message in sent if (message.topic, message.document["step"]) not in gone]
    path = record(tmp_path / "run.mcap", NETWORK, fewer, steps=STEPS)
    for name, shape in (("long", False), ("wide", True)):
        facts = export(path, tmp_path / f"{name}.{to}", to=to, wide=shape)
        assert facts["absent"] == 4
        table = read(tmp_path / f"{name}.{to}", keep_default_na=True)
        assert (wide if shape else long)(table) == expected(fewer)
        assert len(table) == facts["rows"]
    assert [str(name) for name in table["mode_name"].fillna("")][2] == ""


def test_a_cut_recording_is_exported_as_far_as_it_goes(sent: list[Sent], tmp_path: Path) -> None:
    half = sent[: len(sent) // 2]
    path = record(tmp_path / "run.mcap", NETWORK, half, steps=STEPS, whole=False)
    done = here("export", path, "--csv", "-o", tmp_path / "table.csv")
    assert done.returncode == 0
    assert "of the run not in it: NaN in their place" in done.stderr
    assert long(read(tmp_path / "table.csv")) == expected(half)


@pytest.mark.parametrize("to", FORMATS)
def test_a_run_without_steps_is_an_empty_table(to: str, tmp_path: Path) -> None:
    path = record(tmp_path / "run.mcap", NETWORK, [], steps=STEPS, whole=False)
    for shape in {False, to != "mat"}:
        facts = export(path, tmp_path / f"table-{shape}.{to}", to=to, wide=shape)
        assert (facts["steps"], facts["rows"]) == (0, 0)
        if to != "mat":
            assert len(read(tmp_path / f"table-{shape}.{to}")) == 0


def test_of_a_message_that_is_there_twice_the_first_counts(sent: list[Sent], tmp_path: Path) -> None:
    again = copy.deepcopy(next(message for message in sent if message.topic == "plant/state"))
    again.document["x"][0] += 1.0
    path = record(tmp_path / "run.mcap", NETWORK, [again._replace(number=1000), *sent], steps=STEPS)
    export(path, tmp_path / "table.csv", to="csv")
    assert long(read(tmp_path / "table.csv")) == expected(sent)


def test_a_node_may_be_called_plant(tmp_path: Path) -> None:
    document = NETWORK.problem.document()
    text = json.dumps(document).replace('"n0"', '"plant"').replace('"n1"', '"coordinator"')
    gains = random_gains(type(NETWORK.problem).from_document(json.loads(text)))
    sent = simulate(gains, steps=STEPS)
    path = record(tmp_path / "run.mcap", gains, sent, steps=STEPS)
    export(path, tmp_path / "long.csv", to="csv")
    assert long(read(tmp_path / "long.csv")) == expected(sent, gains)
    export(path, tmp_path / "wide.csv", to="csv", wide=True)
    titles = list(read(tmp_path / "wide.csv").columns)
    assert len(set(titles)) == len(titles)
    assert {"plant/x[0]", "node/plant/x_hat[0]", "node/coordinator/arrived", "mode"} <= set(titles)


def test_blocks_join_without_a_seam(run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for number in (1, 200_000):
        monkeypatch.setattr(tables, "_NUMBERS_AT_ONCE", number)
        for to in ("csv", "parquet"):
            for shape in (False, True):
                export(run, tmp_path / f"{number}-{shape}.{to}", to=to, wide=shape)
    for shape in (False, True):
        assert (tmp_path / f"1-{shape}.csv").read_bytes() == (tmp_path / f"200000-{shape}.csv").read_bytes()
        pd.testing.assert_frame_equal(read(tmp_path / f"1-{shape}.parquet"), read(tmp_path / f"200000-{shape}.parquet"))


# what is said of it
def test_the_document_has_every_field() -> None:
    """And no other."""
    rows = re.findall(r"^\| `(.+?)` \| (.+?) \| (.+?) \| (.+?) \|$", DOCUMENT, flags=re.MULTILINE)
    assert rows == [tuple(field) for field in FIELDS]


@pytest.mark.parametrize("wide", [False, True])
def test_every_field_of_the_document_is_in_the_table(wide: bool, run: Path, tmp_path: Path) -> None:
    """And no other: with brackets for places."""
    export(run, tmp_path / "table.csv", to="csv", wide=wide)
    table = read(tmp_path / "table.csv")
    found = list(table.columns[2:]) if wide else list(table["field"])
    plain = {re.sub(r"\[[\w-]+\]", "[...]", title.rpartition("/")[2]) for title in found}
    assert plain == {field.name for field in FIELDS}


def test_the_two_lines_of_the_document_read_it(run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    blocks = re.findall(r"```python\n(.*?)```", DOCUMENT, flags=re.DOTALL)
    commands = re.findall(r"^peakmesh export (.*)$", DOCUMENT, flags=re.MULTILINE)
    assert [sum(map(bool, block.splitlines())) for block in blocks] == [2, 2]  # lines that are not empty
    for command in commands:
        assert here("export", *command.partition("#")[0].split(), cwd=tmp_path).returncode == 0
    frames = []
    for block in blocks:
        names: dict[str, Any] = {}
        exec(block, names)
        frames.append(names["run"])
    assert list(frames[0].columns) == ["step", "node", "field", "value"]
    assert frames[1].index.tolist() == list(range(STEPS))
    error = frames[1]["plant/z[0]"] - frames[1]["node/n3/z_hat[0]"]
    assert error.notna().all()


# bad input
def test_nothing_is_overwritten_and_nothing_is_left(run: Path, tmp_path: Path) -> None:
    (tmp_path / "run.csv").write_text("mine")
    done = here("export", run, "--csv")
    assert (done.returncode, done.stdout) == (2, "")
    assert "exists already" in done.stderr
    assert (tmp_path / "run.csv").read_text() == "mine"
    assert here("export", run, "--csv", "--force").returncode == 0
    assert (tmp_path / "run.csv").read_text().startswith("step,")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["run.csv", "run.mcap"]


@pytest.mark.parametrize("to", FORMATS)
def test_a_table_that_cannot_be_written_leaves_nothing(
    to: str, run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: Any, **__: Any) -> Any:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("designer.export.tables._blocks", fail)
    monkeypatch.setattr("designer.export.matlab.savemat", fail)
    with pytest.raises(InputError, match="could not be written: No space left on device"):
        export(run, tmp_path / f"table.{to}", to=to)
    assert [path.name for path in tmp_path.iterdir()] == ["run.mcap"]


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--mat", "--wide"], "--wide is for --csv and --parquet"),
        (["--csv", "-o", "nowhere/table.csv"], "the folder nowhere does not exist"),
        (["--csv", "-o", "."], "is a folder"),
        ([], "one of the arguments --csv --parquet --npz --mat --c is required"),
        (["--csv", "--mat"], "not allowed with"),
    ],
)
def test_bad_usage_is_refused(words: list[str], said: str, run: Path, tmp_path: Path) -> None:
    done = here("export", run, *words, cwd=tmp_path)
    assert (done.returncode, done.stdout) == (2, "")
    assert said in done.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["run.mcap"]


def test_what_is_no_recording_is_refused(tmp_path: Path) -> None:
    done = here("export", GOLDEN / "zhu2020-lossy.gains.json", "--csv", "-o", tmp_path / "table.csv")
    assert (done.returncode, done.stdout) == (2, "")
    assert "is not a recording" in done.stderr
    assert list(tmp_path.iterdir()) == []


def test_parquet_without_pyarrow_says_what_to_install(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(__import__("sys").modules, "pyarrow", None)
    with pytest.raises(InputError, match=re.escape("pip install 'peakmesh[parquet]'")):
        export(run, tmp_path / "table.parquet", to="parquet")
    assert [path.name for path in tmp_path.iterdir()] == ["run.mcap"]
