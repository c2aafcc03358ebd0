"""The ledger: what the bound of the gains still says while a run has faults, and after them (docs/theory.md, section 11).

`happening` is what goes wrong in a step, and the error model that acts in it; `exact` keeps the exact account, `cheap`
one of three numbers a step.
"""
