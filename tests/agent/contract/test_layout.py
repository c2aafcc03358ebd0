"""The layout says what Foxglove understands, and every path in it leads to a number or a word of the recording."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest
from foxglove.layouts import StateTransitionsConfig, StateTransitionsSeries
from foxglove_settings import TITLE, faults, unknown
from made_recordings import random_gains, random_problem, record, simulate
from places import GOLDEN
from runs import logged

from agent.contract.keys import MODE
from agent.contract.layout import foxglove_layout, plot
from agent.contract.messages import Mode
from agent.contract.problem import Problem
from designer.problems import find

PROBLEM = random_problem(3, nz=2)


def panels(problem: Problem, kind: str) -> list[dict[str, Any]]:
    return [panel for name, panel in foxglove_layout(problem)["configById"].items() if name.startswith(f"{kind}!")]


def test_every_setting_is_one_of_foxglove() -> None:
    plots, transitions = panels(PROBLEM, "Plot"), panels(PROBLEM, "StateTransitions")
    assert [faults(panel) for panel in plots] == [[], [], []]
    assert [unknown(panel, StateTransitionsConfig, TITLE) for panel in transitions] == [[]]
    assert [unknown(series, StateTransitionsSeries) for series in transitions[0]["paths"]] == [[]]


@pytest.mark.parametrize(
    ("place", "name", "value", "found"),
    [
        ((), "xAxis", "custom", "xAxis"),
        ((), "xAxisVal", "steps", "xAxisVal: steps"),
        (("xAxisPath",), "path", "mode.step", "path"),
        (("paths", 0), "xPath", "mode.step", "xPath"),
        (("paths", 0), "lineInterpolation", "staircase", "lineInterpolation: staircase"),
    ],
)
def test_a_setting_that_foxglove_does_not_know_is_found(
    place: tuple[Any, ...], name: str, value: str, found: str
) -> None:
    changed = plot("title", {"label": ("mode", "index")})
    here: Any = changed
    for part in place:
        here = here[part]
    here[name] = value
    assert faults(changed) == [found]


def test_plots_are_by_step_and_drawn_as_steps() -> None:
    """Each series has its step from the message that its value is in."""
    for panel in panels(PROBLEM, "Plot"):
        assert panel["xAxisVal"] == "custom"
        for series in panel["paths"]:
            assert series["xValuePath"].partition(".")[0] == series["value"].partition(".")[0]
            assert series["xValuePath"].partition(".")[2] == "step"
            assert series["lineInterpolation"] == "step"


def test_every_output_is_there() -> None:
    shown = {series["value"] for panel in panels(PROBLEM, "Plot") for series in panel["paths"]}
    wanted = {f"plant/state.z[{row}]" for row in range(2)} | {"mode.index"}
    wanted |= {f"node/{name}/estimate.z_hat[{row}]" for name in PROBLEM.node_names for row in range(2)}
    wanted |= {f"node/{name}/estimate.innovation[0]" for name in PROBLEM.node_names}
    assert shown == wanted


def test_every_panel_stands_somewhere_once() -> None:
    def placed(arrangement: Any) -> list[str]:
        if isinstance(arrangement, str):
            return [arrangement]
        return placed(arrangement["first"]) + placed(arrangement["second"])

    document = foxglove_layout(PROBLEM)
    assert sorted(placed(document["layout"])) == sorted(document["configById"])


def test_every_path_leads_to_something(tmp_path: Path) -> None:
    gains = random_gains(PROBLEM)
    path = record(tmp_path / "run.mcap", gains, simulate(gains, steps=3), steps=3)
    messages = {message.topic: json.loads(message.payload) for message in logged(path)}
    text = json.dumps(foxglove_layout(PROBLEM))
    paths = re.findall(r'"(?:value|xValuePath)": "([\w/-]+)\.(\w+)(?:\[(\d+)\])?"', text)
    assert len(paths) == text.count('"value": ') + text.count('"xValuePath": ')
    for topic, field, place in paths:
        value = messages[topic][field]
        assert isinstance(value[int(place)] if place else value, float | int | str), (topic, field)


@pytest.mark.parametrize("name", ["zhu2020-lossy", "zhu2020-ideal"])
def test_modes_are_numbered_as_in_the_problem(name: str) -> None:
    """In the golden recordings, which real coordinators made."""
    names = find(name).mode_names
    modes = [Mode.decode(message.payload) for message in logged(GOLDEN / f"{name}.mcap") if message.topic == MODE]
    assert len(modes) == 60
    assert [names[mode.index] for mode in modes] == [mode.mode for mode in modes]
