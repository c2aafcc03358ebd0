"""What Foxglove's own SDK knows of the settings of panels."""

from __future__ import annotations

import re
from typing import Any, get_args, get_type_hints

from foxglove.layouts import PlotConfig, PlotSeries, PlotXAxisPath

TITLE = "foxglovePanelTitle"  # of any panel


def unknown(document: dict[str, Any], model: type, *more: str) -> list[str]:
    """What the field's own SDK does not know of a panel's or a series' settings, names and words."""
    names = model()._to_dict()
    words = {}
    for name, hint in get_type_hints(model).items():
        camel = re.sub(r"_(\w)", lambda found: found[1].upper(), name)
        words[camel] = [word for part in get_args(hint) for word in get_args(part)] or None
    return [name for name in document if name not in names and name not in more] + [
        f"{name}: {value}"
        for name, value in document.items()
        if words.get(name) and isinstance(value, str) and value not in words[name]
    ]


def faults(plot: dict[str, Any]) -> list[str]:
    """Of a whole plot."""
    found = unknown(plot, PlotConfig, TITLE) + unknown(plot["xAxisPath"], PlotXAxisPath)
    return found + [fault for series in plot["paths"] for fault in unknown(series, PlotSeries)]
