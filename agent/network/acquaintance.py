"""What the coordinator knows of those who join: their versions, where they listen, and whom they lack. Pure.

A run begins once everybody has met everybody. Where two cannot meet, these two are named, and not whoever happens to
lose patience first.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from agent.contract.errors import InputError, counted
from agent.contract.keys import in_words
from agent.contract.messages import Joining
from agent.network.addresses import NONE, reaches_other_machines


class Acquaintance:
    """Those who have said that they are there; `own` is what the coordinator would say."""

    def __init__(self, own: Joining) -> None:
        self._own = own
        self._told: dict[str, Joining] = {}  # by name, the last

    def heed(self, joining: Joining) -> str:
        """Take in what somebody says; a warning, or "". Raises InputError where the run cannot be."""
        is_new = joining.who not in self._told
        self._told[joining.who] = joining
        refuse_version(joining.who, joining.version, own=self._own.version)
        for one, other in self._strangers():
            if self._never_meet(one, other):
                raise InputError(self._pair(one, other))
        return self._warning(joining) if is_new else ""

    def strangers(self, unready: Iterable[str], *, seconds: float) -> str:
        """Why those who are there are not ready after so long: which two have no link."""
        pairs = list(self._strangers())
        if not pairs:
            names = " and ".join(map(in_words, sorted(unready)))
            return f"{names} reached the coordinator, but had not met everybody within {seconds:g} s"
        more = f"; the same holds for {counted(len(pairs) - 1, 'more pair')}" if len(pairs) > 1 else ""
        return f"after {seconds:g} s {self._pair(*pairs[0])}{more}"

    def _strangers(self) -> Iterator[tuple[Joining, Joining]]:
        """Pairs of those who are there of which one lacks the other; each once."""
        seen = set[frozenset[str]]()
        for one in self._told.values():
            for name in one.lacks:
                other = self._told.get(name)
                if other is not None and frozenset((one.who, name)) not in seen:
                    seen.add(frozenset((one.who, name)))
                    yield one, other

    @staticmethod
    def _never_meet(one: Joining, other: Joining) -> bool:
        """Whether no link can be: they are on different machines, and one of them listens on its own alone."""
        apart = "" not in (one.machine, other.machine) and one.machine != other.machine
        if not apart or NONE in (one.listen, other.listen):
            return False
        return not (reaches_other_machines(one.listen) and reaches_other_machines(other.listen))

    @staticmethod
    def _pair(one: Joining, other: Joining) -> str:
        where = f"{in_words(one.who)} listens at {one.listen}, {in_words(other.who)} at {other.listen}"
        cure = "each must listen where the other can connect to, such as --listen tcp/0.0.0.0:0"
        return (
            f"{in_words(one.who)} and {in_words(other.who)} have reached the coordinator, but have no link between "
            f"them: {where}; {cure}, or one take part through the coordinator, --listen none"
        )

    def _warning(self, joining: Joining) -> str:
        name, own = in_words(joining.who), self._own
        if joining.version != own.version:
            return f"{name} is peakmesh {joining.version}, the coordinator {own.version}"
        if joining.lease < own.lease:
            return (
                f"{name} gives up a link after {joining.lease:g} s of silence, the coordinator after {own.lease:g} s: "
                "give everybody the same --deadline"
            )
        return ""


def refuse_version(who: str, version: str, *, own: str) -> None:
    """Raise InputError where two versions do not go together: those do whose first two numbers are the same."""
    if version.split(".")[:2] != own.split(".")[:2]:
        raise InputError(f"{in_words(who)} is peakmesh {version or 'of unknown version'}, this is {own}: update one")


def stray_sensor(who: str) -> str:
    """What is wrong with somebody who is there and whom nobody expects; "" where it is no sensor."""
    kind, _, node = who.partition("-")
    if kind != "sensor":
        return ""
    return (
        f"{in_words(who)} is there, but the run was started without --external {node}: the simulated plant measures "
        "for its node, too"
    )
