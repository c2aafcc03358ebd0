"""A gains file is read exactly or refused, and written whole or not at all."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from made_recordings import random_gains, random_problem

from agent.contract.errors import InputError
from agent.contract.files import write_whole
from agent.contract.gains import Gains

Edit = Callable[[dict[str, Any]], None]


def refusal(folder: Path, data: bytes) -> str:
    """The sentence, without the file's name that begins it."""
    path = folder / "gains.json"
    path.write_bytes(data)
    with pytest.raises(InputError) as caught:
        Gains.load(path)
    sentence = str(caught.value)
    assert "\n" not in sentence
    assert sentence.startswith(str(path))
    return sentence.removeprefix(str(path)).removeprefix(": ")


# round trips
@given(st.integers(0, 30))
def test_a_file_comes_back_byte_for_byte(seed: int) -> None:
    gains = random_gains(random_problem(seed, ny=(1, 3), modes=2), seed)
    again = Gains.from_bytes(gains.canonical(), source="gains")
    assert again.canonical() == gains.canonical()
    assert again.digest() == gains.digest()
    assert again == gains


def test_saved_gains_are_loaded_again(tmp_path: Path, gains: Gains) -> None:
    gains.save(tmp_path / "gains.json")
    assert (tmp_path / "gains.json").read_bytes() == gains.canonical()
    assert Gains.load(tmp_path / "gains.json") == gains


def backwards(document: Any) -> Any:
    """The same document with the keys of every table in the opposite order."""
    if isinstance(document, dict):
        return {key: backwards(document[key]) for key in reversed(document)}
    return [backwards(item) for item in document] if isinstance(document, list) else document


def test_the_digest_does_not_depend_on_the_order_of_the_keys(gains: Gains) -> None:
    data = json.dumps(backwards(json.loads(gains.canonical())), indent=2).encode()
    again = Gains.from_bytes(data, source="gains")
    assert again.canonical() == gains.canonical()
    assert again.digest() == gains.digest()


@pytest.mark.parametrize(("ny", "modes"), [((1,), 1), ((2, 1), 1), ((1, 1, 2), 3)])
def test_a_node_gets_its_own_links(ny: tuple[int, ...], modes: int) -> None:
    """One link for every a_ij > 0, in file order, with the problem's weight and the file's K_ij and H_ij."""
    gains = random_gains(random_problem(8, ny=ny, modes=modes))
    problem = gains.problem
    for i, name in enumerate(problem.node_names):
        own = gains.for_node(name)
        assert own.node == name
        assert own.C is problem.nodes[i].C
        assert own.M is problem.plant.M
        assert own.arrival_probability == problem.nodes[i].arrival_probability
        assert list(own.links) == list(problem.mode_names)
        for s, mode in enumerate(problem.mode_names):
            adjacency = problem.topologies[s].adjacency
            assert [link.sender for link in own.links[mode]] == [
                sender for j, sender in enumerate(problem.node_names) if adjacency[i, j] > 0.0
            ]
            for link in own.links[mode]:
                assert link.weight == adjacency[i, problem.node_index(link.sender)]
                assert link.K is gains.K[mode][name][link.sender]
                assert link.H is gains.H[mode][name][link.sender]


def test_a_node_that_does_not_exist_has_no_gains(gains: Gains) -> None:
    with pytest.raises(InputError, match=r'node "n7" does not exist; the problem has nodes "n0", "n1" and "n2"'):
        gains.for_node("n7")


# what is refused
def edit_problem(document: dict[str, Any]) -> None:
    document["problem"]["plant"]["B"][0][0] += 1e-9


def edit_digest(document: dict[str, Any]) -> None:
    document["problem_digest"] = "0" * 64


def drop_link(document: dict[str, Any]) -> None:
    del document["K"]["mode-0"]["n0"]["n0"]


def add_link(document: dict[str, Any]) -> None:
    document["H"]["mode-0"]["n1"]["n9"] = [[1.0]]


def drop_all_links(document: dict[str, Any]) -> None:
    document["K"]["mode-0"]["n0"] = {}


