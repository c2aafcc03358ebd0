"""A problem file is read exactly, or refused with one sentence: the place, the value, what would be right."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from made_recordings import random_problem

from agent.contract.errors import InputError, listed
from agent.contract.problem import Problem

TEXT = """
name = "pair"
[plant]
A = [[0.5, 0.1], [0.0, -0.5]]
B = [[1.0], [0.5]]
M = [[1.0, 0.0]]
[[node]]
name = "left"
C = [[1.0, 0.0]]
D = [[0.1]]
arrival_probability = 0.75
[[node]]
name = "right"
C = [[0.0, 1.0], [1.0, 1.0]]
D = [[0.2], [0.3]]
arrival_probability = 1
[[topology]]
name = "apart"
adjacency = [[1, 0], [0, 1]]
[[topology]]
name = "joined"
adjacency = [[1, 1], [1, 1]]
[markov]
transition = [[0.9, 0.1], [0.25, 0.75]]
initial = "apart"
[disturbance]
kind = "damped-sine"
decay = 0.2
"""
SINE = 'kind = "damped-sine"\ndecay = 0.2'
CSV = 'kind = "csv"\nfile = "w.csv"'
JOINED = "adjacency = [[1, 1], [1, 1]]"
HUGE = "1" + "0" * 400
LINK = """[[link]]
receiver = "left"
sender = "right"
delivery_probability = 0.9
"""
LINKED = TEXT.replace("[markov]", LINK + "[markov]")
UNSTABLE = TEXT.replace("A = [[0.5", "A = [[-1.02")


def load(folder: Path, text: str | bytes) -> Problem:
    path = folder / "problem.toml"
    path.write_bytes(text.encode() if isinstance(text, str) else text)
    return Problem.load(path)


def edited(old: str, new: str) -> str:
    assert TEXT.count(old) == 1, old
    return TEXT.replace(old, new)


def linked(old: str, new: str) -> str:
    """LINKED with the one link edited."""
    assert LINK.count(old) == 1, old
    return LINKED.replace(LINK, LINK.replace(old, new))


def unstable(*, left: str = "", unbiased: str = "") -> str:
    """UNSTABLE, with a word on the losses of the left node, and one on the gains."""
    text = UNSTABLE.replace('name = "left"\n', f'name = "left"\n{left}\n')
    return text.replace('name = "pair"\n', f'name = "pair"\n{unbiased}\n')


def refusal(folder: Path, text: str | bytes) -> str:
    """The sentence, without the file's name that begins it."""
    with pytest.raises(InputError) as caught:
        load(folder, text)
    sentence = str(caught.value)
    assert "\n" not in sentence
    assert sentence.startswith(str(folder / "problem.toml"))
    return sentence.removeprefix(str(folder / "problem.toml")).removeprefix(": ").replace(str(folder), "FOLDER")


# what is read
def test_a_file_is_read_as_it_stands(tmp_path: Path) -> None:
    problem = load(tmp_path, TEXT)
    assert (problem.n, problem.nx, problem.nw, problem.nz) == (2, 2, 1, 1)
    assert problem.node_names == ("left", "right")
    assert problem.mode_names == ("apart", "joined")
    assert problem.plant.A.tolist() == [[0.5, 0.1], [0.0, -0.5]]
    assert problem.beta.tolist() == [0.75, 1.0]
    assert problem.nodes[1].C.shape == (2, 2)
    assert problem.neighbours(0, 1) == (1,)
    assert problem.neighbours(1, 1) == (0, 1)
    assert problem.ever_heard(0) == (0, 1)


def test_arrays_cannot_be_written_to(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="read-only"):
        load(tmp_path, TEXT).plant.A[0, 0] = 1.0


def test_hears_gives_the_same_problem_as_adjacency(tmp_path: Path) -> None:
    """Who is named before the sign is the receiver, row i of a_ij; a node hears itself, said or not."""
    one_way = edited(JOINED, "adjacency = [[1, 1], [0, 1]]")
    heard = edited(JOINED, 'hears = { "left" = ["right"], "right" = ["right"] }')
    apart = heard.replace("adjacency = [[1, 0], [0, 1]]", "hears = {}")
    assert load(tmp_path, apart) == load(tmp_path, one_way)
    assert load(tmp_path, apart).digest() == load(tmp_path, one_way).digest()


