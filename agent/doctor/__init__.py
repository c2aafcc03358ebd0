"""Whether this machine can take part in a run: what is looked at, and what was found. Each look may find what it names.

`software` is what is installed, `machine` limits, memory and clocks, `network` who can be reached.
"""
