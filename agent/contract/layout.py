"""A Foxglove layout for a recording of a problem, attached to it: estimates over the truth, innovations, modes.

Plots have the step on their x-axis, from the message that each value is in: by time, what belongs to one step stands
apart, by as much as the steps ran ahead. Values hold from one step to the next, so lines are drawn as steps.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from agent.contract.keys import MODE, PLANT_STATE, estimate
from agent.contract.problem import Problem


def foxglove_layout(problem: Problem) -> dict[str, Any]:
    """z with every z_hat_i, the first entries of the innovations, and the modes: numbers by step, words by time."""
    outputs = {f"z[{row}]": (PLANT_STATE, f"z[{row}]") for row in range(problem.nz)}
    innovations = {}
    for name in problem.node_names:
        outputs |= {f"z_hat[{row}] of {name}": (estimate(name), f"z_hat[{row}]") for row in range(problem.nz)}
        innovations[name] = estimate(name), "innovation[0]"
    return layout(
        {
            "Plot!outputs": plot("z and every z_hat", outputs),
            "Plot!innovations": plot("innovations, their first entries", innovations),
            "Plot!modes": plot("mode, by its place in the problem", {"mode": (MODE, "index")}),
            "StateTransitions!modes": {
                "foxglovePanelTitle": "mode, by the time of recording",
                "paths": [{"value": f"{MODE}.mode", "label": "mode", "timestampMethod": "receiveTime"}],
                "isSynced": True,
            },
        },
        column("Plot!outputs", column("Plot!innovations", column("Plot!modes", "StateTransitions!modes"))),
    )


def layout(panels: Mapping[str, Any], arrangement: Any) -> dict[str, Any]:
    """A layout file: the settings of each panel under its id, and which panel stands where."""
    return {
        "configById": dict(panels),
        "globalVariables": {},
        "userNodes": {},
        "playbackConfig": {"speed": 1},
        "layout": arrangement,
    }


def column(first: Any, second: Any) -> dict[str, Any]:
    """One panel, or arrangement of panels, above another."""
    return {"direction": "column", "first": first, "second": second}


def plot(title: str, series: Mapping[str, tuple[str, str]]) -> dict[str, Any]:
    """A plot by step; `series` gives the topic and the field of each label."""
    topics = [topic for topic, _ in series.values()]
    return {
        "foxglovePanelTitle": title,
        "paths": [
            {
                "value": f"{topic}.{field}",
                "label": label,
                "enabled": True,
                "timestampMethod": "receiveTime",
                "xValuePath": f"{topic}.step",
                "lineInterpolation": "step",
            }
            for label, (topic, field) in series.items()
        ],
        "xAxisVal": "custom",
        "xAxisPath": {"value": f"{topics[0]}.step", "enabled": True},
        "xAxisLabel": "step",
        "showLegend": True,
        "isSynced": True,
    }
