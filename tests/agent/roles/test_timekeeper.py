"""The coordinator's clock, with a bus that says what the test wants."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest

from agent.contract.errors import RunBroken
from agent.contract.gains import Gains
from agent.contract.messages import Account, Mode
from agent.network.gate import Admitted
from agent.plan import Pace, Plan
from agent.roles.timekeeper import Timekeeper

PACE = Pace(0.001)


class Wire:
    """Bus and channel in one: hears the accounts it was given, and takes what is published."""

    def __init__(self, accounts: list[Account]) -> None:
        self.sent: list[Mode] = []
        self.more: list[Account] = []  # that come with every step
        self.most = 0  # that have waited
        self.present = {"recorder"}
        self._accounts = accounts

    def channel(self, topic: str) -> Wire:
        assert topic == "account"
        return self

    def waiting(self) -> Iterator[Admitted]:
        while self._accounts:
            account = self._accounts.pop()
            yield Admitted("account", account.encode(), None, account)

    def publish(self, topic: str, message: Mode) -> None:
        assert topic == "mode"
        self.sent.append(message)
        self.most = max(self.most, len(self._accounts))
        self._accounts += self.more

    def receive(self, *, timeout: float) -> None:
        return None


def account(who: str, *, substituted: int, step: int = 30) -> Account:
    names = [f"to_{what}_{which}" for what in ("estimate", "step") for which in ("median", "p99", "max")]
    counts = {"steps": 31, "pairs": 100, "pairs_substituted": substituted, "measurements_substituted": 0, "late": 0}
    times: dict[str, Any] = dict.fromkeys(names, 0.01)
    return Account(who=who, step=step, processor=0.31, **counts, **times)


def kept(
    gains: Gains,
    accounts: list[Account],
    *,
    first: int = 0,
    recorded: int = 0,
    steps: int = 5,
    more: list[Account] | None = None,
    faults: tuple[str, ...] = (),
) -> Wire:
    wire = Wire(accounts)
    wire.more = more or []
    plan = Plan(steps, seed=1, pace=PACE, faults=faults)
    keeper = Timekeeper(wire, gains, plan, heed=lambda word: None, stood=lambda seconds: None)  # type: ignore[arg-type]
    keeper.keep_time(lambda step: None, first=first, recorded=recorded, again=first > 0)
    return wire


def everybody(gains: Gains, **facts: int) -> list[Account]:
    return [account(f"node-{name}", **facts) for name in gains.problem.node_names]


def test_who_goes_on_gives_out_the_same_chain(gains: Gains) -> None:
    """From any step on, and once more what the recorder has not got."""
    whole = kept(gains, [], steps=40).sent
    assert [mode.step for mode in whole] == list(range(40))
    assert kept(gains, [], first=23, recorded=20, steps=40).sent == whole[20:]


def second(accounts: list[Account], *, late: int, processor: float) -> list[Account]:
    """What the same nodes tell a hundred steps later, of which `late` pairs in a hundred were late."""
    return [
        one.model_copy(
            update={
                "step": one.step + 100,
                "pairs": one.pairs + 100,
                "pairs_substituted": one.pairs_substituted + late,
                "processor": one.processor + processor,
            }
        )
        for one in accounts
    ]


def test_a_period_that_is_too_short_is_refused_with_one_that_is_not(gains: Gains) -> None:
    accounts = everybody(gains, substituted=80)
    with pytest.raises(RunBroken) as caught:
        kept(gains, [*second(accounts, late=80, processor=1.0), *accounts])  # the last is the first to be taken
    sentence = str(caught.value)
    assert sentence.startswith("a period of 1 ms is shorter than this machine can hold: of the first 1 steps 80% of ")
    assert int(sentence.rpartition("--period ")[2].removesuffix("ms")) >= 2


@pytest.mark.parametrize(("late", "processor"), [(0, 1.0), (50, 1.0), (100, 0.001)])
def test_a_period_that_is_long_enough_is_not(gains: Gains, late: int, processor: float) -> None:
    """Where everything is late, and nobody has anything to do, something else is out than the machine."""
    accounts = everybody(gains, substituted=100)  # what was late at the beginning is nobody's measure
    assert len(kept(gains, [*second(accounts, late=late, processor=processor), *accounts]).sent) == 5


def test_one_node_that_is_late_does_not_make_a_period_too_short(gains: Gains) -> None:
    accounts = everybody(gains, substituted=0)
    later = second(accounts, late=0, processor=1.0)
    later[0] = second(accounts[:1], late=100, processor=1.0)[0]
    assert len(kept(gains, [*later, *accounts]).sent) == 5


def test_a_node_that_counts_anew_is_no_measure(gains: Gains) -> None:
    accounts = everybody(gains, substituted=0)
    later = second(accounts, late=100, processor=1.0)
    later[0] = later[0].model_copy(update={"pairs": 1, "pairs_substituted": 1, "processor": 0.01})
    assert len(kept(gains, [*later, *accounts]).sent) == 5


@pytest.mark.parametrize("faults", [(), ("drop:probability=0.1",)])
def test_accounts_do_not_pile_up(gains: Gains, faults: tuple[str, ...]) -> None:
    """They come now and then for as long as a run takes; one that is not taken holds the memory that it came in."""
    more = everybody(gains, substituted=0)
    assert kept(gains, [], steps=20, more=more, faults=faults).most <= len(more)