def test_without_disturbance_there_is_none(tmp_path: Path) -> None:
    said = load(tmp_path, edited(SINE, 'kind = "none"'))
    assert load(tmp_path, edited("[disturbance]\n" + SINE, "")) == said


def test_the_numbers_of_a_csv_become_part_of_the_problem(tmp_path: Path) -> None:
    (tmp_path / "w.csv").write_bytes(b"\xef\xbb\xbf0.5\r\n-1e-3\r\n")
    problem = load(tmp_path, edited(SINE, CSV))
    (tmp_path / "w.csv").unlink()
    assert problem.document()["disturbance"]["values"] == [[0.5], [-0.001]]
    assert Problem.from_document(problem.document()) == problem


def test_names_that_do_not_exist_are_refused_with_those_that_do() -> None:
    problem = random_problem(1, ny=(1, 1), modes=1)
    with pytest.raises(InputError, match=r'^node "x" does not exist; the problem has nodes "n0" and "n1"$'):
        problem.node_index("x")
    with pytest.raises(InputError, match=r'^mode "x" does not exist; the problem has modes "mode-0"$'):
        problem.mode_index("x")


@pytest.mark.parametrize(
    ("count", "text"), [(0, ""), (1, '"0"'), (3, '"0", "1" and "2"'), (9, '"0", "1", "2", "3", "4", "5", "6", ')]
)
def test_long_lists_of_names_are_cut(count: int, text: str) -> None:
    said = listed(str(i) for i in range(count))
    assert said == text if count < 9 else said == text + '... 1 more ... and "8"'


# what real networks have
def test_seen_losses_links_and_unbiased_gains_are_read(tmp_path: Path) -> None:
    text = LINKED.replace('name = "left"\n', 'name = "left"\nloss = "seen"\n')
    problem = load(tmp_path, text.replace("[plant]", "unbiased = true\n[plant]"))
    assert [node.seen for node in problem.nodes] == [True, False]
    assert problem.delivery.tolist() == [[1.0, 0.9], [1.0, 1.0]]  # row i for what node i gets
    assert problem.unbiased is True
    assert not problem.carries_plant  # the other node loses nothing
    assert Problem.from_document(problem.document()) == problem
    assert load(tmp_path, text).carries_plant
    assert load(tmp_path, edited('name = "pair"', 'name = "pair"\nunbiased = true')).carries_plant


def test_a_delivery_probability_of_1_loses_nothing(tmp_path: Path) -> None:
    problem = load(tmp_path, linked("0.9", "1"))
    assert problem.delivery.tolist() == [[1.0, 1.0], [1.0, 1.0]]


def test_an_unstable_plant_is_admissible_where_the_errors_do_not_contain_the_state(tmp_path: Path) -> None:
    problem = load(tmp_path, unstable(left='loss = "seen"', unbiased="unbiased = true"))
    assert abs(np.linalg.eigvals(problem.plant.A)).max() == pytest.approx(1.02)
    nothing_lost = unstable(unbiased="unbiased = true").replace("arrival_probability = 0.75", "arrival_probability = 1")
    assert not load(tmp_path, nothing_lost).carries_plant


