"""One place on the network and another, over real Zenoh on loopback, in one process."""

from __future__ import annotations

import contextlib
import re
import signal
import threading
import time
from collections.abc import Iterator
from types import SimpleNamespace

import pytest
from runs import PATIENCE

from agent.contract.errors import InputError, Interrupted, RunBroken
from agent.contract.keys import CONTROL, COORDINATOR, MODE, PLANT, RECORDER
from agent.contract.messages import Acknowledged, Control, Mode, Word
from agent.guard import FORGED, OVERSIZED, REPEATED, UNREADABLE
from agent.network import barrier, ending
from agent.network.addresses import NONE
from agent.network.bus import Bus
from agent.network.configuration import Network
from agent.network.ending import REPLAY_SECONDS
from agent.network.gate import Admitted
from agent.network.hearing import LONGEST_WORD
from agent.network.words import ChannelClosed, Incoming, Peer, Refused, Replayed, RunClosed, Sample


@pytest.fixture
def coordinator() -> Iterator[Bus]:
    with Bus(Network(wait=PATIENCE), run="test", who=COORDINATOR) as bus:
        bus.advertise([MODE])
        bus.enter()
        yield bus


@pytest.fixture
def recorder(coordinator: Bus) -> Iterator[Bus]:
    """Joined after the coordinator, which has then seen it."""
    with Bus(Network(connect=(coordinator.locators()[0],), wait=PATIENCE), run="test", who=RECORDER) as bus:
        bus.enter()
        assert list(bus.meet([COORDINATOR])) == [COORDINATOR]
        assert list(coordinator.meet([RECORDER])) == [RECORDER]
        yield bus


def publish(bus: Bus, steps: range) -> None:
    for step in steps:
        bus.publish(MODE, Mode(step=step, mode="a"))


def acknowledged(received: int, *, closed: bool = False) -> Acknowledged:
    return Acknowledged(
        steps=received,
        messages=received,
        missing=0,
        received={COORDINATOR: received},
        reached={},
        lacking=[],
        closed=closed,
    )


def answer(publisher: Bus) -> None:
    """Let a publisher answer the request for replay that is on its way: `take` gives None once it has."""
    while publisher._words.take(time.monotonic() + PATIENCE) is not None:
        pass


def drain(bus: Bus) -> None:
    """Take all words, among them the tokens of the barrier, until one of them raises."""
    while bus.receive(timeout=PATIENCE) is not None:
        pass


def steps_of(samples: list[Sample]) -> list[int]:
    return [Mode.decode(sample.payload).step for sample in samples]


def steps_admitted(admitted: list[Admitted]) -> list[int]:
    return [each.message.step for each in admitted]


def test_what_was_published_before_anybody_listened_is_replayed(coordinator: Bus, recorder: Bus) -> None:
    """A publisher keeps what nobody has acknowledged: bytes, number, sender and topic."""
    publish(coordinator, range(5))
    recorder.request_replay(COORDINATOR, first=2)
    answer(coordinator)
    samples = list(recorder.replayed([COORDINATOR]))
    assert steps_of(samples) == [2, 3, 4]
    assert [sample.topic for sample in samples] == [MODE] * 3
    assert [(s.stamp.number, s.stamp.sender) for s in samples if s.stamp is not None] == [
        (number, COORDINATOR) for number in (2, 3, 4)
    ]


def test_what_was_acknowledged_is_forgotten(coordinator: Bus, recorder: Bus) -> None:
    """A publisher keeps no more than what the recorder lacks: memory stays flat however long a run is."""
    for first in range(0, 2000, 100):
        publish(coordinator, range(first, first + 100))
        recorder.acknowledge(acknowledged(first + 90))
        while not isinstance(coordinator.receive(timeout=PATIENCE), Acknowledged):
            pass
        assert len(coordinator._outbox) == 10
    recorder.request_replay(COORDINATOR, first=0)
    answer(coordinator)
    assert steps_of(list(recorder.replayed([COORDINATOR]))) == list(range(1990, 2000))


