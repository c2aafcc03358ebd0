"""Every part of a problem is refused by itself: the place, the value, what would be right."""

from __future__ import annotations

from pathlib import Path

import pytest
from problem_text import HUGE, TEXT, edited, linked, refusal

REFUSED = [
    # names
    (edited('"pair"', '"a pair"'), "name: 'a pair' is not a legal name: use 1 to 64 letters, digits, \"-\" and \"_\""),
    (edited('"pair"', "5"), "name: must be a string, got 5"),
    (edited('"left"', '"a/b"'),
     'node "a/b": name: \'a/b\' is not a legal name: use 1 to 64 letters, digits, "-" and "_"'),
    (edited('"left"', '"a\\n"'),
     'node number 1: name: \'a\\n\' is not a legal name: use 1 to 64 letters, digits, "-" and "_"'),
    (edited('"left"', '""'), 'node "": name: \'\' is not a legal name: use 1 to 64 letters, digits, "-" and "_"'),
    (edited('"left"', "2"), "node number 1: name: must be a string, got 2"),
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
    (edited("D = [[0.1]]", "D = [[0.1], [0.1]]"),
     'node "left": C is 1 x 2 and D is 2 x 1; both need one row for each measurement of the node'),
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
    # losses that are seen, links that lose messages, unbiased gains
    (edited('name = "left"', 'name = "left"\nloss = "sometimes"'),
     "node \"left\": loss: must be 'hidden' or 'seen', got 'sometimes'"),
    (edited('name = "left"', 'name = "left"\nloss = true'),
     "node \"left\": loss: must be 'hidden' or 'seen', got True"),
    (edited('name = "pair"', 'name = "pair"\nunbiased = "yes"'), "unbiased: must be true or false, got 'yes'"),
    (edited('name = "pair"', 'name = "pair"\nunbiased = 1'), "unbiased: must be true or false, got 1"),
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
    (edited("0.75\n", "0.75\nweight = 0.0\n"),
     'node "left": weight: 0.0 is not in [1e-6, 1e6]; 1 counts the node as it is, 0.1 a tenth of its error'),
    (edited('initial = "apart"', "initial = 1"), "markov: initial: must be a string, got 1"),
]  # fmt: skip


@pytest.mark.parametrize(("text", "sentence"), REFUSED, ids=[sentence[:60] for _, sentence in REFUSED])
def test_what_is_wrong_is_refused_in_one_sentence(tmp_path: Path, text: str, sentence: str) -> None:
    assert refusal(tmp_path, text) == sentence
