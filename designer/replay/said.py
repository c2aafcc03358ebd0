"""What the events of a run say of messages that were refused, or not there in time, and of who was away."""

from __future__ import annotations

from collections import Counter

from agent.contract.keys import estimate, measurement, node_who
from agent.contract.messages import GONE, LATE, REFUSED, SILENT, Account, Event


class Said:
    """Gathered event by event. Nodes are counted from 0, in file order."""

    def __init__(self, node_names: tuple[str, ...], *, memory: int = 0) -> None:
        self.events = 0
        self.accounts: dict[int, Account] = {}  # of a node, the last that it has given of itself
        self.memory = memory  # steps of which a process that is killed may not have given its reasons yet
        self.pairs: set[tuple[int, int, int]] = set()  # (step, receiver, sender): it was substituted
        self.measurements: set[tuple[int, int]] = set()  # (step, node)
        self.unheard: set[tuple[int, int]] = set()  # (step, node): its measurement never came
        self.began: set[tuple[int, int]] = set()  # (step, node): it began again
        self.gone: dict[str, list[int]] = {}  # of a participant, about when it went
        self.kinds: Counter[str] = Counter()  # why messages were substituted
        self.faults: list[str] = []  # that were injected
        self.refusals: dict[tuple[str, str], Event] = {}  # of a topic, by whom: the last count of what did not fit
        self.nodes = {node_who(name): i for i, name in enumerate(node_names)}
        self._estimates = {estimate(name): i for i, name in enumerate(node_names)}
        self._measurements = {measurement(name): i for i, name in enumerate(node_names)}

    def is_node(self, who: str) -> bool:
        return who in self.nodes

    def account(self, account: Account) -> None:
        i = self.nodes.get(account.who)
        if i is not None and account.step >= self.accounted(i):
            self.accounts[i] = account

    def accounted(self, i: int) -> int:
        """The last step that a node has given account of; -1 where it has of none."""
        return self.accounts[i].step if i in self.accounts else -1

    def add(self, event: Event) -> None:
        self.events += 1
        i = self.nodes.get(event.who)
        if event.kind == "fault":
            self.faults.append(event.detail)
        elif i is None and event.kind == GONE:
            self.gone.setdefault(event.about, []).append(event.step)
        elif i is not None and event.kind == "began":
            self.began |= {(step, i) for step in event.steps}
        elif i is None and event.kind == REFUSED:
            self.refusals[event.about, event.detail.partition(" has refused ")[0]] = event
        elif i is not None and event.kind in (LATE, SILENT, GONE, REFUSED):
            self.kinds[event.kind] += len(event.steps)
            j = self._estimates.get(event.about)
            if j is not None:
                self.pairs |= {(step, i, j) for step in event.steps}
            elif self._measurements.get(event.about) == i:
                self.measurements |= {(step, i) for step in event.steps}
                self.unheard |= {(step, i) for step in event.steps if event.kind != LATE}
