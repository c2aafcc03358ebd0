"""Trials of runs against the clock, in which messages and ticks are lost, and late.

The next tick comes once the program has told of the step before, and what is to be in time comes before its tick: so
how busy the machine is decides over nothing. What a program did hear it says itself; that is held against what it could
have heard, and its numbers against what it says.
"""

from __future__ import annotations

from collections import Counter
from enum import Enum, auto
from typing import NamedTuple

from agent.conform.judge import Difference
from agent.conform.trial import Setting, Trial
from agent.contract.keys import estimate, measurement
from agent.contract.messages import ZERO_STATE, Account, Estimate, Event

PERIOD = 0.5  # seconds: a lost measurement is waited for 0.2 s
LATE_STEP, LATE_NUMBER = 5, 7  # where a program joins a run that goes on, and the number of its first message
MOST = 0.5  # of what was there before its tick may be substituted: a busy machine is no fault of the program


class Fate(Enum):
    """What becomes of the messages of a step."""

    EARLY = auto()  # all there before the tick
    PROMPT = auto()  # all there after it
    UNMEASURED = auto()  # the measurement is lost
    MEASURED_LATE = auto()  # it comes after the estimate
    UNHEARD = auto()  # the first neighbour's estimate is lost
    HEARD_LATE = auto()  # it comes after the next estimate
    ALONE = auto()  # nobody is heard
    MISSED = auto()  # there is no tick


FATES = (
    [Fate.EARLY] * 3 + [Fate.UNMEASURED, Fate.PROMPT, Fate.UNHEARD, Fate.EARLY, Fate.MEASURED_LATE, Fate.HEARD_LATE]
    + [Fate.EARLY, Fate.ALONE, Fate.MISSED, Fate.EARLY, Fate.PROMPT, Fate.MISSED, Fate.ALONE, Fate.UNMEASURED]
    + [Fate.EARLY] * 7
)  # fmt: skip


class Lacked(NamedTuple):
    """A message that was substituted."""

    topic: str
    step: int


def paced(setting: Setting) -> str:
    """From the beginning."""
    with Trial(setting, period=PERIOD) as trial:
        trial.meet()
        trial.be_ready()
        trial.order("start")
        return _Clock(trial, first=0).run()


def joined_late(setting: Setting) -> str:
    """A run that goes on, as after the program's process was killed and started again."""
    with Trial(setting, period=PERIOD, first=LATE_NUMBER) as trial:
        trial.meet_underway(LATE_STEP)
        return _Clock(trial, first=LATE_STEP).run()


