"""Moves the clock of a process by SHIFT_CLOCK seconds; time.monotonic stays."""

import os
import time

_shift = float(os.environ.get("SHIFT_CLOCK", "0"))
if _shift:
    _time, _time_ns = time.time, time.time_ns
    time.time = lambda: _time() + _shift
    time.time_ns = lambda: _time_ns() + round(1e9 * _shift)
