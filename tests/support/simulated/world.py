"""A run of a scenario: every role in a simulated process, started, troubled, and started again as `run` would do it."""

from __future__ import annotations

import signal
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any, NamedTuple

from agent.contract.keys import COORDINATOR, EVIDENCE, PLANT, RECORDER, participants
from agent.contract.recording import Logged
from agent.contract.recording.parts import files_of
from agent.contract.recording.reader import RecordingReader
from agent.launch import MOST_REVIVALS, REVIVAL_SECONDS
from agent.network.bus import Bus
from agent.network.configuration import Network
from agent.network.outbox import Sent
from agent.plan import RecordingPlan
from agent.roles import coordinator, node, plant, recorder
from simulated.door import Door, Published
from simulated.machine import Machine, Process
from simulated.network import LEASE
from simulated.network import Network as Links
from simulated.scenario import Scenario, Trouble
from simulated.stand_ins import put_in_place

LONGEST = 400.0  # simulated seconds in which every run must have ended, whatever happens
RUN = "simulated"


class Member(NamedTuple):
    """A process that took part, or tried to."""

    who: str
    process: Process
    is_twin: bool

    @property
    def sentence(self) -> str:
        return "" if self.process.error is None else str(self.process.error)


@dataclass(frozen=True)
class Outcome:
    """What came of a scenario."""

    scenario: Scenario
    members: list[Member]
    published: list[Published]
    recording: Path
    summary: coordinator.Summary | None
    words: list[dict[str, Any]]  # of the coordinator
    seconds: float  # simulated
    events: int  # of the machine
    hung: str  # who has not ended; "" where all have
    trace: list[str]

    @cached_property
    def recorded(self) -> Counter[tuple[str, int, bytes]]:
        """What the recording has, as far as it goes, but for what the recorder itself has to say: `place_of` each."""
        found: Counter[tuple[str, int, bytes]] = Counter()
        for file in [self.recording] if self.recording.exists() else files_of(self.recording):
            with RecordingReader(file) as reader:  # which finds the other parts
                found.update(place_of(message) for message in reader.messages() if message.topic != EVIDENCE)
        return found

    @property
    def unrecorded(self) -> list[Published]:
        return [published for published in self.published if not self.recorded[place_of(published.sent)]]


def place_of(message: Sent | Logged) -> tuple[str, int, bytes]:
    """Topic, number and payload."""
    number = message.stamp.number if isinstance(message, Sent) else message.number
    return message.topic, number, message.payload