class _Clock:
    """The steps from `first` on, and what the program makes of them."""

    def __init__(self, trial: Trial, *, first: int) -> None:
        self.trial, self.play, self.node, self.first = trial, trial.play, trial.node, first
        self.given: set[Lacked] = set()  # what was sent, of messages
        self.lacked: list[Lacked] = []
        self.counts: Counter[str] = Counter()
        self.before: Estimate | None = None  # what it told of the step before; None where that had no tick
        self._read = 0  # of what the program has said

    def run(self) -> str:
        late: list[Lacked] = []
        for k in range(self.first, self.play.steps):
            fate = FATES[k]
            if fate is Fate.MISSED:
                self.before = None
                continue
            withheld = self._withheld(k, fate)
            if fate is not Fate.PROMPT:
                self._give(k, withheld)
            self.trial.give_mode(k)
            if fate is Fate.PROMPT:
                self._give(k, withheld)
            message = self._estimate(k)
            self._judge(k, message)
            self.before = message
            if fate is Fate.MEASURED_LATE:
                self.trial.give_measurement(k)
            for topic, step in late:
                self.trial.give_estimate(topic.split("/")[1], step)
            late = [lacked for lacked in withheld if fate is Fate.HEARD_LATE]
        account = self._account()
        self._refuse_silence()
        self._audit(account)
        self._refuse_idleness()
        self.trial.end("close")
        used = self.counts["pairs"] - sum(lacked.topic != measurement(self.node) for lacked in self.lacked)
        return f"{self.counts['steps']} estimates, {used} of {self.counts['pairs']} pairs used"

    def _wanted(self, k: int) -> list[str]:
        links = self.trial.own.links[self.play.modes[k].mode]
        lost = self.play.lost(self.node, k)
        return [link.sender for link in links if link.sender != self.node and link.sender not in lost]

    def _withheld(self, k: int, fate: Fate) -> set[Lacked]:
        heard = [Lacked(estimate(name), k) for name in self._wanted(k)]
        if fate in (Fate.UNMEASURED, Fate.MEASURED_LATE):
            return {Lacked(measurement(self.node), k)}
        if fate in (Fate.UNHEARD, Fate.HEARD_LATE):
            return set(heard[:1])
        return set(heard) if fate is Fate.ALONE else set()

    def _give(self, k: int, withheld: set[Lacked]) -> None:
        if (own := Lacked(measurement(self.node), k)) not in withheld:
            self.trial.give_measurement(k)
            self.given.add(own)
        for name in self.play.estimates.keys() - {self.node}:
            if (lacked := Lacked(estimate(name), k)) not in withheld:
                self.trial.give_estimate(name, k)
                self.given.add(lacked)

    def _next(self, kind: type, what: str) -> Estimate | Account:
        """The next of the program's messages of a kind; events are noted on the way."""
        while True:
            self.trial.until(lambda: len(self.trial.told) > self._read, what)
            message = self.trial.told[self._read]
            self._read += 1
            if isinstance(message, kind):
                assert isinstance(message, Estimate | Account)
                return message
            if isinstance(message, Estimate):
                raise Difference(f"it tells of step {message.step} where {what} was due", message.step)

    def _estimate(self, k: int) -> Estimate:
        message = self._next(Estimate, f"its estimate of step {k}")
        assert isinstance(message, Estimate)
        return message

    def _account(self) -> Account:
        while True:
            account = self._next(Account, "its account of the whole run")
            assert isinstance(account, Account)
            if account.step == self.play.steps - 1:
                return account

    # What it says of a step.
    def _judge(self, k: int, message: Estimate) -> None:
        judge = self.trial.judge
        assert judge is not None
        y = self.play.measurements[self.node][k].y
        if message.measured and Lacked(measurement(self.node), k) not in self.given:
            raise _said(k, "measured", True, False, "there was no measurement in time")
        self.counts["steps"] += 1
        self.counts["pairs"] += len(self._wanted(k))
        if k and self.before is None:
            judge.compare(message, self._beginning(k, message))
            return
        if message.origin:
            raise _said(k, "origin", message.origin, "", "it has an estimate of its own")
        if not message.measured:
            self.lacked.append(Lacked(measurement(self.node), k))
        if self.before is None:
            judge.compare(message, judge.first(y if message.measured else None))
            return
        heard = self._heard(k - 1, message)
        judge.compare(
            message,
            judge.following(self.before, self.play.modes[k - 1].mode, heard, y if message.measured else None),
        )

    def _beginning(self, k: int, message: Estimate) -> Estimate:
        """Where there was no tick in the step before."""
        there = [name for name in self._wanted(k) if Lacked(estimate(name), k) in self.given]
        judge = self.trial.judge
        assert judge is not None
        if message.origin in there:
            return judge.beginning(k, self.play.estimates[message.origin][k].x_hat, message.origin)
        if message.origin == ZERO_STATE:
            return judge.beginning(k, [0.0] * len(message.x_hat), ZERO_STATE)
        wanted = " or ".join([*there, ZERO_STATE])
        raise _said(k, "origin", message.origin, wanted, f"it had no tick of step {k - 1}, so it begins again")

    def _heard(self, k: int, message: Estimate) -> dict[str, Estimate]:
        """Whose messages of step k it has used, by what it says; Difference where that cannot be."""
        wanted = self._wanted(k)
        possible = [name for name in wanted if Lacked(estimate(name), k) in self.given]
        said = set(message.heard)
        if not {self.node} <= said <= {self.node, *possible}:
            why = f"of step {k} nobody else was to be heard, or in time"
            raise _said(message.step, "heard", message.heard, sorted([self.node, *possible]), why)
        self.lacked += [Lacked(estimate(name), k) for name in wanted if name not in said]
        return {name: self.play.estimates[name][k] for name in said - {self.node}}

    # What it says of all.
    def _refuse_silence(self) -> None:
        """Every substitution has a reason."""
        events = [event for event in self.trial.told if isinstance(event, Event)]
        told = {Lacked(event.about, step) for event in events for step in event.steps}
        for topic, step in self.lacked:
            if (topic, step) not in told:
                raise Difference(f"no event of it says why {topic} of step {step} was substituted", step, "event")

    def _audit(self, account: Account) -> None:
        """The account is that of the run."""
        pairs = sum(lacked.topic != measurement(self.node) for lacked in self.lacked)
        untold = sum(len(self._wanted(k)) for k in range(self.first, self.play.steps) if self._is_untold(k))
        for field, least, most in (
            ("steps", self.counts["steps"], self.counts["steps"]),
            ("pairs", self.counts["pairs"], self.counts["pairs"]),
            ("pairs_substituted", pairs, pairs + untold),
            ("measurements_substituted", len(self.lacked) - pairs, len(self.lacked) - pairs),
        ):
            value = getattr(account, field)
            if not least <= value <= most:
                raise _said(account.step, f"account.{field}", value, least, "")

    def _refuse_idleness(self) -> None:
        """Most of what was there was used."""
        early = {lacked for lacked in self.given if FATES[lacked.step] is Fate.EARLY and self._counts(lacked)}
        idle = len(early & set(self.lacked))
        if idle > MOST * len(early):
            says = f"it substituted {idle} of {len(early)} messages that were there before their tick"
            raise Difference(says, field="heard")

    def _is_untold(self, k: int) -> bool:
        """Whether no estimate tells what became of the pairs of a step: none was made of them, or it was given up."""
        return FATES[k] is not Fate.MISSED and (k + 1 == self.play.steps or FATES[k + 1] is Fate.MISSED)

    def _counts(self, lacked: Lacked) -> bool:
        """Whether it was to use a message."""
        name = lacked.topic.split("/")[1]
        return lacked.topic == measurement(self.node) or name in self._wanted(lacked.step)


def _said(k: int, field: str, value: object, wanted: object, why: str) -> Difference:
    return Difference(
        f"step {k}: {field} is {value}, must be {wanted}{f': {why}' if why else ''}", k, field, value, wanted
    )
