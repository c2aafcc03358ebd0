"""The colours of maps: from pale to dark, the same on a page and on paper, told apart by readers of every vision."""

from __future__ import annotations

import numpy as np

Colour = tuple[int, int, int, int]  # red, green, blue, opacity, each 0 ... 255


# ColorBrewer's YlGnBu (Cynthia Brewer, Apache-2.0): its lightness falls all the way
_RAMP = ("#ffffd9", "#edf8b1", "#c7e9b4", "#7fcdbb", "#41b6c4", "#1d91c0", "#225ea8", "#253494", "#081d58")


def rgb(colour: str) -> tuple[int, int, int]:
    """ "#ffffd9" -> (255, 255, 217)."""
    red, green, blue = bytes.fromhex(colour.removeprefix("#"))
    return red, green, blue


def ramp(levels: int) -> list[Colour]:
    """So many colours, opaque, the palest first."""
    anchors = np.array([rgb(colour) for colour in _RAMP])
    at = np.linspace(0.0, len(anchors) - 1.0, levels)
    parts = [np.interp(at, np.arange(len(anchors)), anchors[:, part]).round().astype(int).tolist() for part in range(3)]
    return [(red, green, blue, 255) for red, green, blue in zip(*parts, strict=True)]


def css_ramp() -> str:
    """The same as a gradient of a style sheet."""
    return f"linear-gradient(to right, {', '.join(_RAMP)})"
