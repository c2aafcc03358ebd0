"""Trials of runs in lock-step."""

from __future__ import annotations

import random
from collections.abc import Callable
from functools import partial
from importlib.metadata import version

from agent.conform.judge import Difference
from agent.conform.trial import Setting, Trial
from agent.contract.messages import Estimate

BLOCK = 8  # steps that are given in order, and then as many of which all messages come before any is answered
LATER = "999999999"  # the last number of a version of this series that is later than any


def later(setting: Setting) -> str:
    """The same with messages of a later version, which have a field that no version has."""
    number = ".".join([*version("peakmesh").split(".")[:2], LATER])
    return whole(setting, also=f',"new":[1.5,{{"kind":"any"}}],"version":"{number}"'.encode())


def whole(setting: Setting, *, also: bytes = b"") -> str:
    """A run from its beginning to its end; returns what was compared."""
    with Trial(setting, also=also) as trial:
        trial.meet()
        trial.be_ready()
        trial.order("start")
        for first in range(0, trial.play.steps, BLOCK):
            _perform(trial, range(first, min(first + BLOCK, trial.play.steps)), ahead=first // BLOCK % 2 == 1)
            trial.acknowledge(first)
        trial.end("close")
        return f"{len(trial.sent)} estimates, bit for bit" if not setting.tolerance else f"{len(trial.sent)} estimates"


def stopped(setting: Setting) -> str:
    """The coordinator stops it after some steps."""
    with _some_steps(setting) as trial:
        trial.end("stop", reason="conform stops it")
        return f"code {trial.code} after it was stopped"


def interrupted(setting: Setting) -> str:
    with _some_steps(setting) as trial:
        trial.interrupt()
        return f"code {trial.code} after SIGTERM"


def deserted(setting: Setting) -> str:
    with _some_steps(setting) as trial:
        trial.vanish()
        return f"code {trial.code} after everybody was lost"


def namesake(setting: Setting) -> str:
    """Another process has its name, and the run begins with that one."""
    with Trial(setting) as trial:
        trial.meet()
        trial.be_ready()
        trial.cast_another()
        return f"code {trial.code} after another was cast"


def _some_steps(setting: Setting) -> Trial:
    trial = Trial(setting)
    try:
        trial.meet()
        trial.be_ready()
        trial.order("start")
        _perform(trial, range(BLOCK // 2), ahead=False)
    except BaseException:
        trial.__exit__(None, None, None)
        raise
    return trial


def _perform(trial: Trial, steps: range, *, ahead: bool) -> None:
    """Give what others say of these steps, and hold what the program says of them.

    In order: its neighbours tell of a step after it has. Or `ahead`: everything is there before it has told of the
    first, as where others are faster, each topic in order and the topics in any.
    """
    others = [name for name in trial.play.gains.problem.node_names if name != trial.node]
    topics: list[Callable[[int], None]] = [trial.give_mode, trial.give_measurement]
    topics += [partial(trial.give_estimate, name) for name in others]
    if ahead:
        order = [place for place in range(len(topics)) for _ in steps]
        random.Random(steps.start).shuffle(order)
        waiting = [iter(steps) for _ in topics]
        for place in order:
            topics[place](next(waiting[place]))
    for k in steps:
        if not ahead:
            trial.give_mode(k)
            trial.give_measurement(k)
        _hold(trial, k)
        if not ahead:
            for give in topics[2:]:
                give(k)


def _hold(trial: Trial, k: int) -> None:
    """The estimate of step k, against what must follow from those before."""
    trial.until(lambda: len(trial.told) > k, f"its estimate of step {k}")
    message, play, judge = trial.told[k], trial.play, trial.judge
    if not isinstance(message, Estimate):
        raise Difference(f"it publishes {type(message).__name__} in lock-step, where there is none", k)
    assert judge is not None
    y = play.measurements[trial.node][k].y
    if k == 0:
        wanted = judge.first(y)
    else:
        before, mode, lost = trial.told[k - 1], play.modes[k - 1].mode, play.lost(trial.node, k - 1)
        assert isinstance(before, Estimate)
        heard = {name: play.estimates[name][k - 1] for name in play.estimates.keys() - lost - {trial.node}}
        wanted = judge.following(before, mode, heard, y)
    judge.compare(message, wanted)