# what is refused
REFUSED = [
    # missing, unknown and misspelt fields
    ("", '"name" is missing'),
    (edited("[plant]\n", ""), 'A: this key is not known here; "plant" is missing'),
    (edited("C = [[1.0, 0.0]]\n", ""), 'node "left": "C" is missing'),
    (edited(JOINED, ""), 'topology "joined": "adjacency" is missing'),
    (edited("[markov]", "[markof]"), 'markof: this key is not known here; "markov" is missing'),
    (edited("arrival_probability = 0.75", "arrival = 0.75"),
     'node "left": arrival: this key is not known here; "arrival_probability" is missing'),
    (TEXT.replace("[[node]]", "[[nodes]]"), 'nodes: this key is not known here; "node" is missing'),
    (TEXT.replace("[[topology]]", "[[topologies]]"), 'topologies: this key is not known here; "topology" is missing'),
    (edited("[plant]", "[plant]\nQ = 1"), "plant: Q: this key is not known here"),
    (edited("decay = 0.2", "decay = 0.2\nphase = 1"), "disturbance: phase: this key is not known here"),
    # names
    (edited('"pair"', '"a pair"'), "name: 'a pair' is not a legal name: use 1 to 64 letters, digits, \"-\" and \"_\""),
    (edited('"pair"', "5"), "name: must be a string, got 5"),
    (edited('"left"', '"a/b"'),
     'node "a/b": name: \'a/b\' is not a legal name: use 1 to 64 letters, digits, "-" and "_"'),
    (edited('"left"', '"a\\n"'),
     'node number 1: name: \'a\\n\' is not a legal name: use 1 to 64 letters, digits, "-" and "_"'),
    (edited('"left"', '""'), 'node "": name: \'\' is not a legal name: use 1 to 64 letters, digits, "-" and "_"'),
    (edited('"left"', "2"), "node number 1: name: must be a string, got 2"),
    (edited('"left"', '"right"'), 'node "right" is there 2 times; names must differ'),
    (edited('"joined"', '"apart"'), 'topology "apart" is there 2 times; names must differ'),
    # shapes
    (edited("[[0.5, 0.1], [0.0, -0.5]]", "[[0.5, 0.1]]"), "plant: A is 1 x 2; it must be square"),
    (edited("[[0.5, 0.1], [0.0, -0.5]]", "[[0.5, 0.1], [0.0]]"), "plant: A: row 2 has 1 entry; row 1 has 2"),
    (edited("[[0.5, 0.1], [0.0, -0.5]]", "[0.5, 0.1]"),
     "plant: A: must be a matrix, a list of rows such as [[1.0, 0.0]], got [0.5, 0.1]"),
    (edited("[[0.5, 0.1], [0.0, -0.5]]", "[[], []]"),
     "plant: A: must be a matrix, a list of rows such as [[1.0, 0.0]], got [[], []]"),
    (edited("[[0.5, 0.1], [0.0, -0.5]]", "0.5"),
     "plant: A: must be a matrix, a list of rows such as [[1.0, 0.0]], got 0.5"),
    (edited("B = [[1.0], [0.5]]", "B = [[1.0]]"), "plant: B is 1 x 1; A is 2 x 2, so B needs 2 rows"),
    (edited("M = [[1.0, 0.0]]", "M = [[1.0]]"), "plant: M is 1 x 1; A is 2 x 2, so M needs 2 columns"),
    (edited("C = [[1.0, 0.0]]", "C = [[1.0]]"),
     'node "left": C is 1 x 1; the plant has 2 states, so C needs 2 columns'),
    (edited("D = [[0.1]]", "D = [[0.1, 0.1]]"),
     'node "left": D is 1 x 2; the plant has 1 disturbance, so D needs 1 column'),
    (edited("D = [[0.1]]", "D = [[0.1], [0.1]]"),
     'node "left": C is 1 x 2 and D is 2 x 1; both need one row for each measurement of the node'),
    (edited(JOINED, "adjacency = [[1]]"), 'topology "joined": adjacency is 1 x 1; for 2 nodes it must be 2 x 2'),
    (edited(", [0.25, 0.75]]", "]"), "markov: transition is 1 x 2; for 2 topologies it must be 2 x 2"),
    # numbers
    (edited("A = [[0.5", "A = [[nan"), "plant: A: row 1 holds nan; every entry must be a finite float64"),
    (edited("-0.5]]", "-inf]]"), "plant: A: row 2 holds -inf; every entry must be a finite float64"),
    (edited("A = [[0.5", "A = [[1e400"), "plant: A: row 1 holds inf; every entry must be a finite float64"),
    (edited("A = [[0.5", f"A = [[{HUGE}"),
     f"plant: A: row 1 holds {HUGE[:57]}...; every entry must be a finite float64"),
    (edited("A = [[0.5", "A = [[0x" + "f" * 6000),
     "plant: A: row 1 holds an integer of thousands of digits; every entry must be a finite float64"),
    (edited("A = [[0.5", "A = [[true"), "plant: A: row 1 holds True, which is not a number"),
    (edited("A = [[0.5", 'A = [["0.5"'), "plant: A: row 1 holds '0.5', which is not a number"),
    (edited("A = [[0.5", "A = [[2020-01-01"), "plant: A: row 1 holds datetime.date(2020, 1, 1), which is not a number"),
    (edited("A = [[0.5", "A = [[1.0"),
     "plant: A is unstable: its spectral radius is 1 and must be below 1, "
     "because the errors contain the state; an unstable plant needs unbiased = true, "
     'and loss = "seen" at every node that loses measurements'),
    # an unstable plant where the errors contain the state
    (unstable(left='loss = "seen"'),
     "plant: A is unstable: its spectral radius is 1.02 and must be below 1, "
     "because the errors contain the state; an unstable plant needs unbiased = true, "
     'and loss = "seen" at every node that loses measurements'),
    (unstable(unbiased="unbiased = true"),
     'plant: A is unstable, its spectral radius is 1.02, and node "left" does not know which of its measurements are '
     'lost: its errors then contain the state; give it loss = "seen"'),
    # losses that are seen, links that lose messages, unbiased gains
    (edited('name = "left"', 'name = "left"\nloss = "sometimes"'),
     "node \"left\": loss: must be 'hidden' or 'seen', got 'sometimes'"),
    (edited('name = "left"', 'name = "left"\nloss = true'),
     "node \"left\": loss: must be 'hidden' or 'seen', got True"),
    (edited('name = "pair"', 'name = "pair"\nunbiased = "yes"'), "unbiased: must be true or false, got 'yes'"),
    (edited('name = "pair"', 'name = "pair"\nunbiased = 1'), "unbiased: must be true or false, got 1"),
    (linked('receiver = "left"', 'receiver = "top"'),
     'link from "right" to "top": node "top" does not exist; the problem has nodes "left" and "right"'),
    (linked('sender = "right"', 'sender = "top"'),
     'link from "top" to "left": node "top" does not exist; the problem has nodes "left" and "right"'),
    (linked('sender = "right"', 'sender = "left"'),
     'link from "left" to "left": a node has its own numbers always; name two nodes'),
    (LINKED.replace(JOINED, "adjacency = [[1, 0], [1, 1]]"),
     'link from "right" to "left": "left" hears "right" in no topology'),
    (LINKED.replace(LINK, LINK + LINK), 'link from "right" to "left" is there twice; give it one delivery_probability'),
    (linked("0.9", "0.0"), "link number 1: delivery_probability: 0.0 is not in (0, 1]; "
     "1 means that every message arrives"),
    (linked("0.9", "1.1"), "link number 1: delivery_probability: 1.1 is not in (0, 1]; "
     "1 means that every message arrives"),
    (linked("0.9", "nan"), "link number 1: delivery_probability: must be finite, got nan"),
    (linked("0.9", '"0.9"'), "link number 1: delivery_probability: must be a number, got '0.9'"),
    (linked('receiver = "left"\n', ""), 'link number 1: "receiver" is missing'),
    (linked('receiver = "left"', "receiver = 1"), "link number 1: receiver: must be a string, got 1"),
    (linked("delivery_probability", "delivery"),
     'link number 1: delivery: this key is not known here; "delivery_probability" is missing'),
    ("link = []\n" + TEXT, "link: must not be empty, got []"),
    # probabilities
    (edited("0.75\n", "0.0\n"),
     'node "left": arrival_probability: 0.0 is not in (0, 1]; 1 means that no measurement is ever lost'),
    (edited("0.75\n", "1.5\n"),
     'node "left": arrival_probability: 1.5 is not in (0, 1]; 1 means that no measurement is ever lost'),
    (edited("0.75\n", "nan\n"), 'node "left": arrival_probability: must be finite, got nan'),
    (edited("0.75\n", '"0.75"\n'), "node \"left\": arrival_probability: must be a number, got '0.75'"),
    (edited("0.75\n", "true\n"), 'node "left": arrival_probability: must be a number, got True'),
    (edited("0.25, 0.75]", "0.25, 0.85]"), 'markov: transition, row of "joined", sums to 1.1; it must sum to 1'),
    (edited("0.25, 0.75]", "0.25, 0.750000002]"),
     'markov: transition, row of "joined", sums to 1.000000002; it must sum to 1'),
    (edited("0.25, 0.75]", "-0.25, 1.25]"),
     'markov: transition, row of "joined", holds -0.25; a probability lies in [0, 1]'),
    (edited('initial = "apart"', 'initial = "together"'),
     'markov: initial "together" is no topology; the topologies are "apart" and "joined"'),
    (edited('initial = "apart"', "initial = 1"), "markov: initial: must be a string, got 1"),
    # topologies
    (edited(JOINED, "adjacency = [[1, 1], [1, 0]]"),
     'topology "joined": adjacency has 0 for "right" itself; a node hears itself, a_ii = 1'),
    (edited(JOINED, "adjacency = [[1, -2], [1, 1]]"),
     'topology "joined": adjacency gives "left" hearing "right" the weight -2.0; a weight is 0 or positive'),
    (edited(JOINED, JOINED + "\nhears = {}"),
     'topology "joined": hears and adjacency are both given; keep one of them'),
    (edited(JOINED, 'hears = { left = ["up"] }'),
     'topology "joined": hears: node "up" does not exist; the nodes are "left" and "right"'),
    (edited(JOINED, 'hears = { up = ["left"] }'),
     'topology "joined": hears: node "up" does not exist; the nodes are "left" and "right"'),
    (edited(JOINED, "hears = { left = [2] }"),
     'topology "joined": hears: node 2 does not exist; the nodes are "left" and "right"'),
    (edited(JOINED, 'hears = { left = "right" }'),
     'topology "joined": hears must map a node to a list of nodes, such as { "1" = ["4"] }'),
    # tables that are none
    ("plant = 3\n" + TEXT.split("[plant]")[0] + TEXT[TEXT.index("[[node]]") :],
     "plant: must be a table of keys and values, got 3"),
    (TEXT.split("[[node]]")[0] + "[[topology]]" + TEXT.split("[[topology]]", 1)[1], '"node" is missing'),
    ("node = []\n" + TEXT.split("[[node]]")[0] + "[[topology]]" + TEXT.split("[[topology]]", 1)[1],
     "node: must not be empty, got []"),
    (TEXT.split("[[node]]")[0] + "[node]\n[[topology]]" + TEXT.split("[[topology]]", 1)[1],
     "node: must be a list; write [[node]], once for each entry"),
    (TEXT.replace("[[node]]", "[[nodes]]").replace(JOINED, 'hears = { left = ["right"] }'),
     'nodes: this key is not known here; "node" is missing'),
    (edited("[plant]", "[plant]\nunbiased = true"),
     "unbiased stands in the table plant; it belongs at the top, before every table"),
    (TEXT + "unbiased = true\n", "unbiased stands in the table disturbance; it belongs at the top, before every table"),
    (TEXT + '[[link]]\nto = "left"\n',
     'link number 1: to: this key is not known here; "receiver", "sender" and "delivery_probability" are missing'),
    ("topology = [1]\n" + TEXT.split("[[topology]]")[0] + "[markov]" + TEXT.split("[markov]")[1],
     "topology number 1: must be a table of keys and values, got 1"),
    # disturbances
    (edited(SINE, "decay = 0.2"), 'disturbance: "kind" is missing'),
    (edited(SINE, 'kind = "sine"'),
     'disturbance: kind "sine" is not known; there are "damped-sine", "impulse", "white", "csv", "worst-case", "none"'),
    (edited("decay = 0.2", ""), 'disturbance: "decay" is missing'),
    (edited("decay = 0.2", "decay = -1"), "disturbance: decay: must be at least 0, got -1"),
    (edited("decay = 0.2", 'decay = "1"'), "disturbance: decay: must be a number, got '1'"),
    (edited("decay = 0.2", "decay = true"), "disturbance: decay: must be a number, got True"),
    (edited("decay = 0.2", "decay = inf"), "disturbance: decay: must be finite, got inf"),
    (edited(SINE, 'kind = "impulse"\nat = 1.5'), "disturbance: at: must be a whole number, got 1.5"),
    (edited(SINE, 'kind = "impulse"\nat = true'), "disturbance: at: must be a whole number, got True"),
    (edited(SINE, 'kind = "impulse"\nat = -1'), "disturbance: at: must be at least 0, got -1"),
    (edited(SINE, 'kind = "white"\ndeviation = 0'), "disturbance: deviation: must be greater than 0, got 0"),
    (edited(SINE, 'kind = "csv"'), 'disturbance: "file" is missing'),
    (edited(SINE, CSV), "FOLDER/w.csv does not exist; a CSV file of the disturbance was expected there"),
    (edited(SINE, 'kind = "csv"\nfile = "."'),
     "FOLDER could not be read as a CSV file of the disturbance: Is a directory"),
]  # fmt: skip


