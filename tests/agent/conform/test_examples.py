"""The nodes in plain Python, in a run of real processes: nobody can tell them from ours."""

from __future__ import annotations

import ast
import json
import sys
from pathlib import Path

import pytest
from places import GOLDEN, ROOT
from runs import logged, run_here

from agent.contract.gains import Gains
from agent.contract.recording.reader import RecordingReader
from agent.guests import guests

EXAMPLES = ROOT / "examples"
PLAIN, PACED = EXAMPLES / "plain_node.py", EXAMPLES / "paced_node.py"
NAME = "zhu2020-lossy"


def test_a_run_with_them_is_the_golden_one(tmp_path: Path) -> None:
    """Every number that anybody says, to the last bit; both end well, or there were a warning."""
    gains_path, recording = GOLDEN / f"{NAME}.gains.json", tmp_path / "run.mcap"
    warnings = []
    commands = {"3": [sys.executable, str(PLAIN)], "2": [sys.executable, str(PACED)]}
    with RecordingReader(GOLDEN / f"{NAME}.mcap") as golden:
        facts = {name: int(golden.run[name]) for name in ("steps", "seed")}
    summary = run_here(
        gains_path,
        recording,
        heed=lambda word: warnings.extend([word["warning"]] if "warning" in word else []),
        guests=guests(Gains.load(gains_path), nodes=commands, sensors={}, plant=None),
        **facts,
    )
    assert (summary["missing"], [word for word in warnings if "did not end well" in word]) == (0, [])
    said, right = (
        {(m.topic, json.loads(m.payload)["step"]): json.loads(m.payload) for m in logged(path) if m.topic != "event"}
        for path in (recording, GOLDEN / f"{NAME}.mcap")
    )
    said, right = ({at: word for at, word in some.items() if at[0] != "evidence"} for some in (said, right))
    assert said == right


@pytest.mark.parametrize("path", [PLAIN, PACED], ids=lambda path: path.stem)
def test_they_are_short_and_need_nothing_of_ours(path: Path) -> None:
    text = path.read_text()
    modules = {node.module if isinstance(node, ast.ImportFrom) else node.names[0].name
               for node in ast.walk(ast.parse(text)) if isinstance(node, ast.Import | ast.ImportFrom)}  # fmt: skip
    assert modules - set(sys.stdlib_module_names) <= {"zenoh", "plain_node"}
    code = [line for line in text.splitlines() if line.strip() and not line.startswith(("import", "from", '"""'))]
    assert len(code) <= 106