class World:
    """Runs a scenario once; `let_go` when its outcome has been looked at."""

    def __init__(self, scenario: Scenario, folder: Path) -> None:
        self.scenario, self.recording = scenario, folder / "run.mcap"
        self.machine = Machine(scenario.seed)
        self.machine.reaction = self._reaction
        self.net = Links(self.machine, scenario.weather)
        self.members: list[Member] = []
        self.published: list[Published] = []
        self.summary: coordinator.Summary | None = None
        self.words: list[dict[str, Any]] = []
        self._revived: dict[str, list[float]] = {}
        self._pending_revival = 0
        self._survives = scenario.plan.pace is not None
        self._started = False
        self._troubles = list(scenario.troubles)

    def run(self) -> Outcome:
        hung = ""
        with put_in_place(self.machine, seed=self.scenario.seed):
            for who in participants(self.scenario.gains.problem):
                self.machine.at(self.scenario.starts.get(who, 0.0), partial(self._start, who))
            for trouble in self.scenario.troubles:
                if trouble.at < 0.0:
                    self.machine.at(-10.0 * trouble.at, partial(self._befall, trouble))
            expected = len(participants(self.scenario.gains.problem))
            self.machine.run(LONGEST, lambda: len(self.members) >= expected and self._all_over())
            still = [member.process.name for member in self.members if not member.process.is_over]
            if still:
                hung = f"{', '.join(still)} had not ended after {self.machine.now:.0f} s"
            return Outcome(
                self.scenario, self.members, self.published, self.recording, self.summary, self.words,
                self.machine.now, self.machine.steps, hung, self.machine.trace,
            )  # fmt: skip

    def let_go(self) -> None:
        """When all has been looked at: the processes are unwound."""
        with put_in_place(self.machine, seed=self.scenario.seed):
            self.machine.end()

    def _all_over(self) -> bool:
        return all(member.process.is_over for member in self.members) and not self._pending_revival

    # processes
    def _start(self, who: str, *, twin: bool = False) -> None:
        number = sum(member.who == who for member in self.members)
        process = Process(self.machine, who, number)
        member = Member(who, process, twin)
        self.members.append(member)
        process.on_end.append(partial(self._ended, member))
        process.start(partial(self._main, member))

    def _main(self, member: Member) -> None:
        """What the command of a role does."""
        who, gains, scenario = member.who, self.scenario.gains, self.scenario

        def keep(handler: Callable[[int, None], None]) -> dict[int, Any]:
            member.process.on_signal = handler
            return {}

        network = Network(
            connect=() if who == COORDINATOR else ("tcp/simulated",),
            wait=scenario.wait,
            lease=LEASE,
            keep=scenario.keep,
        )
        door: Any = partial(Door, self.net, self.published)
        with Bus(network, run=RUN, who=who, session=door, signals=keep) as bus:
            if who == COORDINATOR:
                summary = coordinator.run(bus, gains, scenario.plan, report=self._hear)
                if not member.is_twin or self.summary is None:
                    self.summary = summary
            elif who == RECORDER:
                recorder.run(
                    bus, gains, path=self.recording, force=False, plan=RecordingPlan(), report=lambda off: None
                )
            elif who == PLANT:
                plant.run(bus, gains)
            else:
                node.run(bus, gains, node=who.removeprefix("node-"))

    def _ended(self, member: Member) -> None:
        """In a paced run, whoever ends while it goes on is started again."""
        now, times = self.machine.now, self._revived.setdefault(member.who, [])
        recent = [time for time in times if now - time < REVIVAL_SECONDS]
        if member.who == COORDINATOR and not member.is_twin and not member.process.was_killed:
            self._survives = False  # where the run is over, it ends by itself
        if member.is_twin or not (self._started and self._survives):
            return
        if len(recent) >= MOST_REVIVALS:
            self._survives = self._survives and member.who != COORDINATOR
            return
        times.append(now)
        self._pending_revival += 1
        self.machine.at(now + self.machine.random.uniform(0.15, 0.6), partial(self._revive, member.who))

    def _revive(self, who: str) -> None:
        self._pending_revival -= 1
        self._start(who)

    def _hear(self, word: dict[str, Any]) -> None:
        """The coordinator's words to the launcher."""
        self.words.append(word)
        self.machine.note("launcher", f"hears {word}")
        if "started" in word:
            self._started = True
        if "ending" in word:
            self._survives = False
        part = word.get("complete", 0) / self.scenario.plan.steps
        for trouble in [trouble for trouble in self._troubles if trouble.at >= 0.0]:
            if "ending" in word or (trouble.at < 0.05 and "started" in word) or part >= trouble.at > 0.0:
                self._troubles.remove(trouble)
                self.machine.at(self.machine.now + self.net.delay(), partial(self._befall, trouble))

    # troubles
    def _befall(self, trouble: Trouble) -> None:
        self.machine.note(trouble.who, f"suffers {trouble}")
        if trouble.kind == "twin":
            self._start(trouble.who, twin=True)
            return
        for member in [m for m in self.members if m.who == trouble.who and not m.process.is_over]:
            process = member.process
            match trouble.kind:
                case "kill":
                    process.kill()
                case "signal":
                    process.signal(signal.SIGTERM)
                case "freeze":
                    process.freeze(trouble.seconds)
                case "part":
                    self._part(process, trouble)

    def _part(self, process: Process, trouble: Trouble) -> None:
        for door in [door for door in self.net.doors if door.process is process]:
            if not trouble.other:
                self.net.isolate(door, trouble.seconds)
            for other in [other for other in self.net.doors if other.process.who == trouble.other]:
                self.net.part(door, other, trouble.seconds)

    def _reaction(self) -> float:
        weather, chance = self.scenario.weather, self.machine.random
        seconds = chance.expovariate(1.0 / weather.reaction)
        return 100.0 * seconds if weather.stutter and chance.random() < weather.stutter else seconds
