"""What a paced run substituted, and what it says of that; losses of the model are counted apart."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from agent.contract.errors import counted
from agent.contract.messages import Account
from designer.replay.coupling import Coupling
from designer.replay.log import Log
from designer.replay.topics import Numbers

NAMED = 5


class Delays(NamedTuple):
    """What a node has told of its latencies, in s: median, 99th percentile and maximum of each."""

    node: str
    to_estimate: tuple[float, float, float]  # from the arrival of its measurement to the estimate with it
    to_step: tuple[float, float, float]  # from a tick to the next estimate

    @classmethod
    def of(cls, node: str, account: Account) -> Delays:
        return cls(
            node,
            (account.to_estimate_median, account.to_estimate_p99, account.to_estimate_max),
            (account.to_step_median, account.to_step_p99, account.to_step_max),
        )


@dataclass(frozen=True)
class Pacing:
    """Counts over the whole log, and the first places of what is not explained."""

    period: float  # seconds
    pairs: int  # that nodes were to use, by the mode and the seed
    pairs_substituted: int
    pairs_lost: int  # by the model: the seed decides over them
    measurements_substituted: int
    reasons: dict[str, int]  # how many substitutions each kind of event names
    unexplained: tuple[str, ...]  # substitutions that no event names, for their node was killed; the first ones
    unexplained_total: int
    beginnings: tuple[str, ...]  # who began again, when, and with what
    absences: tuple[str, ...]
    faults: tuple[str, ...]  # injected
    delays: tuple[Delays, ...]  # of the nodes that have given account, by the last process of each

    @classmethod
    def of(cls, coupling: Coupling, by_seed: Numbers, period: float) -> Pacing:
        """`by_seed` (steps, n) are the positions in `log.senders` of those that each node was to use."""
        log, n = coupling.log, coupling.log.gains.problem.n
        members = np.vstack([log.senders.members(), np.zeros((1, n), dtype=bool)])
        wanted = members[by_seed] & ~np.eye(n, dtype=bool)
        known = np.vstack([(log.heard[1:] >= 0) & (log.origin[1:] == -1), np.zeros((1, n), dtype=bool)])
        wanted &= known[:, :, None]
        modes = np.where((coupling.inputs.mode >= 0), coupling.inputs.mode, 0)
        hears = np.array([topology.adjacency > 0.0 for topology in log.gains.problem.topologies])[modes]
        lost = hears & ~members[by_seed] & known[:, :, None] & ~np.eye(n, dtype=bool)
        names = log.gains.problem.node_names
        unexplained = [f'node "{names[i]}" at step {step}' for step, i in coupling.unexplained]
        return cls(
            period=period,
            pairs=int(wanted.sum()),
            pairs_substituted=int((wanted & ~coupling.used).sum()),
            pairs_lost=int(lost.sum()),
            measurements_substituted=int(((log.told == 0) & (log.origin == -1)).sum()),
            reasons=dict(sorted(log.said.kinds.items())),
            unexplained=tuple(unexplained[:NAMED]),
            unexplained_total=len(unexplained),
            beginnings=tuple(_beginnings(log)),
            absences=tuple(_absences(coupling)),
            faults=tuple(log.said.faults),
            delays=tuple(Delays.of(names[i], account) for i, account in sorted(log.said.accounts.items())),
        )

    def document(self) -> dict[str, Any]:
        """For --json."""
        plain = {name: list(value) if isinstance(value, tuple) else value for name, value in vars(self).items()}
        return plain | {"delays": [delays._asdict() for delays in self.delays]}

    def text(self) -> list[str]:
        share = f" ({self.pairs_substituted / self.pairs:.2%})" if self.pairs else ""
        why = ", ".join(f"{count} {kind}" for kind, count in self.reasons.items())
        lines = [
            f"paced, {1e3 * self.period:g} ms: {self.pairs_substituted} of {counted(self.pairs, 'pair')} substituted"
            f"{share}, {counted(self.measurements_substituted, 'measurement')}; "
            f"{why or 'nothing was late'}; {self.pairs_lost} lost by the model"
        ]
        for words, of in (("measurement to estimate", "to_estimate"), ("tick to step", "to_step")):
            if self.delays:
                each = zip(*(getattr(one, of) for one in self.delays), strict=True)
                median, p99, most = (1e3 * max(times) for times in each)
                lines.append(
                    f"{words}: median {median:.2f} ms, 99 % {p99:.2f} ms, most {most:.2f} ms, of the worst node"
                )
        if self.unexplained_total:
            lines.append(f"unexplained: {self.unexplained_total} ({'; '.join(self.unexplained)})")
        for word, some in (("fault", self.faults), ("away", self.absences), ("began again", self.beginnings)):
            lines += [f"{word}: {words}" for words in some[:NAMED]]
            lines += [f"{word}: {len(some) - NAMED} more"] if len(some) > NAMED else []
        return lines


def _beginnings(log: Log) -> Iterator[str]:
    names = log.gains.problem.node_names
    for step, i in zip(*np.nonzero(log.origin != -1), strict=True):
        j = int(log.origin[step, i])
        whose = f'the estimate of node "{names[j]}"' if 0 <= j < len(names) else "0"
        yield f'node "{names[i]}" at step {step}, with {whose}'


def _absences(coupling: Coupling) -> Iterator[str]:
    names = coupling.log.gains.problem.node_names
    absent = coupling.absent()
    for i, name in enumerate(names):
        edges = np.diff(np.concatenate([[False], absent[:, i], [False]]).astype(np.int8))
        for first, end in zip(np.flatnonzero(edges == 1), np.flatnonzero(edges == -1), strict=True):
            steps = f"step {first}" if end == first + 1 else f"steps {first} to {end - 1}"
            yield f'node "{name}" in {steps}'
