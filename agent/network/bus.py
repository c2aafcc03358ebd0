"""One participant's place on the network: publish, receive, start together, replay, end together.

What roles talk to. What makes it lose nothing:

* the start barrier: everybody declares what it receives, then a liveliness token, then waits for the tokens of all
  with whom it exchanges messages (`links.linked`: as A waits for B, so does B for A), and tells the coordinator, which
  orders the start when all have told. Every two of those have a link of their own, a token is seen over that link
  alone, for peers pass on neither declarations nor messages, and declarations keep their order on a link: so whoever
  sees a token knows that peer's subscriptions. At the start, then, every publisher knows every subscription to what
  it publishes, though most pairs of nodes know nothing of each other. For a client, or behind a router, the same holds
  of the way over those between: they pass on declarations in their order;
* somebody who is lost is seen by those who have a link with it. The coordinator, plant and recorder have one with
  everybody, and the coordinator alone decides what follows, so nobody need see all the others;
* every data message is numbered and kept until the recorder has acknowledged it (`outbox`), and the recorder can
  ask for it again;
* when a run ends, nobody who is well leaves before the recorder has closed the recording.

`session` is the door to zenoh, `configuration` what zenoh is told, `words` what waits for the main thread.
"""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Set
from contextlib import suppress
from importlib.metadata import version
from threading import Thread
from types import FrameType, TracebackType
from typing import Self, TypeVar

from pydantic import ValidationError

from agent.contract.errors import Interrupted, PeakmeshError, RunBroken
from agent.contract.keys import (
    ACKNOWLEDGED,
    CONTROL,
    COORDINATOR,
    FACTS,
    RECORDER,
    in_words,
    joining,
    leaving,
    model_of,
    ready,
    refusals,
    refused,
)
from agent.contract.messages import (
    Acknowledged,
    Control,
    Estimate,
    Facts,
    Joining,
    Leaving,
    Message,
    Ready,
    Refusals,
    Word,
    tag_of,
)
from agent.guard import FLOOD, MISNUMBERED, OVERSIZED, UNREADABLE, Guard, Unfit
from agent.network.barrier import REASON_SECONDS, Barrier
from agent.network.configuration import Network
from agent.network.gate import Gate
from agent.network.outbox import Outbox
from agent.network.session import CAPACITY, Session
from agent.network.words import (
    ChannelClosed,
    Duty,
    Ignored,
    Incoming,
    Namesake,
    Peer,
    Refused,
    Replayed,
    RunClosed,
    Sample,
    Words,
)
from agent.plan import LARGEST_WINDOW
from agent.signals import Handler, Handlers, heed, restore

# Seconds of silence that end a wait. Silence, because on a busy machine everything takes long, but goes on.
REPLAY_SECONDS = 5.0  # the recorder's, for what it asks for at the end
CLOSE_SECONDS = 30.0  # everybody else's, for the recorder to close, as long as it is there
LEAVE_SECONDS = 5.0  # for the others to have gone, or to say why they went
FAREWELL_SECONDS = 2.0  # for the recorder to have our messages, for who is asked to go while the run goes on
EXCUSE_SECONDS = 2.0  # for the coordinator to be there, for who cannot take part
THREAD_SECONDS = 5.0  # for a thread to end once the session is closed
GREET_SECONDS = 3.0  # how long who joins a run under way waits for the recorder
ASK_SECONDS = 0.15  # and asks again
HOUSE_SECONDS = 0.5  # between two looks after the queues
BUSY_SECONDS = 0.01  # where one of them was filling
TELL_SECONDS = 1.0  # between two words on what was refused
LONGEST_WORD = 1 << 20  # bytes
MOST_POSTPONED = 64  # requests for replay

T = TypeVar("T")
Said = TypeVar("Said", Control, Acknowledged, Joining, Leaving, Ready, Refusals)


