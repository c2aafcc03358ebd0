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

`session` is the door to zenoh, `configuration` what zenoh is told, `words` what waits for the main thread, `hearing`
how it gets there. `housekeeping` is what is seen to meanwhile, `replays` who may ask again, `ending` how all part.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Iterator, Set
from contextlib import suppress
from importlib.metadata import version
from threading import Thread
from types import FrameType, TracebackType
from typing import Self

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
from agent.guard import MISNUMBERED, Guard, Unfit
from agent.network.barrier import REASON_SECONDS, Barrier
from agent.network.configuration import Network
from agent.network.ending import CLOSE_SECONDS, Ending
from agent.network.gate import Gate
from agent.network.hearing import Hearing
from agent.network.housekeeping import Housekeeping
from agent.network.outbox import Outbox
from agent.network.replays import Replays
from agent.network.session import CAPACITY, Session
from agent.network.words import (
    ChannelClosed,
    Ignored,
    Incoming,
    Namesake,
    Peer,
    Refused,
    RunClosed,
    Sample,
    Words,
)
from agent.plan import LARGEST_WINDOW
from agent.signals import Handler, Handlers, heed, restore

# Seconds
EXCUSE_SECONDS = 2.0  # for the coordinator to be there, for who cannot take part
THREAD_SECONDS = 5.0  # for a thread to end once the session is closed
GREET_SECONDS = 3.0  # how long who joins a run under way waits for the recorder
ASK_SECONDS = 0.15  # and asks again


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
        self._words = Words(who, meanwhile=self._meanwhile)
        self.guard = Guard()  # whoever knows the problem tells it
        self._house = Housekeeping(who, self.guard, tell=lambda word: self._say(refusals(who), word))
        self._replays = Replays(self.guard, self._words)
        self._ending = Ending(self._words, self._replays)
        self._word = 0  # number of our next word
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
        self._house.gates.append(gate)
        return gate

    def advertise(self, topics: Iterable[str]) -> None:
        """Announce that these topics will be published, and offer replays of them."""
        self._session.offer_replay(self.who, self._outbox.since, is_for=self._replays.may_ask)
        for topic in topics:
            express = model_of(topic) is Estimate  # the only message that somebody waits for right now
            self._session.advertise(topic, express=express)

    def enter(self) -> None:
        """Receive what runs the run, watch the others' tokens, and show our own: the last declaration."""
        listen = Hearing(self._session, self.guard).listen
        self._session.watch(self._see)  # first: who says something has shown its token before
        if self.who in (COORDINATOR, RECORDER):
            listen(ready("*"), Ready)
        if self.who == COORDINATOR:
            listen(joining("*"), Joining)
            listen(leaving("*"), Leaving)
            listen(refusals("*"), Refusals)
        else:
            listen(CONTROL, Control, heed=self._heed_cast)
        if self.who != RECORDER:
            listen(ACKNOWLEDGED, Acknowledged, heed=self._forget)
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
                self._words.put(self._replays.ask_again)

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

    def _forget(self, acknowledged: Acknowledged) -> None:
        """What the recorder has need not be kept. Raises Unfit where it says that it has more than was sent."""
        received = acknowledged.received.get(self.who, 0)
        if received > self._outbox.number and self._outbox.has_sent:
            raise Unfit(MISNUMBERED)
        self._outbox.forget(received)
        self._ending.last_word = acknowledged if acknowledged.closed else None

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
            word = self._replays.noted(self._words.next(min(deadline, self._given_up)))
            if time.monotonic() >= self._given_up:
                raise RunBroken(f"the coordinator was lost, and did not come back within {self.network.wait:g} s")
            match word:
                case Control(order="close" | "stop"):
                    self._house.tell_refused()
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
        self._replays.asked(who)
        self._session.request_replay(who, first=first, seconds=CLOSE_SECONDS)

    def _say(self, topic: str, word: Word) -> None:
        """Send a word, with our session and its number."""
        signed = word.model_copy(update={"session": self._session.identity, "number": self._word})
        self._word += 1
        self._session.say(topic, signed.model_dump_json().encode())

    def _meanwhile(self) -> float:
        """Keep house; when to do so again. RunBroken where the run cannot go on for want of what had no room."""
        due = self._house.keep()
        if (lost := self.guard.lost()) is not None and not self._ending.has_begun:
            topic, step = lost
            raise RunBroken(
                f"{in_words(self.who)} has no room for step {step} of {topic}: {CAPACITY} messages wait there; "
                f"a sensor must not be more than {LARGEST_WINDOW} steps ahead of the mode"
            )
        return due

    # End together; `ending` has the rest.
    def replayed(self, whos: Iterable[str]) -> Iterator[Sample]:
        """Samples that are still to come, until everybody in `whos` has answered every request for replay."""
        return self._ending.replayed(whos)

    def wait_for_close(self, heed: Callable[[Incoming | None], None] = lambda word: None) -> Acknowledged | None:
        """Answer replays until the recorder has closed the recording; None where it has not.

        In a paced run the recorder may just be on its way back; the coordinator, whose end it is, knows. `heed` gets
        what is heard meanwhile.
        """
        return self._ending.wait_for_close({RECORDER, COORDINATOR} if self.patient else {RECORDER}, heed)

    def wait_until_recorded(self) -> None:
        """Publish nothing more, and stay until the recorder has what we have published; but not for long."""
        self.is_over = True
        self._ending.wait_until_recorded(lambda: not self.unrecorded)

    def wait_until_there(self, whos: Iterable[str]) -> None:
        """Wait for those who have not been seen yet; but not for long, for they may be gone."""
        self._ending.wait_until_there(whos)

    def wait_until_gone(self, whos: Iterable[str], *, greet: Callable[[], None] = lambda: None) -> None:
        """Stay until they have gone, but not for long; whoever comes only now is told our last word by `greet`."""
        self._ending.wait_until_gone(whos, greet)

    def _on_signal(self, number: int, frame: FrameType | None) -> None:
        self._words.put(lambda: self._interrupt(number))

    def _interrupt(self, number: int) -> None:
        if not self._ending.has_begun:
            raise Interrupted(number)


def _raise(error: BaseException) -> None:
    raise error
