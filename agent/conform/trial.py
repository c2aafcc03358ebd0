"""One run with the judged program in it, from its token to its exit code: the part that all trials share."""

from __future__ import annotations

import signal
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

from agent.conform.judge import Difference, Judge
from agent.conform.play import Play
from agent.conform.program import Running
from agent.conform.stage import Came, Ended, Garbled, Gone, Heard, Stage
from agent.contract.closing import Closing
from agent.contract.keys import COORDINATOR, MODE, PLANT, RECORDER, estimate, measurement, node_who, participants
from agent.contract.messages import Acknowledged, Control, Joining, Leaving, Message, Ready
from agent.guard import Guard, Unfit
from agent.guests import programs
from agent.network.acquaintance import refuse_version
from agent.network.words import Replayed, Sample

RUN = "conform"
KEPT = 3  # messages that the recorder acts as if it lacked them at the end


@dataclass(frozen=True)
class Setting:
    """What is tried, and how patiently."""

    command: Sequence[str]
    gains: Path
    play: Play
    node: str
    wait: float = 60.0  # seconds for the program to join
    deadline: float = 10.0  # seconds for whatever it is to do next
    end: float = 10.0  # seconds for it to end where it is to
    tolerance: float = 0.0


class Trial(Closing):
    """A run; use it with `with`. Whatever the program does wrong is raised as a Difference."""

    def __init__(self, setting: Setting, *, period: float = 0.0, first: int = 0, also: bytes = b"") -> None:
        """`first` is the number of the program's first message."""
        self.setting, self.play, self.node = setting, setting.play, setting.node
        self.who, self.own = node_who(setting.node), setting.play.gains.for_node(setting.node)
        self.period, self._first = period, first
        self._also = also  # stands in every message, as a later version might have it
        self.stage = Stage(RUN, setting.node)
        self.session = ""
        self.code: int | None = None
        self.sent: list[Sample] = []  # what the program has published
        self.told: list[Message] = []  # the same, read
        self.ready: list[Ready] = []
        self.joined: Joining | None = None
        self.answers: list[Sample] = []
        self._asked = False
        self._guard = Guard()  # as others have one
        self._guard.know(self.play.gains.problem)
        self._guard.begin(steps=self.play.steps, external=(), paced=period > 0.0)
        self.judge: Judge | None = None
        self._may_end = False
        told = {"run": RUN, "address": self.stage.address, "gains": str(setting.gains.resolve())}
        try:
            program = programs({self.who: setting.command}, **told)[self.who]
            self.program = Running(program, ended=lambda code: self.stage.hand_over(Ended(code)))
        except BaseException:
            self.stage.close()
            raise

    def close(self) -> None:
        """End the program, and leave."""
        with self.stage:
            self.program.close()

    # What is heard.
    def until(self, condition: Callable[[], object], what: str, *, seconds: float | None = None) -> None:
        """Heed what comes until the condition holds; Difference, `what` was due, where nothing comes for too long."""
        patience = self.setting.deadline if seconds is None else seconds
        while not condition():
            heard = self.stage.next(patience)
            if heard is None:
                raise Difference(f"{what} did not come within {patience:g} s")
            self.heed(heard, what)

    def heed(self, heard: Heard, what: str) -> None:
        match heard:
            case Ended(code):
                self.code = code
                if not self._may_end:
                    raise Difference(f"it ended {_in_words(code)} where {what} was due{self._last_words()}")
            case Came(session):
                if self.session:
                    raise Difference(f'it shows a second token, "{session}"', field="session")
                self.session = session
                self._guard.came(self.who, session)
                self.judge = Judge(self.own, session=session, first=self._first, tolerance=self.setting.tolerance)
            case Gone() if not self._may_end:
                while not isinstance(end := self.stage.next(self.setting.deadline), Ended):
                    if end is None:
                        raise Difference(f"its token is gone where {what} was due, but it goes on")
                self.heed(end, what)
            case Garbled(topic, why):
                raise Difference(f"its word on {topic} is {why}")
            case Joining() | Ready() | Leaving():
                self._heed_word(heard)
            case Replayed():
                self._asked = False
            case Sample() if not self._asked:
                self._read(heard)
            case Sample():
                self.answers.append(heard)

    def _read(self, sample: Sample) -> None:
        topic, payload, stamp = sample.topic, sample.payload, sample.stamp
        if self.judge is None:
            raise Difference(f"it published on {topic} before it had shown a token")
        message = self.judge.read(topic, payload, stamp, flaw=sample.flaw)
        if topic != estimate(self.node):  # of an estimate every field is compared
            try:
                self._guard.admit(topic, payload, stamp)
            except Unfit as unfit:
                raise Difference(f"others refuse its message on {topic}: it is {unfit.kind}", message.step) from None
        self.sent.append(sample)
        self.told.append(message)

    def _heed_word(self, word: Joining | Ready | Leaving) -> None:
        kind = type(word).__name__.lower()
        for field, value, wanted in (("who", word.who, self.who), ("session", word.session, self.session)):
            if value != wanted:
                says = f'{field} of its word on {kind} is "{value}", must be "{wanted}"'
                raise Difference(says, None, field, value, wanted)
        match word:
            case Joining():
                self.joined = word
            case Ready():
                self.ready.append(word)

    def _last_words(self) -> str:
        said = self.program.last_words()
        return f"; it said: {said}" if said else ""

    # What happens.
    def meet(self) -> None:
        """Until everybody is there, the recorder last."""
        stage, setting = self.stage, self.setting
        others = [who for who in participants(self.play.gains.problem) if who not in (self.who, RECORDER)]
        names = [name for name in self.play.gains.problem.node_names if name != self.node]
        stage.advertise([MODE, measurement(self.node), *map(estimate, names)])
        for who in others:
            stage.appear(who)
        self.until(lambda: self.session, "its token, session/.../...", seconds=setting.wait)
        self.until(lambda: self.joined, "its word on joining", seconds=setting.wait)
        assert self.joined is not None
        try:
            refuse_version(self.who, self.joined.version, own=version("peakmesh"))
        except Exception as error:
            raise Difference(str(error), None, "version", self.joined.version, version("peakmesh")) from None
        if self.ready:
            raise Difference("it was ready before the recorder was there: it must wait for the tokens of all")
        stage.appear(RECORDER)

    def meet_underway(self, step: int) -> None:
        """The run goes on, and `step` is the next; the recorder says which number the program's next message has."""
        self.meet()
        self.order("start", step=step)
        self.until(
            lambda: any(word.asks for word in self.ready),
            "its question to the recorder, ready with asks",
            seconds=self.setting.wait,
        )
        self.acknowledge(self._first, greets=self.who)

    def be_ready(self) -> None:
        """Its word, with the digest of the gains."""
        self.until(lambda: self.ready, "its word on ready", seconds=self.setting.wait)
        digest = self.play.gains.digest()
        if self.ready[0].gains != digest:
            value = self.ready[0].gains
            raise Difference(f'its digest of the gains is "{value}", must be "{digest}"', None, "gains", value, digest)

    def order(self, order: str, **facts: Any) -> None:
        """The coordinator's word to everybody."""
        others = dict.fromkeys(participants(self.play.gains.problem), self.stage.identity)
        control: dict[str, Any] = {
            "steps": self.play.steps,
            "seed": self.play.seed,
            "window": 32,
            "external": [],
            "reason": "",
            "gains": self.play.gains.digest(),
            "identity": RUN,
            "version": version("peakmesh"),
            "cast": others | {self.who: self.session} if order == "start" else {},
        }
        if self.period:
            control |= {"period": self.period, "measure_by": 0.4, "hear_by": 0.8}
        self.stage.order(Control.model_validate(control | {"order": order} | facts))

    def acknowledge(self, received: int, *, closed: bool = False, greets: str = "") -> None:
        """The recorder's word that it has so many messages of the program's."""
        steps = min(received, self.play.steps)
        self.stage.acknowledge(
            Acknowledged(
                steps=steps,
                messages=received,
                missing=0,
                received={self.who: received},
                reached={self.who: steps},
                lacking=[],
                closed=closed,
                greets=greets,
            )
        )

    def give_mode(self, k: int) -> None:
        self.stage.publish(COORDINATOR, MODE, self.play.modes[k], also=self._also)

    def give_measurement(self, k: int) -> None:
        self.stage.publish(PLANT, measurement(self.node), self.play.measurements[self.node][k], also=self._also)

    def give_estimate(self, name: str, k: int) -> None:
        self.stage.publish(node_who(name), estimate(name), self.play.estimates[name][k], also=self._also)

    def end(self, order: str, **facts: Any) -> None:
        """The coordinator ends the run; the program answers for what the recorder lacks.

        Once the recording is closed it ends by itself.
        """
        first, total = self._first + max(0, len(self.sent) - KEPT), self._first + len(self.sent)
        self.acknowledge(first)
        self.order(order, **facts)
        self.ask_again(first)
        self._may_end = True
        self.acknowledge(total, closed=True)
        self.until(lambda: self.code is not None, "its end", seconds=self.setting.end)
        if order == "close" and self.code:
            raise Difference(f"it ended {_in_words(self.code)} after a good run, must be 0{self._last_words()}")
        if order == "stop" and not self.code:
            raise Difference("it ended with code 0 after a run that was stopped; must be another")

    def ask_again(self, first: int) -> None:
        """What the recorder asks for must be what was published, to the last byte."""
        self.answers, self._asked = [], True
        self.stage.ask(first)
        self.until(lambda: not self._asked, "an answer to the recorder's question")
        for place, sent in enumerate(self.sent[first - self._first :]):
            answer, number = self.answers[place] if place < len(self.answers) else None, first + place
            if answer is None or answer[:3] != sent[:3]:
                came = "nothing" if answer is None else "another message"
                raise Difference(
                    f"asked for its messages from number {first} on, it answered {came} for number {number}, must be "
                    "what it had published",
                    field="replay",
                )

    def cast_another(self) -> None:
        """The coordinator begins with another process of the program's name; the program is to go."""
        self._may_end = True
        self.order("start", cast={self.who: f"{self.session}-another"})
        self.until(lambda: self.code is not None, "its end after another was cast", seconds=self.setting.end)
        if self.sent:
            raise Difference(f"it published on {self.sent[0].topic} in a run that began with another of its name")
        self._refuse_success("another was cast")

    def interrupt(self) -> None:
        """Somebody wants the program to end; it does, and not as after a good run."""
        self._may_end = True
        self.program.interrupt()
        self.acknowledge(len(self.sent))  # so that it need not wait for that
        self.until(lambda: self.code is not None, "its end after SIGTERM", seconds=self.setting.end)
        self._refuse_success("SIGTERM")

    def vanish(self) -> None:
        """Everybody is gone at once."""
        self._may_end = True
        self.stage.close()
        self.until(lambda: self.code is not None, "its end after everybody was lost", seconds=self.setting.end)
        self._refuse_success("everybody was lost")

    def _refuse_success(self, after: str) -> None:
        if self.code == 0:
            raise Difference(f"it ended with code 0 after {after}; must be another")


def _in_words(code: int) -> str:
    return f"with code {code}" if code >= 0 else f"by {signal.Signals(-code).name}"
