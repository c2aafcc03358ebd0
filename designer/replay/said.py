"""What the events of a run say of messages that were refused, or not there in time, and of who was away."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping

import numpy as np

from agent.contract.keys import PLANT, PLANT_STATE, estimate, measurement, node_who
from agent.contract.messages import GONE, LATE, REFUSED, SILENT, Account, Event
from designer.replay.central import Flags
from designer.replay.topics import Columns, Numbers, Topic

_NEAR = 2  # steps between somebody's last message and the event that says they are gone, beside the silence itself


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
        self._nodes = {node_who(name): i for i, name in enumerate(node_names)}
        self._estimates = {estimate(name): i for i, name in enumerate(node_names)}
        self._measurements = {measurement(name): i for i, name in enumerate(node_names)}

    def is_node(self, who: str) -> bool:
        return who in self._nodes

    def account(self, account: Account) -> None:
        i = self._nodes.get(account.who)
        if i is not None and account.step >= self.accounted(i):
            self.accounts[i] = account

    def accounted(self, i: int) -> int:
        """The last step that a node has given account of; -1 where it has of none."""
        return self.accounts[i].step if i in self.accounts else -1

    def add(self, event: Event) -> None:
        self.events += 1
        i = self._nodes.get(event.who)
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


def excused(
    topics: Mapping[str, Topic],
    columns: Columns,
    said: Said,
    external: tuple[bool, ...],
    steps: int,
    *,
    plant_is_whole: bool,
) -> Flags:
    """(steps, topics): which messages are not there because nobody was there to send them.

    A node that begins again says so; for the plant, and for a node that never came back, the coordinator has said
    that it was gone, or, where it was gone itself, the nodes that they heard nothing of it. A node to which the last
    modes did not come has not given its last account. The plant that was asked to go, or stood still as the run ended,
    has not come to the last steps where all that it is known to have sent is there, `plant_is_whole`. A sensor's
    measurement may be missing wherever its node says that it had none.
    """
    has = columns["has"][:steps]
    found = np.zeros_like(has)
    for who, i in said._nodes.items():
        place, told, origin = 2 + 2 * i, columns["told"][:steps, i], columns["origin"][:steps, i]
        for first, end in _gaps(has[:, place]):
            comes_back = end < len(has) and origin[end] != -1
            waited = end == len(has) and said.accounted(i) < first  # for modes that did not come, to the end
            found[first:end, place] = comes_back or waited or _went(said.gone.get(who, []), first, end)
        if external[i]:
            found[:, place + 1] = ~has[:, place] | (told == 0)
    simulated = [topic for topic in topics.values() if topic.who == PLANT or topic.topic == PLANT_STATE]
    for topic in simulated:
        for first, end in _gaps(has[:, topic.place]):
            found[first:end, topic.place] = _went(said.gone.get(PLANT, []), first, end)
            found[first:end, topic.place] |= plant_is_whole and end == len(has)
            found[_broken_off(has, said), topic.place] = True
    return found


def _broken_off(has: Flags, said: Said) -> Flags:
    """(steps,): at which the plant's state is not there, nor some measurements, and their nodes say they never came.

    A node that is not there in such a step either says nothing.
    """
    unheard = np.zeros((len(has), len(said._nodes)), dtype=bool)
    for step, i in said.unheard:
        if step < len(has):
            unheard[step, i] = True
    estimates = 2 + 2 * np.arange(len(said._nodes))
    unheard &= ~has[:, estimates + 1]
    missed = ~has[:, estimates + 1] & ~has[:, estimates]
    explained = unheard | has[:, estimates + 1] | ~has[:, estimates]
    return np.asarray((unheard | missed).any(axis=1) & explained.all(axis=1) & ~has[:, 1])


def _went(steps: list[int], first: int, end: int) -> bool:
    return any(first - _NEAR <= step < end + _NEAR for step in steps)


def _gaps(there: Flags) -> list[tuple[int, int]]:
    """The first step of each stretch that is not there, and the step after its last."""
    edges = np.diff(np.concatenate([[True], there, [True]]).astype(np.int8))
    first: Numbers = np.flatnonzero(edges == -1)
    return list(zip(first.tolist(), np.flatnonzero(edges == 1).tolist(), strict=True))
