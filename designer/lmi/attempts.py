"""The solver policy: who is asked in which order, and what is said of it. No answer is believed before it is checked.

Clarabel first, with the data in other units second, SCS last where it is installed. Every answer is offered to the
caller, who checks it and asks for the next one where the check is not content. What failed, and which answers were
not good enough, stands in the status of the answers after them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import NamedTuple

from agent.contract.errors import Unattainable
from agent.contract.gains import Solver
from designer.lmi import LmiSolution

SOLVED = ("optimal", "optimal_inaccurate")
INFEASIBLE = ("infeasible", "infeasible_inaccurate")


class Attempt(NamedTuple):
    """One solver with the data in some units; `run` gives its record, and its numbers where it has any."""

    remark: str  # in which units, for the status; begins with a space, or is empty
    run: Callable[[], tuple[Solver, LmiSolution | None]]
    last_resort: bool = False  # only where the others had no answer at all


def answers(what: str, attempts: Iterable[Attempt]) -> Iterator[LmiSolution]:
    """The answers, one after the other, as long as the caller asks; Unattainable where there is none at all."""
    history: list[str] = []
    answered = infeasible = False
    for attempt in attempts:
        if attempt.last_resort and (answered or infeasible):
            continue
        record, solution = attempt.run()
        if solution is not None:
            answered = True
            status = "; ".join([record.status + attempt.remark, *history])
            yield solution._replace(solver=record.model_copy(update={"status": status}))
        infeasible |= record.status in INFEASIBLE
        history.append(f"{record.name}{attempt.remark} {record.status}")
    if infeasible and not answered:
        raise Unattainable(f"{what} is infeasible ({'; '.join(history)})")
    if not answered:
        raise Unattainable(f"no solver answered {what} ({'; '.join(history)})")


def first_accurate(found: Iterator[LmiSolution]) -> LmiSolution:
    """The first answer that is not inaccurate; else the first, with what was tried after it in the status."""
    first = next(found)
    last = first
    while last is not None and last.solver.status.startswith("optimal_inaccurate"):
        following = next(found, None)
        if following is None:
            break
        last = following
    if last is first or not last.solver.status.startswith("optimal_inaccurate"):
        return last
    return tried_further(first, last)


def tried_further(chosen: LmiSolution, last: LmiSolution) -> LmiSolution:
    """An answer that is taken although a later one was asked for: its status says so."""
    if chosen is last:
        return chosen
    status = f"{chosen.solver.status}; tried further: {last.solver.name} {last.solver.status}"
    return chosen._replace(solver=chosen.solver.model_copy(update={"status": status}))
