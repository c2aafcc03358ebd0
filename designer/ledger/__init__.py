"""The ledger: what the bound still says while a run has faults, and after them (docs/theory.md, section 11).

`deviation` is what goes wrong in a step, and the error model that acts in it; `exact` keeps the account step by step,
`account` goes through a whole run.
"""