@pytest.mark.parametrize(("text", "sentence"), REFUSED, ids=[sentence[:60] for _, sentence in REFUSED])
def test_what_is_wrong_is_refused_in_one_sentence(tmp_path: Path, text: str, sentence: str) -> None:
    assert refusal(tmp_path, text) == sentence


@pytest.mark.parametrize(
    ("data", "sentence"),
    [
        (b"", "disturbance: FOLDER/w.csv is empty; it needs a row of numbers for each step"),
        (b"w\n1\n", "disturbance: FOLDER/w.csv, row 1 is not all numbers: 'w'"),
        (b"1\n\n2\n", "disturbance: FOLDER/w.csv, row 2 is not all numbers: ''"),
        (b"1\n\xff\n", "disturbance: FOLDER/w.csv, row 2 is not all numbers: '\ufffd'"),
        (b"1\n1,2\n", "disturbance: values: row 2 has 2 entries; row 1 has 1"),
        (b"1\nnan\n", "disturbance: values: row 2 holds nan; every entry must be a finite float64"),
        (b"1,2\n", 'disturbance: "w.csv" has 2 columns; the plant has 1 disturbance'),
    ],
)
def test_a_wrong_csv_is_refused_in_one_sentence(tmp_path: Path, data: bytes, sentence: str) -> None:
    (tmp_path / "w.csv").write_bytes(data)
    assert refusal(tmp_path, edited(SINE, CSV)) == sentence