def test_the_next_recorder_is_answered_once_the_one_before_is_gone(coordinator: Bus) -> None:
    """As long as that one is there nobody else is told anything; a question that comes early is not lost."""
    network = Network(connect=(coordinator.locators()[0],), wait=PATIENCE)
    publish(coordinator, range(3))
    with Bus(network, run="test", who=RECORDER) as following:
        with Bus(network, run="test", who=RECORDER) as before:
            before.enter()
            assert list(coordinator.meet([RECORDER])) == [RECORDER]
            following.enter()
            while following._words.take(time.monotonic() + PATIENCE) != Peer(COORDINATOR, True):
                pass
            following.request_replay(COORDINATOR, first=1)
            while not coordinator._replays.postponed:
                coordinator._words.take(time.monotonic() + 0.01)
        assert coordinator.receive(timeout=PATIENCE) == Peer(RECORDER, True, succeeds=True)
        answer(coordinator)
        assert steps_of(list(following.replayed([COORDINATOR]))) == [1, 2]


def test_a_channel_holds_messages_in_order(coordinator: Bus) -> None:
    """Live messages wait in their channel until they are asked for, none is lost after the barrier."""
    with Bus(Network(connect=(coordinator.locators()[0],), wait=PATIENCE), run="test", who=PLANT) as plant:
        channel = plant.channel(MODE)
        plant.enter()
        list(coordinator.meet([PLANT]))
        publish(coordinator, range(500))
        assert steps_admitted([channel.next() for _ in range(500)]) == list(range(500))
        assert list(channel.waiting()) == []


def test_order_ends_the_run(coordinator: Bus, recorder: Bus) -> None:
    """An order of the coordinator to stop raises RunClosed with its reason."""
    coordinator.order(STOP)
    with pytest.raises(RunClosed) as caught:
        drain(recorder)
    assert caught.value.control.reason == "enough"


def test_a_peer_that_leaves_is_seen(coordinator: Bus) -> None:
    """Whoever closes its session is gone for the others at once."""
    with Bus(Network(connect=(coordinator.locators()[0],), wait=PATIENCE), run="test", who=PLANT) as plant:
        plant.enter()
        list(coordinator.meet([PLANT]))
    while (word := coordinator.receive(timeout=PATIENCE)) != Peer(PLANT, present=False):
        assert word is not None


@pytest.mark.parametrize("gap", [0.9 * REPLAY_SECONDS, 1.1 * REPLAY_SECONDS])
def test_whoever_asks_for_a_replay_gives_up_in_silence_alone(
    gap: float, coordinator: Bus, recorder: Bus, monkeypatch: pytest.MonkeyPatch
) -> None:
    """However long everything takes on a busy machine: where something comes, more may come."""
    now, samples = 0.0, [Sample(MODE, b"%d" % k, None) for k in range(10)]
    words: list[Incoming] = [*samples, Replayed(COORDINATOR)]

    def take(deadline: float) -> Incoming | None:
        nonlocal now
        if now + gap > deadline:
            now = deadline
            return None
        now += gap
        recorder._words.taken += 1
        return words.pop(0)

    recorder.request_replay(COORDINATOR, first=0)
    monkeypatch.setattr(ending, "time", SimpleNamespace(monotonic=lambda: now))
    monkeypatch.setattr(recorder._words, "take", take)
    found = list(recorder.replayed([COORDINATOR]))
    if gap < REPLAY_SECONDS:
        assert (found, now) == (samples, pytest.approx(11 * gap))
    else:
        assert (found, now) == ([], REPLAY_SECONDS)


def test_signals_are_heeded_until_we_leave(ctrl_c: None, coordinator: Bus, recorder: Bus) -> None:
    """A signal interrupts whoever is running, and does not cut the closing short."""
    signal.raise_signal(signal.SIGTERM)
    with pytest.raises(Interrupted) as caught:
        drain(recorder)
    assert caught.value.exit_code == 143
    recorder.acknowledge(acknowledged(0, closed=True))
    signal.raise_signal(signal.SIGINT)
    last_word = coordinator.wait_for_close()
    assert last_word is not None
    assert last_word.closed


def test_a_coordinator_that_may_come_back_is_not_waited_for_for_ever(coordinator: Bus) -> None:
    """In a paced run its loss is no reason to go, until the wait is over."""
    with Bus(Network(connect=(coordinator.locators()[0],), wait=0.3), run="test", who=PLANT) as plant:
        plant.enter()
        list(coordinator.meet([PLANT]))
        plant.report_ready("")
        plant.patient = True
        coordinator._session.close()
        coordinator._session.close = lambda: None  # type: ignore[method-assign]  # the fixture would close it again
        with pytest.raises(RunBroken, match=r"the coordinator was lost, and did not come back within 0\.3 s"):
            drain(plant)


