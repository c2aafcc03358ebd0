"""A Foxglove layout for a recording of a problem, attached to it: estimates over the truth, innovations, modes."""

from __future__ import annotations

from typing import Any

from agent.contract.keys import MODE, PLANT_STATE, estimate
from agent.contract.problem import Problem


def foxglove_layout(problem: Problem) -> dict[str, Any]:
    """Two plots and a table: z with every z_hat_i, the first entry of every innovation, and the raw mode messages."""
    outputs = [f"{PLANT_STATE}.z[{row}]" for row in range(problem.nz)]
    outputs += [f"{estimate(name)}.z_hat[{row}]" for name in problem.node_names for row in range(problem.nz)]
    innovations = [f"{estimate(name)}.innovation[0]" for name in problem.node_names]
    return {
        "configById": {
            "Plot!outputs": _plot("z and every z_hat", outputs),
            "Plot!innovations": _plot("innovations", innovations),
            "RawMessages!mode": {"topicPath": MODE},
        },
        "globalVariables": {},
        "userNodes": {},
        "playbackConfig": {"speed": 1},
        "layout": {
            "direction": "column",
            "first": "Plot!outputs",
            "second": {"direction": "row", "first": "Plot!innovations", "second": "RawMessages!mode"},
        },
    }


def _plot(title: str, paths: list[str]) -> dict[str, Any]:
    return {
        "title": title,
        "paths": [{"value": path, "enabled": True, "timestampMethod": "receiveTime"} for path in paths],
        "showLegend": True,
        "xAxisVal": "timestamp",
    }