@pytest.mark.parametrize(
    "data",
    [b"name = ", b'{"name": 1}', b"\xff\xfe", b"name = " + b"[" * 5000, b"name = " + b"9" * 5000, b"\x00"],
    ids=["cut", "json", "not-utf8", "deep", "long", "nul"],
)
def test_what_is_not_toml_is_refused(tmp_path: Path, data: bytes) -> None:
    assert refusal(tmp_path, data).startswith(" is not a problem file: it is not valid TOML: ")


def test_a_file_that_is_not_there_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"none\.toml does not exist; a problem file was expected there$"):
        Problem.load(tmp_path / "none.toml")


def test_a_folder_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"could not be read as a problem file: Is a directory$"):
        Problem.load(tmp_path)


@pytest.mark.parametrize("sum_of_row", [1.0 - 0.9e-9, 1.0 + 0.9e-9])
def test_a_row_of_the_chain_may_miss_1_by_rounding(tmp_path: Path, sum_of_row: float) -> None:
    load(tmp_path, edited("[0.25, 0.75]", f"[0.25, {sum_of_row - 0.25!r}]"))


# exactness
finite = st.floats(allow_nan=False, allow_infinity=False)
edges = st.sampled_from([-0.0, 0.0, 5e-324, 2.2250738585072014e-308, 1e308, -1.7976931348623157e308, 0.1, 1 / 3])


