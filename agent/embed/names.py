"""Names of nodes and modes as C identifiers, no two of them the same, in one node's files or in those of all."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from agent.contract.problem import Problem


class Names(NamedTuple):
    """How the parts of a node's program are called."""

    node: str  # of functions, types and files: "node_2"
    senders: dict[str, str]  # whom it hears in some mode, itself among them, in file order: "FROM_1"
    modes: dict[str, str]  # "MODE_RING"

    @property
    def constants(self) -> str:
        """What every constant begins with."""
        return self.node.upper()


def names_of(problem: Problem, node: str) -> Names:
    """Names of all that node `node` needs. Raises InputError where it does not exist."""
    i = problem.node_index(node)
    heard = [problem.node_names[j] for j in sorted({i, *problem.ever_heard(i)})]
    return Names(
        node=identifiers("node", problem.node_names)[i].lower(),
        senders=dict(zip(heard, identifiers("FROM", heard), strict=True)),
        modes=dict(zip(problem.mode_names, identifiers("MODE", problem.mode_names), strict=True)),
    )


def identifiers(kind: str, names: Sequence[str]) -> list[str]:
    """`KIND_NAME` for each name; with its number, `KIND3_NAME`, where that could be taken for another, or part of it.

    Capitals do not tell them apart, and what begins like another with a "_" after it is part of it.
    """
    plain = [f"{kind}_{name.replace('-', '_')}".upper() for name in names]

    def is_alone(i: int) -> bool:
        others = (other for j, other in enumerate(plain) if j != i)
        return not any(
            f"{other}_".startswith(f"{plain[i]}_") or f"{plain[i]}_".startswith(f"{other}_") for other in others
        )

    return [
        one if is_alone(i) else f"{kind}{i}_{one.removeprefix(f'{kind}_'.upper())}".upper()
        for i, one in enumerate(plain)
    ]
