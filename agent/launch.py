"""Starts every role as a process of its own on this machine, forwards signals, collects exits.

A child's standard input is a pipe that the launcher holds open: its end tells the child that the launcher is gone.
Children have sessions of their own, so Ctrl-C reaches the launcher alone, which has the coordinator end the run in
order. Started with SIGINT ignored, it leaves that so, and its children inherit it; SIGTERM ends the run all the same.
"""

from __future__ import annotations

import json
import shlex
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import partial
from pathlib import Path
from types import FrameType
from typing import Any

from agent.children import LARGEST, Child, Nursery
from agent.contract.errors import EXIT_INPUT, InputError, Interrupted, RunBroken
from agent.contract.gains import Gains
from agent.contract.keys import COORDINATOR, PLANT, RECORDER, in_words, node_who
from agent.contract.recording import parts
from agent.guests import Guests, Program, programs
from agent.plan import Plan, RecordingPlan
from agent.signals import heed, restore

RECORDER_SECONDS = 60.0  # after the coordinator has gone, the recorder has so long to close before it is killed
MOST_REVIVALS, REVIVAL_SECONDS = 3, 10.0  # a role of a paced run is started again so often in so many seconds
FAREWELL_SECONDS = 1.0  # after the recorder has gone, the others have so long
GUEST_SECONDS = 10.0  # and guests


def launch(
    gains_path: Path,
    gains: Gains,
    plan: Plan,
    *,
    run: str,
    recording: Path,
    force: bool,
    wait: float,
    report: Callable[[dict[str, Any]], None],
    recording_plan: RecordingPlan | None = None,
    keys: Path | None = None,
    guests: Guests | None = None,
) -> dict[str, Any]:
    """Run everything on this machine; returns the coordinator's summary. `report` gets its words as they come.

    With `keys`, a folder of certificates, nobody else can take part. `guests` are started in place of our own roles.

    Raises what the run ended with: RunBroken, Interrupted, or InputError. No process is left behind. A run that went
    on to its end without a recording, as the plan allows, has the reason in its summary as `broken_off`.
    """
    began, guests = time.time(), guests or {}
    if PLANT in guests and plan.needs_no_plant(gains.problem):
        raise InputError("the plant is yours, but none takes part in a paced run where every node has a sensor")
    common = [str(gains_path), "--run", run, "--wait", str(wait), "--deadline", str(plan.deadline), "--child"]
    common += ["--keys", str(keys)] if keys is not None else []
    commands = {COORDINATOR: ["coordinator", *common, *_plan_options(plan), *(["--hosts"] if guests else [])]}
    commands |= {node_who(name): ["node", "--node", name, *common] for name in gains.problem.node_names}
    if not plan.needs_no_plant(gains.problem):
        commands[PLANT] = ["plant", *common]
    options = _recorder_options(recording_plan or RecordingPlan(), force=force)
    commands[RECORDER] = ["recorder", *common, "--output", str(recording), *options]
    invite = partial(programs, guests, run=run, gains=str(gains_path))
    with _Crew(invite, survives=plan.pace is not None, by_sockets=keys is None) as crew:
        for who in (who for who in commands if who not in guests):
            crew.start(who, commands[who])
        summary: dict[str, Any] = {}
        for word in crew.words_of_coordinator():
            if "listening" in word:
                crew.tell_address(word["listening"][0])
            elif "started" in word:
                crew.started = True
                summary.setdefault("start_seconds", word["started"] - began)
            elif "ending" in word:
                crew.survives = False  # whoever ends now is not needed any more
            elif "summary" in word:
                summary |= word["summary"]
            report(word)
        crew.wait()
        try:
            crew.raise_what_happened(finished="steps" in summary)
        except RunBroken as error:
            kept = parts.files_of(recording)
            if crew.started and kept:
                error.args = (f"{error}; what was recorded is in {parts.in_words(kept)}",)
            raise
        for sentence in crew.doubts():
            report({"warning": sentence})
    if "steps" not in summary:
        raise RunBroken("the coordinator ended without a summary")
    return summary