@given(st.lists(finite | edges, min_size=6, max_size=6))
def test_every_float_survives_the_file_bit_for_bit(numbers: list[float]) -> None:
    """B, C and D take any finite number, so they carry the test."""
    document = random_problem(1, ny=(1,), modes=1).document()
    document["plant"]["B"] = [numbers[:2], numbers[2:4]]
    document["node"][0]["C"] = [numbers[4:]]
    problem = Problem.from_document(document)
    again = Problem.from_document(problem.document())
    assert again.canonical() == problem.canonical()
    read = [*again.plant.B.ravel(), *again.nodes[0].C.ravel()]
    assert struct.pack("6d", *read) == struct.pack("6d", *numbers)


@given(st.integers(0, 50))
def test_documents_give_back_the_same_problem(seed: int) -> None:
    problem = random_problem(seed, ny=(2, 1), modes=2, nw=3, nz=2)
    again = Problem.from_document(problem.document())
    assert again == problem
    assert hash(again) == hash(problem)
    assert again.digest() == problem.digest()


# the digest
def test_the_digest_does_not_depend_on_the_order_in_the_file(tmp_path: Path) -> None:
    head, _, tail = TEXT.partition("[plant]\n")
    plant, _, rest = tail.partition("[[node]]")
    A, B, M = plant.splitlines()
    moved = "\n".join([head, "[[node]]" + rest, "[plant]", M, B, A])
    assert load(tmp_path, moved).digest() == load(tmp_path, TEXT).digest()