def drop_mode(document: dict[str, Any]) -> None:
    del document["K"]["mode-1"]


def add_node(document: dict[str, Any]) -> None:
    document["H"]["mode-1"]["n9"] = {}


def widen_K(document: dict[str, Any]) -> None:
    document["K"]["mode-0"]["n0"]["n0"] = [[1.0, 2.0, 3.0], [1.0, 2.0, 3.0]]


def narrow_H(document: dict[str, Any]) -> None:
    document["H"]["mode-0"]["n1"]["n1"] = [[1.0], [1.0]]


def put_string(document: dict[str, Any]) -> None:
    document["K"]["mode-0"]["n0"]["n0"][0][0] = "0.1"


def put_nan(document: dict[str, Any]) -> None:
    document["K"]["mode-0"]["n0"]["n0"][1][0] = float("nan")


def put_gamma_string(document: dict[str, Any]) -> None:
    document["certificate"]["gamma"] = "1.0"


def put_gamma_nan(document: dict[str, Any]) -> None:
    document["certificate"]["gamma"] = float("nan")


def put_gamma_0(document: dict[str, Any]) -> None:
    document["certificate"]["gamma"] = 0


def unstable_plant(document: dict[str, Any]) -> None:
    document["problem"]["plant"]["A"] = [[2.0, 0.0], [0.0, 2.0]]


@pytest.mark.parametrize(
    ("edit", "sentence"),
    [
        (drop_link, 'K: mode "mode-0": node "n0" has gains for "n1"; '
                    'the nodes that it hears in this mode are "n0" and "n1"'),
        (add_link, 'H: mode "mode-0": node "n1" has gains for "n0", "n1" and "n9"; '
                   'the nodes that it hears in this mode are "n0" and "n1"'),
        (drop_all_links, 'K: mode "mode-0": node "n0" has gains for none; '
                         'the nodes that it hears in this mode are "n0" and "n1"'),
        (drop_mode, 'K has gains for "mode-0"; the modes are "mode-0" and "mode-1"'),
        (add_node, 'H: mode "mode-1" has gains for "n0", "n1", "n2" and "n9"; the nodes are "n0", "n1" and "n2"'),
        (widen_K, 'K: mode "mode-0": node "n0": from "n0" is 2 x 3; it must be 2 x 2'),
        (narrow_H, 'H: mode "mode-0": node "n1": from "n1" is 2 x 1; it must be 2 x 2'),
        (put_string, "K: mode-0: n0: n0: row 1 holds '0.1', which is not a number"),
        (put_nan, "K: mode-0: n0: n0: row 2 holds nan; every entry must be a finite float64"),
        (put_gamma_string, "certificate: gamma: must be a number, got '1.0'"),
        (put_gamma_nan, "certificate: gamma: must be finite, got nan"),
        (put_gamma_0, "certificate: gamma: must be greater than 1e-150, got 0"),
        (unstable_plant, "problem: plant: A is unstable: its spectral radius is 2 and must be below 1, "
                         "because the errors contain the state; an unstable plant needs unbiased = true, "
                         'and loss = "seen" at every node that loses measurements'),
    ],
)  # fmt: skip
def test_what_is_wrong_is_refused_in_one_sentence(tmp_path: Path, gains: Gains, edit: Edit, sentence: str) -> None:
    document = json.loads(gains.canonical())
    edit(document)
    assert refusal(tmp_path, json.dumps(document).encode()) == sentence


@pytest.mark.parametrize("edit", [edit_problem, edit_digest])
def test_an_edited_problem_is_refused(tmp_path: Path, gains: Gains, edit: Edit) -> None:
    document = json.loads(gains.canonical())
    edit(document)
    sentence = refusal(tmp_path, json.dumps(document).encode())
    assert sentence.startswith("the problem in it has digest ")
    assert sentence.endswith("...: the problem was edited afterwards; design the gains again")


@pytest.mark.parametrize("field", ["problem", "K", "certificate", "method", "seconds"])
def test_a_missing_field_is_named(tmp_path: Path, gains: Gains, field: str) -> None:
    document = json.loads(gains.canonical())
    del document[field]
    assert refusal(tmp_path, json.dumps(document).encode()) == f'"{field}" is missing'