def _plan_options(plan: Plan) -> list[str]:
    options = ["--steps", plan.steps, "--seed", plan.seed, "--window", plan.window]
    for node in plan.external:
        options += ["--external", node]
    if plan.pace is not None:
        period, measure_by, hear_by = plan.pace
        options += ["--period", period, "--measure-by", measure_by, "--hear-by", hear_by]
    for fault in plan.faults:
        options += ["--fault", fault]
    return [str(option) for option in options]


def _recorder_options(plan: RecordingPlan, *, force: bool) -> list[str]:
    options = ["--on-record-failure", "continue" if plan.goes_on else "stop", *(["--force"] if force else [])]
    if plan.split_size is not None:
        options += ["--split-size", str(plan.split_size)]
    if plan.split_seconds is not None:
        options += ["--split-duration", str(plan.split_seconds)]
    return options


class _Crew:
    """The processes of one run. Where it `survives`, who ends early is started again."""

    def __init__(self, invite: Callable[..., dict[str, Program]], *, survives: bool, by_sockets: bool) -> None:
        """Roles meet at Unix sockets that they know, or are told where the coordinator listens.

        `invite` says what guests to start, once there is an address.
        """
        self._invite, self._guests = invite, dict[str, Program]()
        self.started, self.survives, self._by_sockets = False, survives, by_sockets
        self._commands: dict[str, list[str]] = {}
        self._address = ""  # of the coordinator
        self._revived: dict[str, list[float]] = {}  # when
        self._children: dict[str, Child] = {}
        self._signal: int | None = None
        self._failed: str | None = None  # who ended badly before the run had started
        self._nursery = Nursery()
        self._before = heed(self._on_signal)

    def start(self, who: str, command: list[str]) -> None:
        self._commands[who] = command
        if who in self._guests:
            self._children[who] = self._nursery.host(*self._guests[who])
        else:
            arguments = [*command, *(["--sockets", str(self._nursery.folder)] if self._by_sockets else [])]
            self._children[who] = self._nursery.start(arguments, wants_output=who == COORDINATOR)
        if self._signal is not None:  # it came before there was anybody to pass it on to
            self._end_run(self._signal)

    def words_of_coordinator(self) -> Iterator[dict[str, Any]]:
        """The lines of the coordinator's stdout, until it ends for good."""
        while True:
            coordinator = self._children[COORDINATOR]
            yield from map(json.loads, self._lines_of(coordinator))
            self._nursery.wait(coordinator)
            assert coordinator.code is not None
            if coordinator.code >= 0 or not self._revive(COORDINATOR):  # it ends by itself where the run is over
                return

    def _lines_of(self, child: Child) -> Iterator[bytes]:
        """What it says, heeding meanwhile who ends."""
        assert child.output is not None
        rest = b""
        while True:
            self._heed_exits()
            if not self._nursery.watch(child.output):
                continue
            if not (said := child.output.read(LARGEST)):
                return
            *lines, rest = (rest + said).split(b"\n")
            yield from lines

    def tell_address(self, address: str) -> None:
        """Where the coordinator listens, and is to listen when it comes back; everybody is told who is not told yet."""
        if not self._address:
            self._address = address
            self._commands[COORDINATOR] += ["--listen", address]
            for who in self._children:
                self._tell(who)
            self._guests = self._invite(address=address)
            for who, guest in self._guests.items():
                self.start(who, guest.words)

    def _tell(self, who: str) -> None:
        if who != COORDINATOR and who not in self._guests and not self._by_sockets:
            with suppress(BrokenPipeError):  # it has ended already
                self._children[who].stdin.write(f"{self._address}\n".encode())

    def _revive(self, who: str) -> bool:
        """Start somebody again who has ended; False where that is not to be, or has been tried too often."""
        times = [time.monotonic(), *self._revived.get(who, [])]
        if not (self.started and self.survives) or self._signal is not None:
            return False
        if len(times) > MOST_REVIVALS and times[0] - times[MOST_REVIVALS] < REVIVAL_SECONDS:
            return False
        self._revived[who] = times
        self._children[who].close()
        self.start(who, self._commands[who])
        self._tell(who)
        return True

    def wait(self) -> None:
        """Until all have ended, the recorder first; who lingers is killed, at once where nothing was recorded yet."""
        if self.started:
            self._wait_or_kill(self._children[RECORDER], RECORDER_SECONDS)
        now = time.monotonic()
        for who, child in self._children.items():
            seconds = GUEST_SECONDS if who in self._guests else FAREWELL_SECONDS
            self._wait_or_kill(child, now + (seconds if self.started else 0.0) - time.monotonic())

    def _wait_or_kill(self, child: Child, seconds: float) -> None:
        if not self._nursery.wait(child, seconds):
            self._nursery.kill(child)
            self._nursery.wait(child)

    def raise_what_happened(self, *, finished: bool) -> None:
        """`finished`: the coordinator has given its summary."""
        coordinator = self._children[COORDINATOR]
        code = coordinator.code
        if self._signal is not None:
            raise Interrupted(self._signal)
        if self._failed is not None:
            child, words = self._children[self._failed], f"{in_words(self._failed)} ended before the run had started"
            if self._failed in self._guests:
                raise RunBroken(f"{words}: {self._end_of(self._failed)}")
            self._raise(child, words)
        if code != 0 and not finished:
            self._raise(coordinator, "the coordinator ended without a word")

    def _raise(self, child: Child, otherwise: str) -> None:
        code, words = child.code, child.last_words()
        if code is not None and code < 0:
            raise RunBroken(f"{otherwise}: killed by {signal.Signals(-code).name}")
        raise (InputError if code == EXIT_INPUT else RunBroken)(f"{words or otherwise}{self._cause(words)}")

    def doubts(self) -> Iterator[str]:
        """What is not as it should be with guests, though the run has ended well."""
        for who in self._guests:
            if self._children[who].code:
                yield f"{in_words(who)} did not end well: {self._end_of(who)}"

    def _end_of(self, who: str, words: str = "") -> str:
        """How a guest has ended; what it said, where that is not in `words`."""
        child, how = self._children[who], ""
        if child.was_killed and child.code == -signal.SIGKILL:
            how = "had not ended, and was killed"
        elif child.code is not None:
            how = f"ended with code {child.code}" if child.code >= 0 else f"died of {signal.Signals(-child.code).name}"
        said = child.last_words()
        return (
            f"its command, {shlex.join(self._commands[who])}, {how}{f', and said: {said}' if said not in words else ''}"
        )

    def _cause(self, words: str) -> str:
        """The last words of the child that the coordinator's `words` call lost."""
        for who, child in self._children.items():
            own = child.last_words()
            if who in self._guests and in_words(who) in words:
                return f"; {self._end_of(who, words)}"
            if who != COORDINATOR and in_words(who) in words and child.code and own and own not in words:
                return f"; it said: {own}"
        return ""

    def _on_signal(self, number: int, frame: FrameType | None) -> None:
        if self._signal is not None:  # asked twice: at once
            for child in self._children.values():
                self._nursery.kill(child)
        self._signal = self._signal or number
        self._end_run(number)

    def _heed_exits(self) -> None:
        """Start again who has ended, where that is to be; before the start, whoever fails ends the run."""
        ended = [who for who, child in self._children.items() if who != COORDINATOR and child.code is not None]
        if self.started and self.survives:
            for who in ended:
                self._revive(who)
        elif not self.started and self._failed is None and self._children[COORDINATOR].code is None:
            bad = [who for who in ended if self._children[who].code or who in self._guests]
            self._failed = next(iter(bad), None)
            if self._failed is not None:
                self._end_run(signal.SIGTERM)

    def _end_run(self, number: int) -> None:
        if COORDINATOR in self._children:
            self._nursery.kill(self._children[COORDINATOR], number)

    def __enter__(self) -> _Crew:
        return self

    def __exit__(self, *_: object) -> None:
        try:
            self._nursery.close()
        finally:
            for child in self._children.values():
                child.close()
            restore(self._before)