class Bus:
    """The place of participant `who` in run `run`. Use it with `with`.

    One thread may publish and take from channels; everything else belongs to the main thread.
    """

    def __init__(
        self,
        network: Network,
        *,
        run: str,
        who: str,
        session: Callable[..., Session] = Session,
        signals: Callable[[Handler], Handlers] = heed,
    ) -> None:
        """`session` opens the door to zenoh, `signals` asks for those that end a program; a simulation has its own."""
        self.run, self.who, self.network = run, who, network
        self._words = Words(who, meanwhile=self._keep_house)
        self.guard = Guard()  # whoever knows the problem tells it
        self._gates: list[Gate] = []
        self._house_due = self._told = 0.0  # when to look after the house; when we last told what was refused
        self._reported = 0  # messages that we have told of
        self._word = 0  # number of our next word
        self._postponed: list[Duty] = []  # requests for replay that cannot be answered yet
        self._unanswered: Counter[str] = Counter()  # requests for replay, by whom they were made to
        self._leaving = False  # a signal then changes nothing: we go as soon as all is recorded
        self._last_word: Acknowledged | None = None  # that the recording is closed
        self._ready: Ready | None = None  # what we have told the coordinator
        self.has_begun = False  # the run, for us
        self.is_over = False  # what would be published now would not be recorded
        self.is_late = False  # joined while the run went on
        self.patient = False  # in a paced run: a coordinator that is lost may come back
        self._given_up = math.inf  # when it is not waited for any more
        self.step = 0  # of a paced run: the first of which we have had no mode
        self.identity = ""  # of the run
        self._threads: list[Thread] = []
        self._session = session(network, run=run, who=who, hand_over=self._words.put)
        self._outbox = Outbox(who, session=tag_of(self._session.identity))
        self._barrier = Barrier(
            network,
            run=run,
            who=who,
            identity=self._session.identity,
            words=self._words,
            say=self._say,
            heed_namesake=self._heed_namesake,
        )
        self._handlers = signals(self._on_signal)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            if error is not None and not isinstance(error, Refused):
                self._say_why(error)
            self._session.close()
            for thread in self._threads:  # at exit it would come back from zenoh into an interpreter that is gone
                thread.join(THREAD_SECONDS)
        finally:
            restore(self._handlers)

    def _say_why(self, error: BaseException) -> None:
        """Tell the coordinator why we go, as far as it can still be told."""
        if self.who != COORDINATOR and COORDINATOR in self.present:
            reason = str(error) if isinstance(error, PeakmeshError) else f"{type(error).__name__}: {error}"
            with suppress(Exception):  # the first error is the one to be raised
                self._say(leaving(self.who), Leaving(who=self.who, reason=reason))

    def excuse(self) -> None:
        """Join until the coordinator is seen, if it is there: it then learns what is raised next."""
        self.enter()
        deadline = time.monotonic() + EXCUSE_SECONDS
        while COORDINATOR not in self.present and time.monotonic() < deadline:
            self._words.take(deadline)

    def in_thread(self, work: Callable[[], None], *, name: str) -> None:
        """Do `work` beside the main thread; it ends by ChannelClosed once the session is closed, and is waited for."""
        thread = Thread(target=work, daemon=True, name=name)
        self._threads.append(thread)
        thread.start()

    def locators(self) -> list[str]:
        """The addresses at which others can connect, but for the socket that those of a run on one machine know."""
        sockets = self.network.sockets
        return [address for address in self._session.locators() if sockets is None or address != sockets.listen]

    @property
    def present(self) -> Set[str]:
        """Who takes part just now."""
        return self._words.present

    # Declare: first what we receive, then what we send, the token last.
    def channel(self, topic: str) -> Gate:
        """Receive a topic's messages; what does not fit does not come in."""
        gate = Gate(self._session.channel(topic), self.guard, for_record=self.who == RECORDER)
        self._gates.append(gate)
        return gate

    def advertise(self, topics: Iterable[str]) -> None:
        """Announce that these topics will be published, and offer replays of them."""
        self._session.offer_replay(self.who, self._outbox.since, is_for=self._may_ask)
        for topic in topics:
            express = model_of(topic) is Estimate  # the only message that somebody waits for right now
            self._session.advertise(topic, express=express)

    def _may_ask(self, by: str, question: Duty) -> bool | None:
        """Whether a session is the recorder's; None where it will be when the one before it is known to have gone."""
        if self.guard.trusts(RECORDER, by) or not self.guard.is_there(RECORDER, by):
            return self.guard.trusts(RECORDER, by)
        if len(self._postponed) == MOST_POSTPONED:
            return False
        self._postponed.append(question)
        return None

    def _ask_again(self) -> Ignored:
        """Somebody else is the recorder now: what was postponed is asked once more."""
        postponed, self._postponed = self._postponed, []
        for question in postponed:
            self._words.put(question)
        return Ignored()

    def enter(self) -> None:
        """Receive what runs the run, watch the others' tokens, and show our own: the last declaration."""
        self._session.watch(self._see)  # first: who says something has shown its token before
        if self.who in (COORDINATOR, RECORDER):
            self._listen(ready("*"), Ready)
        if self.who == COORDINATOR:
            self._listen(joining("*"), Joining)
            self._listen(leaving("*"), Leaving)
            self._listen(refusals("*"), Refusals)
        else:
            self._listen(CONTROL, Control, heed=self._heed_cast)
        if self.who != RECORDER:
            self._listen(ACKNOWLEDGED, Acknowledged, heed=self._forget)
        self._session.listen(refused(self.who, self._session.identity), self._refuse, overflow=lambda: None)
        self._session.appear(self.who)

    def _see(self, who: str, session: str, present: bool) -> None:
        """Somebody has come or gone; called on zenoh's threads."""
        if not self.guard.takes_part(who):
            return
        if present:
            if self.guard.came(who, session):
                self._words.put(lambda: Peer(who, True))
            if who == self.who:
                self._words.put(lambda: Namesake(session))
        elif (is_alone := self.guard.went(who, session)) is not None:
            self._words.put(lambda: Peer(who, not is_alone, succeeds=not is_alone))
            if who == RECORDER:
                self._words.put(self._ask_again)

    def _refuse(self, sentence: bytes) -> Ignored:
        """Our place is taken, says a namesake; nobody can say so who is not there.

        Where that one has joined our run unseen, it is theirs to go.
        """
        if (self.has_begun and not self.is_late) or not self.guard.are_several(self.who):
            return Ignored()
        raise self._place_is_taken()

    def _heed_namesake(self, identity: str) -> None:
        """Of two processes with one name the one stays that has begun, else the earlier one. Raises Refused."""
        own = self._session.identity
        if identity != own and self.has_begun:
            self._session.say(refused(self.who, identity), str(self._place_is_taken()).encode())
        elif identity < own:
            raise self._place_is_taken()

    def _heed_cast(self, control: Control) -> None:
        """Of two processes with one name the one begins that the coordinator names. Raises Refused."""
        if not self.has_begun:
            if control.cast.get(self.who, self._session.identity) != self._session.identity:
                raise self._place_is_taken()
            self.guard.prefer(control.cast)

    def _place_is_taken(self) -> Refused:
        return Refused(f'{in_words(self.who)} takes part in run "{self.run}" already; start it once')

    def _listen(self, topic: str, model: type[Said], *, heed: Callable[[Said], None] = lambda word: None) -> None:
        name = topic.partition("/")[0]

        def decode(payload: bytes) -> Said | Ignored:
            try:
                if len(payload) > LONGEST_WORD:
                    raise Unfit(OVERSIZED)
                word = model.model_validate_json(payload)
                self.guard.admit_word(_speaker(word), name, word, second=not isinstance(word, Acknowledged | Control))
                heed(word)
                return word
            except ValidationError:
                self.guard.refuse(name, UNREADABLE)
            except Unfit as unfit:
                self.guard.refuse(name, unfit.kind)
            return Ignored()

        self._session.listen(topic, decode, overflow=lambda: self.guard.refuse(name, FLOOD))

    def _forget(self, acknowledged: Acknowledged) -> None:
        """What the recorder has need not be kept. Raises Unfit where it says that it has more than was sent."""
        received = acknowledged.received.get(self.who, 0)
        if received > self._outbox.number and self._outbox.has_sent:
            raise Unfit(MISNUMBERED)
        self._outbox.forget(received)
        self._last_word = acknowledged if acknowledged.closed else None

    # Start together; `barrier` has the rest.
    def meet(self, others: Iterable[str], *, warn: Callable[[str], None] = lambda sentence: None) -> Iterator[str]:
        """Wait for everybody's token, and yield who has come; RunBroken names who is missing when time is over.

        `warn` is told, at the coordinator, of what is not as it should be with those who join.
        """
        self._barrier.warn = warn
        return self._barrier.meet(others)

    def gather(self, others: Iterable[str]) -> dict[str, Ready]:
        """The coordinator's: wait until everybody has met everybody. InputError where a name is there twice."""
        return self._barrier.gather(others)

    def wait_for_start(self) -> Control:
        """The coordinator's order to start, with the facts of the run."""
        return self._barrier.wait_for_start()

    def report_ready(self, gains: str) -> None:
        """Tell the coordinator that we have met everybody, and which gains we run on."""
        self._ready = Ready(who=self.who, gains=gains)
        self._say(ready(self.who), self._ready)

    def gather_underway(self, first: Ready, *, seconds: float) -> dict[str, Ready]:
        """The coordinator's who has come back: what those say who answer in time, after the first."""
        answers, others, deadline = {first.who: first}, list[Incoming](), time.monotonic() + seconds
        while time.monotonic() < deadline:
            match self._words.next(deadline):
                case Ready(underway=True) as answer:
                    answers[answer.who] = answer
                case None:
                    pass
                case word:
                    others.append(word)
        for word in others:
            self._words.set_aside(word)
        return answers

    def greeted(
        self, *, seconds: float = GREET_SECONDS, heed: Callable[[Incoming | None], None] = lambda word: None
    ) -> Acknowledged:
        """Wait for the recorder's word on which number our next message has; RunBroken where it does not come.

        `heed` gets what else is heard.
        """
        deadline = time.monotonic() + seconds
        asks = Ready(who=self.who, gains="", asks=True)
        while time.monotonic() < deadline:
            self._say(ready(self.who), asks)  # until it is heard: the recorder may be on its way back, too
            again = time.monotonic() + ASK_SECONDS
            while (left := again - time.monotonic()) > 0.0:
                match self.receive(timeout=left):
                    case Acknowledged(greets=who) as greeting if who == self.who:
                        self._outbox.go_on(greeting.received.get(self.who, 0))
                        return greeting
                    case word:
                        heed(word)
        raise RunBroken(f"the recorder did not greet {in_words(self.who)} within {seconds:g} s; start it again")

    # Run.
    def publish(self, topic: str, message: Message) -> None:
        """Send a data message, and keep it until the recorder has it. Raises ChannelClosed where the run is over."""
        if self.is_over:
            raise ChannelClosed
        self.guard.now = max(self.guard.now, message.step)
        self._session.publish(self._outbox.add(topic, message.encode()))

    def wait_for_nobody(self) -> None:
        """In a paced run: keep no more for a recorder that stays away than was agreed on."""
        self._outbox.most = self.network.keep

    def trace(self) -> None:
        """Have what is published from now on say when it was where, so that a receiver knows why it is late."""
        self._session.traced = True

    @property
    def published(self) -> int:
        """How many messages we have sent."""
        return self._outbox.number

    def receive(self, *, timeout: float = math.inf) -> Incoming | None:
        """The next word for the main thread; None where `timeout` seconds have passed.

        Raises RunClosed when the coordinator ends the run, RunBroken when the coordinator is lost, Interrupted
        on a signal, and whatever was given to `fail`.
        """
        deadline = time.monotonic() + timeout
        while True:
            word = self._noted(self._words.next(min(deadline, self._given_up)))
            if time.monotonic() >= self._given_up:
                raise RunBroken(f"the coordinator was lost, and did not come back within {self.network.wait:g} s")
            match word:
                case Control(order="close" | "stop"):
                    self._tell_refused()
                    raise RunClosed(word)
                case Namesake(identity=identity):
                    self._heed_namesake(identity)
                    continue
                case Peer(who="coordinator", present=present) if self.patient and self._ready is not None:
                    self._given_up = math.inf if present else time.monotonic() + self.network.wait
                    if present:
                        self._say(ready(self.who), self._ready.model_copy(update=self._underway()))
                case Peer(who="coordinator", present=False) | Peer(who="coordinator", succeeds=True):
                    raise RunBroken("the coordinator was lost: its process ended, or the network to it failed")
            if word is not None or time.monotonic() >= deadline:
                return word

    def _underway(self) -> dict[str, object]:
        return {"underway": True, "step": self.step, "identity": self.identity}

    def reason_of(self, who: str) -> str:
        """Why somebody has gone who is gone; "" where it has not said."""
        reasons, deadline = self._words.reasons, time.monotonic() + REASON_SECONDS
        while who not in reasons and time.monotonic() < deadline:
            if (word := self._words.take(deadline)) is not None:
                self._words.set_aside(word)
        return reasons.get(who, "")

    def fail(self, error: BaseException) -> None:
        """Have the main thread raise `error`; called by the thread that computes."""
        self._words.put(lambda: _raise(error))

    @property
    def unrecorded(self) -> int:
        """How many of our messages that we keep the recorder has not got, as far as it has said."""
        return len(self._outbox)

    @property
    def dropped(self) -> int:
        """How many of our messages we could not keep for the recorder."""
        return self._outbox.dropped

    def order(self, control: Control) -> None:
        """The coordinator's word to everybody."""
        self.has_begun = self.has_begun or control.order == "start"
        self._say(CONTROL, control.model_copy(update={"version": version("peakmesh")}))

    def acknowledge(self, acknowledged: Acknowledged) -> None:
        """The recorder's word to everybody; no mode comes that is more than a window ahead of its steps."""
        self.guard.now = acknowledged.steps
        self._say(ACKNOWLEDGED, acknowledged)

    def tell_viewers(self, facts: Facts) -> None:
        """The recorder's: answer viewers who ask what run this is. It has no deadlines that this could cost."""
        self._session.answer(FACTS, facts.model_dump_json().encode())

    def request_replay(self, who: str, *, first: int) -> None:
        """Ask `who` for its messages from number `first` on: they come as samples, then Replayed(who)."""
        self._unanswered[who] += 1
        self._session.request_replay(who, first=first, seconds=CLOSE_SECONDS)

    def _say(self, topic: str, word: Word) -> None:
        """Send a word, with our session and its number."""
        signed = word.model_copy(update={"session": self._session.identity, "number": self._word})
        self._word += 1
        self._session.say(topic, signed.model_dump_json().encode())

    # Meanwhile.
    def _keep_house(self) -> float:
        """See that no queue of zenoh's is full, and tell the coordinator what was refused; when to do so again.

        RunBroken where the run cannot go on for want of what had no room.
        """
        now = time.monotonic()
        if now < self._house_due:
            return self._house_due
        fullest = max((gate.relieve() for gate in self._gates), default=0)
        if (lost := self.guard.lost()) is not None and not self._leaving:
            topic, step = lost
            raise RunBroken(
                f"{in_words(self.who)} has no room for step {step} of {topic}: {CAPACITY} messages wait there; "
                f"a sensor must not be more than {LARGEST_WINDOW} steps ahead of the mode"
            )
        self._house_due = now + (HOUSE_SECONDS if fullest < CAPACITY // 8 else BUSY_SECONDS)
        if now >= self._told + TELL_SECONDS:
            self._told = now
            self._tell_refused()
        return self._house_due

    def _tell_refused(self) -> None:
        """Tell the coordinator what we have refused, where there is something new."""
        total = self.guard.total
        if total > self._reported and self.who != COORDINATOR:
            self._reported = total
            self._say(refusals(self.who), Refusals(who=self.who, counts=self.guard.refused()))

    # End together.
    def replayed(self, whos: Iterable[str]) -> Iterator[Sample]:
        """Samples that are still to come, until everybody in `whos` has answered every request for replay.

        Every one: what answers an earlier request may have left before what the last one is about was published.
        """
        names = list(whos)
        for word in self._until(lambda: not any(self._unanswered[who] for who in names), silence=REPLAY_SECONDS):
            if isinstance(word, Sample):
                yield word

    def wait_for_close(self, heed: Callable[[Incoming | None], None] = lambda word: None) -> Acknowledged | None:
        """Answer replays until the recorder has closed the recording; None where it has not.

        In a paced run the recorder may just be on its way back; the coordinator, whose end it is, knows. `heed` gets
        what is heard meanwhile.
        """
        keepers, present = {RECORDER, COORDINATOR} if self.patient else {RECORDER}, self._words.present
        for word in self._until(lambda: self._last_word is not None or not keepers & present, silence=CLOSE_SECONDS):
            heed(word)
        return self._last_word

    def wait_until_recorded(self) -> None:
        """Publish nothing more, and stay until the recorder has what we have published; but not for long.

        Nobody else keeps it, and the recorder may just be on its way back, to ask for it.
        """
        self.is_over, deadline = True, time.monotonic() + FAREWELL_SECONDS
        for _ in self._until(lambda: not self.unrecorded or time.monotonic() >= deadline, silence=FAREWELL_SECONDS):
            pass

    def wait_until_there(self, whos: Iterable[str]) -> None:
        """Wait for those who have not been seen yet; but not for long, for they may be gone."""
        names, present = set(whos), self._words.present
        for _ in self._until(lambda: names <= present, silence=GREET_SECONDS):
            pass

    def wait_until_gone(self, whos: Iterable[str], *, greet: Callable[[], None] = lambda: None) -> None:
        """Stay until they have gone, so that our last word is sure to have reached them; but not for long.

        Whoever comes only now is told it by `greet`.
        """
        names, present = set(whos), self._words.present
        for word in self._until(lambda: not names & present, silence=LEAVE_SECONDS):
            if isinstance(word, Peer) and word.present and word.who in names:
                greet()

    def _until(self, condition: Callable[[], bool], *, silence: float) -> Iterator[Incoming | None]:
        """What comes until the condition holds, or for `silence` seconds nothing has come; None as from `take`."""
        self._leaving = True
        while not condition():
            before = self._words.taken
            word = self._noted(self._words.take(time.monotonic() + silence))
            if self._words.taken == before:
                return
            yield word

    def _noted(self, word: Incoming | None) -> Incoming | None:
        if isinstance(word, Replayed):
            self._unanswered[word.who] -= 1
        return word

    def _on_signal(self, number: int, frame: FrameType | None) -> None:
        self._words.put(lambda: self._interrupt(number))

    def _interrupt(self, number: int) -> None:
        if not self._leaving:
            raise Interrupted(number)


def _speaker(word: Said) -> str:
    """Who says such a word."""
    match word:
        case Ready() | Refusals() | Joining() | Leaving():
            return word.who
        case Acknowledged():
            return RECORDER
    return COORDINATOR


def _raise(error: BaseException) -> None:
    raise error