def test_an_unknown_field_is_named(tmp_path: Path, gains: Gains) -> None:
    data = json.dumps(json.loads(gains.canonical()) | {"note": 1}).encode()
    assert refusal(tmp_path, data) == "note: this key is not known here"


@pytest.mark.parametrize("version", [0, 2, "1", None])
def test_another_version_is_refused(tmp_path: Path, gains: Gains, version: Any) -> None:
    data = json.dumps(json.loads(gains.canonical()) | {"version": version}).encode()
    expected = f" has gains format {version!r}; this peakmesh reads 1: design the gains again"
    assert refusal(tmp_path, data) == expected


@pytest.mark.parametrize("data", [b"{}", b"[]", b"3", b"null", b'{"format": "geojson"}'])
def test_foreign_json_is_refused(tmp_path: Path, data: bytes) -> None:
    assert refusal(tmp_path, data) == ' is not a gains file: it does not say "format": "peakmesh-gains"'


@pytest.mark.parametrize(
    "data", [b"", b"{", b"\xff", b"[" * 100_000, b"name = 1"], ids=["empty", "cut", "not-utf8", "deep", "toml"]
)
def test_what_is_not_json_is_refused(tmp_path: Path, data: bytes) -> None:
    assert refusal(tmp_path, data).startswith(" is not a gains file: it is not valid JSON: ")


def test_a_cut_file_is_refused_wherever_it_is_cut(gains: Gains) -> None:
    data = gains.canonical()
    for length in range(0, len(data), 37):
        with pytest.raises(InputError, match=r"^gains is not a gains file: it is not valid JSON"):
            Gains.from_bytes(data[:length], source="gains")


def test_a_file_that_is_not_there_and_a_folder_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"none\.json does not exist; a gains file was expected there$"):
        Gains.load(tmp_path / "none.json")
    with pytest.raises(InputError, match=r"could not be read as a gains file: Is a directory$"):
        Gains.load(tmp_path)


# whole or not at all
def test_a_file_is_not_overwritten_without_force(tmp_path: Path, gains: Gains) -> None:
    path = tmp_path / "gains.json"
    path.write_bytes(b"precious")
    with pytest.raises(InputError, match=r"exists already; give another name, or --force to replace it$"):
        gains.save(path)
    assert path.read_bytes() == b"precious"
    gains.save(path, force=True)
    assert Gains.load(path) == gains


def test_a_folder_is_never_replaced(tmp_path: Path, gains: Gains) -> None:
    with pytest.raises(InputError, match=r"is a folder; name a file in it$"):
        gains.save(tmp_path, force=True)


def test_a_folder_that_does_not_exist_is_named(tmp_path: Path, gains: Gains) -> None:
    with pytest.raises(InputError, match=r"the folder .*/new does not exist; create it first$"):
        gains.save(tmp_path / "new" / "gains.json")


@pytest.mark.parametrize("failing", ["fsync", "replace"])
def test_a_failing_disk_leaves_the_old_file_and_nothing_else(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, failing: str
) -> None:
    def fail(*_: Any) -> None:
        raise OSError(28, "No space left on device")

    path = tmp_path / "gains.json"
    path.write_bytes(b"old")
    with monkeypatch.context() as patch:
        patch.setattr(*{"fsync": (os, "fsync"), "replace": (Path, "replace")}[failing], fail)
        with pytest.raises(InputError, match=r"gains\.json could not be written: No space left on device$"):
            write_whole(path, b"new", force=True)
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]


def test_an_interrupted_write_leaves_nothing_half_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupt(_: int) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(os, "fsync", interrupt)
    with pytest.raises(KeyboardInterrupt):
        write_whole(tmp_path / "gains.json", b"new")
    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_cannot_be_written_to_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: Any) -> None:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(Path, "open", refuse)
    with pytest.raises(InputError, match=r"gains\.json could not be written: Permission denied$"):
        write_whole(tmp_path / "gains.json", b"new")
    assert list(tmp_path.iterdir()) == []
