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
        self._accounts: dict[str, Account] = {}
        self._telling = bus.channel(ACCOUNT)
        self._is_judged = False  # whether the nodes can follow

    def keep_time(self, tick: Callable[[int], None], *, first: int, recorded: int) -> None:
        """The modes from step `first` on, one a period; `tick` is called with each.

        Those from step `recorded` to `first` have been given out, but the recorder has not got them: once more.
        """
        problem, plan = self._gains.problem, self._plan
        faults = [parse(text, problem, steps=plan.steps) for text in plan.faults]
        ordeal = Ordeal(faults, COORDINATOR, begin=first)
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
        """RunBroken where most of what the nodes tell soon after the beginning was too late, though nobody wills it."""
        if self._is_judged or self._plan.faults:
            return
        accounts, nodes = list(self._accounts.values()), self._gains.problem.n
        if len(accounts) < nodes:
            return
        self._is_judged = True
        pairs, late = (sum(getattr(one, name) for one in accounts) for name in ("pairs", "pairs_substituted"))
        if late <= TOO_LATE * pairs:
            return
        of_node = sum(account.processor / (account.step + 1) for account in accounts) / nodes
        able = max(2.0 * self._pace.period, 2.0 * (nodes + 2) * of_node / (os.cpu_count() or 1))
        raise RunBroken(
            f"a period of {1e3 * self._pace.period:g} ms is shorter than this machine can hold: in {step + 1} steps "
            f"{late / pairs:.0%} of what nodes should have heard came too late; try --period {1e3 * able:.0f}ms"
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
