"""A disturbance that does not exist is refused: the place, the value, what would be right."""

from __future__ import annotations

from pathlib import Path

import pytest
from problem_text import SINE, edited, refusal

REFUSED = [
    (edited(SINE, "decay = 0.2"), 'disturbance: "kind" is missing'),
    (edited(SINE, 'kind = "sine"'),
     'disturbance: kind "sine" is not known; there are "damped-sine", "impulse", "white", "csv", "worst-case", "none"'),
    (edited("decay = 0.2", ""), 'disturbance: "decay" is missing'),
    (edited(SINE, 'kind = "none"\ndecay = 1'), "disturbance: decay: this key is not known here"),
    (edited("decay = 0.2", "decay = -1"), "disturbance: decay: must be at least 0, got -1"),
    (edited("decay = 0.2", 'decay = "1"'), "disturbance: decay: must be a number, got '1'"),
    (edited("decay = 0.2", "decay = true"), "disturbance: decay: must be a number, got True"),
    (edited("decay = 0.2", "decay = inf"), "disturbance: decay: must be finite, got inf"),
    (edited(SINE, 'kind = "impulse"\nat = 1.5'), "disturbance: at: must be a whole number, got 1.5"),
    (edited(SINE, 'kind = "impulse"\nat = true'), "disturbance: at: must be a whole number, got True"),
    (edited(SINE, 'kind = "impulse"\nat = -1'), "disturbance: at: must be at least 0, got -1"),
    (edited(SINE, 'kind = "white"\ndeviation = 0'), "disturbance: deviation: must be greater than 0, got 0"),
    (edited(SINE, 'kind = "csv"'), 'disturbance: "file" is missing'),
]  # fmt: skip


@pytest.mark.parametrize(("text", "sentence"), REFUSED, ids=[sentence[:60] for _, sentence in REFUSED])
def test_what_is_wrong_is_refused_in_one_sentence(tmp_path: Path, text: str, sentence: str) -> None:
    assert refusal(tmp_path, text) == sentence
