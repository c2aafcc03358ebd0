"""The coordinator's clock in a paced run: a mode when it is due, and at the end the nodes' accounts."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from itertools import islice
from typing import Any

from agent.contract.errors import RunBroken
from agent.contract.gains import Gains
from agent.contract.keys import ACCOUNT, COORDINATOR, MODE, RECORDER, node_who
from agent.contract.messages import Account, Mode
from agent.contract.schedule import modes
from agent.faults import Ordeal, parse
from agent.network.bus import Bus
from agent.network.words import Incoming
from agent.pacing.beat import Beat
from agent.plan import Plan
from agent.roles.suffering import suffer

TOO_LATE = 0.5  # part of all pairs; a run with more of them is none
BUSY = 0.5  # part of a period that all processors are at work on a step; where they are less, they are not too slow
LISTEN_SECONDS = 0.05  # after so long without a word, it looks for accounts
ACCOUNT_SECONDS = 5.0  # after the last step the nodes have so long to tell how it went


class Timekeeper:
    """Gives out the modes. `heed` takes what is heard meanwhile, `stood` is told of a clock that stood still."""

    def __init__(
        self, bus: Bus, gains: Gains, plan: Plan, *, heed: Callable[[Incoming], None], stood: Callable[[float], None]
    ) -> None:
        assert plan.pace is not None
        self._bus, self._gains, self._plan, self._pace = bus, gains, plan, plan.pace
        self._heed, self._stood = heed, stood
        self._first_accounts: dict[str, Account] = {}
        self._accounts: dict[str, Account] = {}  # the last of each
        self._telling = bus.channel(ACCOUNT)
        self._is_judged = False  # whether the nodes can follow

    def keep_time(self, tick: Callable[[int], None], *, first: int, recorded: int, again: bool) -> None:
        """The modes from step `first` on, one a period; `tick` is called with each.

        Those from step `recorded` to `first` have been given out, but the recorder has not got them: once more.
        `again`: by a coordinator before this one.
        """
        problem, plan = self._gains.problem, self._plan
        faults = [parse(text, problem, steps=plan.steps) for text in plan.faults]
        ordeal = Ordeal(faults, COORDINATOR, begin=first, again=again)
        beat = Beat(period=self._pace.period, begin=time.monotonic() + self._pace.period, first=first)
        chain = islice(modes(problem, seed=plan.seed), recorded, plan.steps)
        for step, mode in enumerate(chain, recorded):
            if step >= first:
                self._listen(beat.due(step))
                suffer(ordeal.due(step))
                if stood := beat.catch_up(step, time.monotonic()):
                    self._stood(stood)
            self._bus.publish(MODE, Mode(step=step, mode=problem.mode_names[mode]))
            tick(step)
            self._hear_accounts()  # what is not taken holds memory, and in the end its link
            self._refuse_haste(step)
        self._listen(time.monotonic() + self._pace.period + ACCOUNT_SECONDS, until=self._all_told)

    def pacing(self) -> dict[str, Any]:
        """What the nodes have told of themselves, together: counts are sums, latencies the worst node's."""
        accounts = list(self._accounts.values())
        sums = ("pairs", "pairs_substituted", "measurements_substituted", "late")
        worst = [f"to_{what}_{which}" for what in ("estimate", "step") for which in ("median", "p99", "max")]
        return {
            "period": self._pace.period,
            "accounts": sorted(self._accounts),
            **{name: sum(getattr(account, name) for account in accounts) for name in sums},
            **{name: max((getattr(account, name) for account in accounts), default=None) for name in worst},
        }

    def _refuse_haste(self, step: int) -> None:
        """RunBroken where most of what the nodes tell soon after the beginning was too late, though nobody wills it.

        And where that is for want of processors: while the network or somebody is out, they have nothing to do.
        """
        before, after, nodes = self._first_accounts, self._accounts, self._gains.problem.n
        if self._is_judged or self._plan.faults or len(before) < nodes:
            return
        told = [(before[who], after[who]) for who in before]
        if any(one.step == other.step for one, other in told):
            return
        self._is_judged = True
        steps, pairs, late, processor = (
            [getattr(other, name) - getattr(one, name) for one, other in told]
            for name in ("step", "pairs", "pairs_substituted", "processor")
        )
        if min(steps) < 0 or min(pairs) < 0 or sum(late) <= TOO_LATE * sum(pairs):
            return
        of_node = sum(seconds / made for seconds, made in zip(processor, steps, strict=True)) / nodes
        needed = (nodes + 2) * of_node / (os.cpu_count() or 1)  # s a step, if plant and recorder need as much
        if needed < BUSY * self._pace.period:
            return
        able = max(2.0 * self._pace.period, 2.0 * needed)
        raise RunBroken(
            f"a period of {1e3 * self._pace.period:g} ms is shorter than this machine can hold: of the first "
            f"{step + 1} steps {sum(late) / sum(pairs):.0%} of what nodes should have heard came too late, and a step "
            f"takes {1e3 * needed:.2g} ms of all its processors; try --period {1e3 * able:.0f}ms"
        )

    def _listen(self, deadline: float, *, until: Callable[[], bool] = lambda: False) -> None:
        """Heed what is said until the deadline, which nothing delays, or until something holds."""
        while not until() and (left := deadline - time.monotonic()) > 0.0:
            word = self._bus.receive(timeout=min(left, LISTEN_SECONDS))
            if word is not None:
                self._heed(word)

    def _all_told(self) -> bool:
        """Whether every node that is there has given account, and the recorder is there to record it."""
        self._hear_accounts()
        there = self._bus.present & set(map(node_who, self._gains.problem.node_names))
        told = {who for who, account in self._accounts.items() if account.step == self._plan.steps - 1}
        return RECORDER in self._bus.present and there <= told

    def _hear_accounts(self) -> None:
        for admitted in self._telling.waiting():
            if isinstance(account := admitted.message, Account):
                self._accounts[account.who] = account
                self._first_accounts.setdefault(account.who, account)
