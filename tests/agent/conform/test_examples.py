"""The nodes in plain Python, in a run of real processes: nobody can tell them from ours."""

from __future__ import annotations

import ast
import json
import sys
from importlib.metadata import version
from pathlib import Path

import pytest
from places import GOLDEN, ROOT
from runs import logged, run_here

from agent.contract.gains import Gains
from agent.contract.keys import BESIDE
from agent.contract.recording.reader import RecordingReader
from agent.guests import guests
from designer.replay import replay

EXAMPLES = ROOT / "examples"
PLAIN, PACED = EXAMPLES / "plain_node.py", EXAMPLES / "paced_node.py"
NAME = "zhu2020-lossy"


def later(folder: Path) -> Path:
    """The node as a later version may be: every message has a field that ours do not know."""
    first, second, third = version("peakmesh").split(".")
    old, new = "step=k, x_hat=x", f'step=k, reason=["any"], version="{first}.{second}.{int(third) + 1}", x_hat=x'
    text = PLAIN.read_text()
    assert text.count(old) == 1
    (folder / "later.py").write_text(text.replace(old, new))
    return folder / "later.py"


def numbers(path: Path) -> dict[tuple[str, int], dict[str, object]]:
    """What was said of every step, without what only a later version says."""
    said = [(message.topic, json.loads(message.payload)) for message in logged(path)]
    return {
        (topic, document["step"]): {name: document[name] for name in document.keys() - {"reason", "version"}}
        for topic, document in said
        if topic not in BESIDE
    }


def test_a_run_with_them_is_the_golden_one(tmp_path: Path) -> None:
    """Every number that anybody says, to the last bit; one of them is of a later version. Both end well."""
    gains_path, recording = GOLDEN / f"{NAME}.gains.json", tmp_path / "run.mcap"
    told: list[str] = []
    commands = {"3": [sys.executable, str(later(tmp_path))], "2": [sys.executable, str(PACED)]}
    with RecordingReader(GOLDEN / f"{NAME}.mcap") as golden:
        facts = {name: int(golden.run[name]) for name in ("steps", "seed")}
    summary = run_here(
        gains_path,
        recording,
        heed=lambda word: told.append(str(word.get("warning", ""))),
        guests=guests(Gains.load(gains_path), nodes=commands, sensors={}, plant=None),
        **facts,
    )
    assert (summary["missing"], [sentence for sentence in told if "did not end well" in sentence]) == (0, [])
    assert any(b'"reason"' in message.payload for message in logged(recording))
    assert numbers(recording) == numbers(GOLDEN / f"{NAME}.mcap")
    assert replay(recording).exit_code == 0


@pytest.mark.parametrize("path", [PLAIN, PACED], ids=lambda path: path.stem)
def test_they_are_short_and_need_nothing_of_ours(path: Path) -> None:
    text = path.read_text()
    modules = {node.module if isinstance(node, ast.ImportFrom) else node.names[0].name
               for node in ast.walk(ast.parse(text)) if isinstance(node, ast.Import | ast.ImportFrom)}  # fmt: skip
    assert modules - set(sys.stdlib_module_names) <= {"zenoh", "plain_node"}
    code = [line for line in text.splitlines() if line.strip() and not line.startswith(("import", "from", '"""'))]
    assert len(code) <= {PLAIN: 102, PACED: 106}[path]