@pytest.mark.parametrize("ignored", [False, True])
def test_handlers_are_given_back(ctrl_c: None, ignored: bool) -> None:
    """Whoever had the signals before has them again afterwards; what is ignored stays so all the time."""
    may_be_ignored = {signal.SIGINT, signal.SIGHUP}
    whose = signal.SIG_IGN if ignored else signal.SIG_DFL
    given = {number: signal.signal(number, whose) for number in may_be_ignored}
    before = {number: signal.getsignal(number) for number in (*may_be_ignored, signal.SIGTERM)}
    try:
        with Bus(Network(), run="test", who=COORDINATOR):
            heeded = {number for number, handler in before.items() if signal.getsignal(number) != handler}
        after = {number: signal.getsignal(number) for number in before}
    finally:
        for number, handler in given.items():
            signal.signal(number, handler)
    assert heeded == {signal.SIGTERM} | (set() if ignored else may_be_ignored)
    assert after == before


def test_who_is_missing_is_named(coordinator: Bus) -> None:
    """The barrier gives up at its deadline and names who has not come."""
    impatient = Network(connect=(coordinator.locators()[0],), wait=0.3)
    with Bus(impatient, run="test", who=PLANT) as plant:
        plant.enter()
        there = Peer(COORDINATOR, present=True)
        while plant._words.take(time.monotonic() + PATIENCE) != there:
            pass
        plant._words.set_aside(there)  # it has come, however long that took
        started = time.monotonic()
        said = 'has reached the coordinator, but within 0.3 s not node "1" and the recorder'
        with pytest.raises(RunBroken, match=re.escape(f"the plant, which listens at {impatient.listen}, {said}")):
            list(plant.meet([COORDINATOR, RECORDER, "node-1"]))
        assert time.monotonic() - started >= 0.3


def test_runs_do_not_hear_each_other(coordinator: Bus) -> None:
    """A peer of another run's name is not there, even on the same network."""
    with Bus(Network(connect=(coordinator.locators()[0],), wait=0.3), run="other", who=PLANT) as plant:
        plant.enter()
        with pytest.raises(RunBroken):
            list(plant.meet([COORDINATOR]))


@pytest.mark.parametrize("question", ["", "?from=x", "?from=0", "?from=-1;_anyke"])
def test_a_question_that_is_not_the_recorders_is_ignored(coordinator: Bus, recorder: Bus, question: str) -> None:
    """Anybody may look at the keys of a run without ending it."""
    publish(coordinator, range(3))
    asked = recorder._session._zenoh.get(f"peakmesh/test/replay/{COORDINATOR}{question}", timeout=PATIENCE)
    answers: list[object] = []
    waiting = threading.Thread(target=lambda: answers.extend(asked), daemon=True)
    waiting.start()
    deadline = time.monotonic() + PATIENCE
    while waiting.is_alive() and time.monotonic() < deadline:
        coordinator._words.take(time.monotonic() + 0.05)  # it takes the question, and makes nothing of it
    assert not waiting.is_alive()
    assert answers == []


STOP = Control(order="stop", steps=1, seed=0, window=1, external=[], reason="enough")


def test_a_foreign_word_is_counted_and_changes_nothing(coordinator: Bus, recorder: Bus) -> None:
    """Not what is none, not what is too long, not what is signed by nobody who is known, not what was said before."""
    forged = STOP.model_copy(update={"reason": "forged"})
    signed = forged.model_copy(update={"session": "somebody"})
    again = forged.model_copy(update={"session": coordinator._session.identity})  # and its number was used
    coordinator.order(STOP.model_copy(update={"order": "start"}))
    for word in (
        b"hello",
        b"{}",
        b'{"order": "dance"}',
        b" " * (LONGEST_WORD + 1),
        b"",
        *map(encoded, (signed, again)),
    ):
        coordinator._session.say(CONTROL, word)
    coordinator.order(STOP)
    with pytest.raises(RunClosed) as caught:
        drain(recorder)
    assert caught.value.control.reason == "enough"
    assert recorder.guard.refused() == {CONTROL: {UNREADABLE: 4, OVERSIZED: 1, FORGED: 1, REPEATED: 1}}


def encoded(word: Word) -> bytes:
    return word.model_dump_json().encode()


