"""The number of a mode is held against its name."""

from __future__ import annotations

import copy
from pathlib import Path

from made_recordings import random_gains, random_problem, record, simulate

from designer.replay import replay

STEPS = 8


def test_a_wrong_number_of_a_mode_is_found_and_named(tmp_path: Path) -> None:
    gains = random_gains(random_problem(5))
    sent = simulate(gains, steps=STEPS)
    assert replay(record(tmp_path / "whole.mcap", gains, sent, steps=STEPS)).exit_code == 0
    changed = copy.deepcopy(sent)
    message = next(m for m in changed if m.topic == "mode" and m.document["step"] == 5)
    message.document["index"] = (message.document["index"] + 1) % 3
    verdict = replay(record(tmp_path / "changed.mcap", gains, changed, steps=STEPS))
    assert verdict.exit_code == 1
    said = f'mode, step 5: index {message.document["index"]} is not that of "{message.document["mode"]}"'
    assert said in verdict.strange


def test_a_recording_without_numbers_is_judged_by_the_names(tmp_path: Path) -> None:
    gains = random_gains(random_problem(5))
    older = copy.deepcopy(simulate(gains, steps=STEPS))
    for message in older:
        message.document.pop("index", None)
    assert replay(record(tmp_path / "older.mcap", gains, older, steps=STEPS)).exit_code == 0
