"""How a problem is written down: what is not understood is refused with one sentence."""

from __future__ import annotations

from pathlib import Path

import pytest
from problem_text import CSV, JOINED, SINE, TEXT, edited, load, refusal

from agent.contract.errors import InputError
from agent.contract.problem import Problem


def test_hears_gives_the_same_problem_as_adjacency(tmp_path: Path) -> None:
    """Who is named before the sign is the receiver, row i of a_ij; a node hears itself, said or not."""
    one_way = edited(JOINED, "adjacency = [[1, 1], [0, 1]]")
    heard = edited(JOINED, 'hears = { "left" = ["right"], "right" = ["right"] }')
    apart = heard.replace("adjacency = [[1, 0], [0, 1]]", "hears = {}")
    assert load(tmp_path, apart) == load(tmp_path, one_way)
    assert load(tmp_path, apart).digest() == load(tmp_path, one_way).digest()


def test_the_numbers_of_a_csv_become_part_of_the_problem(tmp_path: Path) -> None:
    (tmp_path / "w.csv").write_bytes(b"\xef\xbb\xbf0.5\r\n-1e-3\r\n")
    problem = load(tmp_path, edited(SINE, CSV))
    (tmp_path / "w.csv").unlink()
    assert problem.document()["disturbance"]["values"] == [[0.5], [-0.001]]
    assert Problem.from_document(problem.document()) == problem


def test_a_byte_order_mark_is_no_part_of_the_text(tmp_path: Path) -> None:
    """Editors on Windows save one."""
    assert load(tmp_path, "\ufeff" + TEXT) == load(tmp_path, TEXT)


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
    # misspelt keys that are optional
    ("unbiassed = true\n" + TEXT, 'unbiassed: this key is not known here; did you mean "unbiased"?'),
    (edited("arrival_probability = 0.75", 'arrival_probability = 0.75\nlost = "seen"'),
     'node "left": lost: this key is not known here; did you mean "loss"?'),
    (TEXT + '\n[[links]]\nreceiver = "left"', 'links: this key is not known here; did you mean "link"?'),
    (edited("decay = 0.2", "decay = 0.2\nfrequenzy = 1"),
     'disturbance: frequenzy: this key is not known here; did you mean "frequency"?'),
    # topologies
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
    # a name that is none, before it is missed in hears
    (edited(JOINED, 'hears = { right = ["left"] }').replace('"left"', '"the left"', 1),
     'node "the left": name: \'the left\' is not a legal name: use 1 to 64 letters, digits, "-" and "_"'),
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