def test_a_name_that_is_there_twice_is_refused(coordinator: Bus) -> None:
    """Two participants of one name would publish the same topic; whoever sees it first, the second itself or the
    coordinator, says so."""
    network = Network(connect=(coordinator.locators()[0],), wait=PATIENCE)

    def take_part(bus: Bus) -> None:
        bus.enter()
        list(bus.meet([COORDINATOR]))
        bus.report_ready("gains")

    with Bus(network, run="test", who=PLANT) as first, Bus(network, run="test", who=PLANT) as second:
        take_part(first)
        try:
            take_part(second)
            coordinator.gather([PLANT, RECORDER])
        except (InputError, Refused) as refusal:
            said = str(refusal)
        else:
            said = ""
    assert re.fullmatch(r"the plant takes part .*; start it once", said)


def test_who_cannot_meet_is_named_by_the_coordinator(coordinator: Bus, monkeypatch: pytest.MonkeyPatch) -> None:
    """It asks those who are there whom they lack, and says which two have no link; then everybody can say so."""
    monkeypatch.setattr(barrier, "WORD_SECONDS", PATIENCE)
    with Bus(Network(connect=(coordinator.locators()[0],), wait=PATIENCE), run="test", who=PLANT) as plant:
        plant.enter()
        ended = list[Control]()

        def meet() -> None:
            try:
                list(plant.meet([COORDINATOR, RECORDER]))
            except RunClosed as closed:
                ended.append(closed.control)

        thread = threading.Thread(target=meet)
        thread.start()
        list(coordinator.meet([PLANT]))
        recorder = {"who": RECORDER, "listen": "tcp/[::1]:9", "lacks": [PLANT]}
        coordinator._barrier._acquaintance.heed(plant._barrier._joining().model_copy(update=recorder))
        said = coordinator._barrier._strangers({PLANT})
        coordinator.order(Control(order="stop", steps=1, seed=0, window=1, external=[], reason=said))
        thread.join(PATIENCE)
    assert [control.reason for control in ended] == [said]
    assert "the recorder and the plant have reached the coordinator, but have no link between them: " in said
    assert f"the recorder listens at tcp/[::1]:9, the plant at {plant.network.listen}; " in said


def leave(network: Network, *, closed: bool = False) -> None:
    """Take part as the plant, and go because of an error; `closed`: after the session has failed."""
    with Bus(network, run="test", who=PLANT) as plant:
        plant.enter()
        list(plant.meet([COORDINATOR]))
        if closed:
            plant._session._zenoh.close()
        raise RunBroken("no sugar")


def test_who_goes_says_why(coordinator: Bus) -> None:
    """The coordinator learns what happened on another machine, before the start and after it."""
    network = Network(connect=(coordinator.locators()[0],), wait=PATIENCE)
    with pytest.raises(RunBroken, match="no sugar"):
        leave(network)
    with pytest.raises(RunBroken, match="the plant left before the run had started; it said: no sugar"):
        list(coordinator.meet([PLANT, RECORDER]))
    with pytest.raises(RunBroken, match="no sugar"):
        leave(network)
    while coordinator.receive(timeout=PATIENCE) != Peer(PLANT, present=False):
        pass
    assert coordinator.reason_of(PLANT) == "no sugar"


def test_what_went_wrong_first_is_what_is_raised(coordinator: Bus) -> None:
    """Also where the session cannot be closed any more."""
    with pytest.raises(RunBroken, match="no sugar"):
        leave(Network(connect=(coordinator.locators()[0],), wait=PATIENCE), closed=True)


def test_threads_have_ended_when_a_participant_has_left(coordinator: Bus) -> None:
    """At exit they would come back from zenoh into an interpreter that is gone."""
    network = Network(connect=(coordinator.locators()[0],), wait=PATIENCE)
    threads = list[threading.Thread]()
    with Bus(network, run="test", who=PLANT) as plant:
        channel = plant.channel(MODE)

        def wait() -> None:
            threads.append(threading.current_thread())
            with contextlib.suppress(ChannelClosed):
                channel.next()

        plant.in_thread(wait, name="waiting")
    assert [thread.is_alive() for thread in threads] == [False]


def test_a_client_that_reaches_nobody_says_so() -> None:
    with pytest.raises(RunBroken, match=r"nobody answered at tcp/127\.0\.0\.1:1 within 0\.1 s"):
        Bus(Network(NONE, ("tcp/127.0.0.1:1",), 0.1), run="test", who=PLANT)
