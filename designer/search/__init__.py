"""Gains of least exact gain: where the search starts, how it descends, and the design that comes of it."""
