"""The curve of a sweep has every number of it, and says where there is none."""

from __future__ import annotations

import numpy as np

from designer.report.curves import curve
from designer.report.figures import rendered

VALUES = [0.1, 0.5, 0.9]
FOUND = {"certified": [None, 2.0, 1.5], "floor": [1.0, 1.0, 1.25], "bound": [None, None, None]}


def test_every_number_is_drawn_where_it_is() -> None:
    (axes,) = curve("node.*.arrival_probability", VALUES, FOUND, 3.5).axes
    drawn = {line.get_label(): line.get_xydata() for line in axes.lines}
    assert set(drawn) == {"certified", "floor", "no gains"}
    assert np.array_equal(drawn["certified"], [[0.1, np.nan], [0.5, 2.0], [0.9, 1.5]], equal_nan=True)
    assert np.array_equal(drawn["floor"], list(zip(VALUES, FOUND["floor"], strict=True)))
    assert drawn["no gains"][:, 0].tolist() == [0.1]
    assert axes.get_xlabel() == "node.*.arrival_probability"


def test_where_there_are_gains_for_all_there_is_no_cross() -> None:
    (axes,) = curve("k", VALUES, {"certified": [1.0, 2.0, 3.0]}, 7.16).axes
    assert [line.get_label() for line in axes.lines] == ["certified"]


def test_the_same_curve_has_the_same_bytes() -> None:
    one, other = (rendered(curve("k", VALUES, FOUND, 3.5), "svg") for _ in range(2))
    assert one == other