def test_the_digest_does_not_depend_on_how_a_number_is_written(tmp_path: Path) -> None:
    assert load(tmp_path, edited("0.75\n", "7.5e-1\n")).digest() == load(tmp_path, TEXT).digest()


def test_the_digest_does_not_depend_on_saying_what_goes_without_saying(tmp_path: Path) -> None:
    """Losses are hidden and gains not imposed to be unbiased unless a file says otherwise."""
    said = edited('name = "left"', 'name = "left"\nloss = "hidden"').replace("[plant]", "unbiased = false\n[plant]")
    assert load(tmp_path, said).digest() == load(tmp_path, TEXT).digest()
    others = {load(tmp_path, text).digest() for text in (
        TEXT,
        edited('name = "left"', 'name = "left"\nloss = "seen"'),
        edited('name = "pair"', 'name = "pair"\nunbiased = true'),
        LINKED,
        linked("0.9", "0.8"),
    )}  # fmt: skip
    assert len(others) == 5


def leaves(value: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    if isinstance(value, dict):
        return [leaf for key, inner in value.items() for leaf in leaves(inner, (*path, key))]
    if isinstance(value, list | tuple):
        return [leaf for key, inner in enumerate(value) for leaf in leaves(inner, (*path, key))]
    return [path]


def test_the_digest_changes_with_every_value() -> None:
    """Each name in turn, and the last bit of each number."""
    before = random_problem(4, ny=(1, 2), modes=2)
    text = before.canonical()
    digests, paths = {before.digest()}, leaves(before.document())
    for path in paths:
        document: Any = json.loads(text)
        inner = document
        for key in path[:-1]:
            inner = inner[key]
        if path == ("disturbance", "kind"):
            document["disturbance"] = {"kind": "none"}
        elif path == ("markov", "initial"):
            inner["initial"] = "mode-0"
        elif isinstance(inner[path[-1]], str):
            inner[path[-1]] += "-x"
            if path[0] == "topology" and document["markov"]["initial"] == inner[path[-1]][:-2]:
                document["markov"]["initial"] += "-x"
        else:
            inner[path[-1]] = float(np.nextafter(inner[path[-1]], 0.5))
        digests.add(Problem.from_document(document).digest())
    assert len(digests) == len(paths) + 1
