"""Strangers in a run: nothing of theirs is taken for anything, nobody stops, and what came of them is told.

The stranger is a sensor of one node at the same time, so that it decides when the run goes on: every attack meets a run
that is under way, however busy the machine is.
"""

from __future__ import annotations

import json
import queue
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

from runs import PATIENCE, logged, run_here
from strangers import Heard, Stranger, stranger, until

from agent.contract.errors import RunBroken
from agent.contract.gains import Gains
from agent.contract.keys import ACKNOWLEDGED, CONTROL, COORDINATOR, EVENT, MODE, PLANT, PLANT_STATE, RECORDER
from agent.contract.messages import Acknowledged, Control, Ready, Stamp, digest_of
from agent.guard import (
    FORGED,
    INFINITE,
    MISNUMBERED,
    MISSHAPEN,
    OVERSIZED,
    READY,
    REPEATED,
    UNREADABLE,
    UNTIMELY,
    Counts,
)
from agent.network.session import CAPACITY
from designer.replay import replay

GARBAGE = (b"\xff\x00garbage{", b"", b"[" * 5000)
STOP = Control(order="stop", steps=1, seed=0, window=1, external=[], reason="forged")
ALL = Acknowledged(steps=10**9, messages=10**9, missing=0, received={PLANT: 10**9}, reached={}, lacking=[], closed=True)


class Sensor:
    """The sensor of node `node`, in the hands of a stranger."""

    def __init__(self, peer: Stranger, gains: Gains, node: str) -> None:
        self.peer, self.node = peer, node
        self._ny = len(gains.problem.nodes[gains.problem.node_index(node)].C)
        self.topic = f"node/{node}/measurement"
        self.own = peer.listen(f"node/{node}/estimate")
        tokens = peer.tokens("alive/*")
        waiting = {f"alive/node-{node}", "alive/recorder", "alive/coordinator"}
        while waiting:
            waiting.discard(tokens.get(timeout=PATIENCE))
        peer.show(f"alive/sensor-{node}")

    def measure(self, *steps: int) -> None:
        for step in steps:
            self.peer.put(self.topic, {"step": step, "y": [0.25] * self._ny})

    def wait_for(self, step: int) -> None:
        """Until the node has used the measurement of a step."""
        while self.own.get(timeout=PATIENCE).document["step"] < step:
            pass


def attacked(
    gains_path: Path, recording: Path, attack: Callable[[Stranger, Callable[[], object]], None], **plan: Any
) -> dict[str, Any]:
    """The summary of a run during which `attack` goes on in a thread; the second thing that it is given waits until
    the run is over."""
    failures: list[BaseException] = []
    threads: list[threading.Thread] = []
    over = threading.Event()

    def guarded(address: str) -> None:
        try:
            with stranger(address) as peer:
                attack(peer, lambda: over.wait(PATIENCE))
        except BaseException as error:
            failures.append(error)

    def begin(word: dict[str, Any]) -> None:
        if "listening" in word:
            threads.append(threading.Thread(target=guarded, args=(word["listening"][0],), daemon=True))
            threads[0].start()

    try:
        return run_here(gains_path, recording, heed=begin, **plan)
    except RunBroken as broken:
        raise broken from next(iter(failures), None)  # what the attack found first
    finally:
        over.set()
        threads[0].join(10.0 if failures else PATIENCE)


def forgeries(peer: Stranger, gains: Gains) -> None:
    """What comes from nobody: without a stamp, with a strange one, with that of somebody else."""
    name = gains.problem.node_names[1]
    lie = {"x_hat": [5.0, 5.0], "innovation": [1.0], "z_hat": [5.0], "mode": "mode-0", "heard": [name]}
    state = {"x": [9.0, 9.0], "z": [9.0], "w": [0.0], "arrived": [1, 1]}
    messages = {
        MODE: {"mode": "mode-1"},
        PLANT_STATE: state,
        f"node/{name}/measurement": {"y": [50.0, 50.0]},
        f"node/{name}/estimate": lie,
        f"{EVENT}/{COORDINATOR}": {"kind": "end", "who": COORDINATOR, "detail": "all steps are done"},
    }
    for topic, message in messages.items():
        for payload in GARBAGE:
            peer.put(topic, payload)
        for step in (3, 12, 10**9):
            peer.put(topic, {"step": step, **message})
        for stamp in (b"abc", b"\0" * 16 + b"\xff\xfe", Stamp(12, 5, "ghost"), Stamp(12, 5, f"node-{name}"),
                      Stamp(12, 5, COORDINATOR, b"d" * 16, b"session.")):  # fmt: skip
            peer.put(topic, {"step": 12, **message}, stamp)


def copied_session(peer: Stranger, topic: str, heard: queue.SimpleQueue[Heard]) -> None:
    """What comes from somebody who has taken care to copy who speaks there, and still does not fit."""
    old = heard.get(timeout=PATIENCE)
    assert old.attachment is not None
    stamp, right = Stamp.decode(old.attachment), old.document
    x_hat, name = right["x_hat"], topic.split("/")[1]

    def put(number: int = 100, **change: object) -> None:
        payload = json.dumps(right | change).encode()
        peer.put(topic, payload, stamp._replace(number=number, digest=digest_of(topic, payload)))

    put(x_hat=[float("nan"), 0.0])
    put(x_hat=[1e141, 0.0])
    put(x_hat=[*x_hat, 0.0])
    put(heard=["nobody"])
    put(mode="nothing")
    put(step=10**9)
    put(step="11")
    put(more=1)
    put(detail="x" * 10_000)
    put(number=2**40)
    peer.put(topic, old.payload, old.attachment)
    peer.put(f"node/{name}/measurement", {"step": 11, "y": [1.0, 2.0]}, stamp)


def foreign_words(peer: Stranger, gains: Gains) -> None:
    """Control, acknowledgements, and who says that he is ready, or that a place is taken."""
    for payload in GARBAGE:
        for topic in (CONTROL, ACKNOWLEDGED, f"ready/{PLANT}", "refusals/x"):
            peer.put(topic, payload)
    for order in ("stop", "close", "start"):
        for session in ("", "somebody"):
            peer.put(CONTROL, STOP.model_copy(update={"order": order, "session": session}).model_dump())
    for update in ({}, {"closed": False}, {"steps": -5}, {"steps": 0, "closed": False}):
        peer.put(ACKNOWLEDGED, ALL.model_copy(update=update).model_dump())
    for who in ("ghost", PLANT):
        peer.put(f"ready/{who}", Ready(who=who, gains="y" * 64).model_dump())
    sessions = peer.tokens("session/**")
    for _ in range(len(gains.problem.node_names) + 3):
        _, who, identity = sessions.get(timeout=PATIENCE).split("/")
        peer.put(f"refused/{who}/{identity}", b"go away")


def strange_tokens(peer: Stranger) -> None:
    """Names that are taken, shown and withdrawn again."""
    for who in (COORDINATOR, RECORDER, PLANT, "node-n1", "ghost"):
        for withdraw in [peer.show(f"alive/{who}"), peer.show(f"session/{who}/0-stranger")]:
            withdraw()


class Told:
    """What the coordinator's events say was refused."""

    def __init__(self, peer: Stranger) -> None:
        self._events = peer.listen(f"{EVENT}/{COORDINATOR}")
        self.texts: list[str] = []

    def has(self, *words: str) -> bool:
        while True:
            try:
                event = self._events.get_nowait()
            except queue.Empty:
                break
            if b'"kind":"refused"' in event.payload:  # the stranger hears what it says itself, too
                self.texts.append(event.document["detail"])
        return any(all(word in text for word in words) for text in self.texts)


def test_nothing_that_strangers_say_is_taken_for_anything(pair_path: Path, tmp_path: Path, pair: Gains) -> None:
    """In lock-step: garbage, forgeries, foreign words, wrong answers, strange tokens, floods. The run ends well, its
    recording holds nothing of it but events that tell of it, and nobody was held up for good."""
    steps, rest, flood = 60, 10, CAPACITY + 2000
    name, other = pair.problem.node_names

    def attack(peer: Stranger, stay: Callable[[], object]) -> None:
        heard = peer.listen(f"node/{other}/estimate")
        sensor, told = Sensor(peer, pair, name), Told(peer)
        last_words = [(who, f"on {CONTROL}: ", "6 forged", "3 unread") for who in ("the plant", f'node "{other}"')]
        last_words += [(who, f"on node/{other}/estimate: ", f"{9 + flood} forged") for who in ("the rec", f'"{name}"')]
        last_words += [("the recorder", f"on {EVENT}: ", f"{9 + flood} forged"), ("the coord", f"on {READY}: ")]
        sensor.measure(*range(rest))
        sensor.wait_for(rest - 1)
        forgeries(peer, pair)
        copied_session(peer, f"node/{other}/estimate", heard)
        foreign_words(peer, pair)
        strange_tokens(peer)
        for text in (b"{", b'{"step":10,"y":[NaN]}', b'{"step":10,"y":[1e308]}', b'{"step":10,"y":[1.0,2.0]}',
                     b'{"step":10.5,"y":[1.0]}', b'{"step":1000000,"y":[1.0]}', b'{"step":3,"y":[7.0]}'):  # fmt: skip
            peer.put(sensor.topic, text)
        for _ in range(flood):
            peer.put(f"node/{other}/estimate", b'{"step":1000000}')
            peer.put(f"{EVENT}/{other}", b"x")
        assert peer.ask("replay/node-n1?from=0;_anyke") == []
        peer.answer("replay/**", ("a", b"x", None), *(("peakmesh/test/" + key, b"x", None) for key in ("x", MODE)))
        until(lambda: peer.answers, "the recorder has asked for nothing")
        for step in range(rest, steps):
            sensor.measure(step)
            sensor.wait_for(step)
            if step == rest + 2:  # by now everybody has met what was sent, and soon says so
                for words in last_words:
                    until(lambda words=words: told.has(*words), f"{words} were never told, but {told.texts}")
        stay()

    summary = attacked(pair_path, tmp_path / "run.mcap", attack, steps=steps, external=(name,), window=4)
    assert (summary["missing"], summary["recorded_steps"], summary["broken_off"]) == (0, steps, "")
    refused: dict[str, Counts] = summary["refused"]
    of_sensor = {UNREADABLE: 2, INFINITE: 2, MISSHAPEN: 1, UNTIMELY: 1, REPEATED: 1}
    assert refused[f"node-{name}"][f"node/{name}/measurement"] == of_sensor
    assert refused[RECORDER][f"node/{name}/measurement"] == of_sensor
    of_nobody = {FORGED: 9, UNREADABLE: 2}
    of_careful = {INFINITE: 2, MISSHAPEN: 3, UNTIMELY: 1, OVERSIZED: 1, MISNUMBERED: 1}
    of_careful[UNREADABLE] = 2 + of_nobody[UNREADABLE]
    for topic in (MODE, PLANT_STATE):
        assert refused[RECORDER][topic] == of_nobody
    assert refused[RECORDER][f"node/{other}/measurement"] == of_nobody | {FORGED: 10}
    assert refused[RECORDER][EVENT] == of_nobody | {FORGED: 9 + flood}
    assert refused[RECORDER][f"node/{other}/estimate"] == of_careful | {FORGED: 9 + flood}
    assert refused[f"node-{name}"][f"node/{other}/estimate"] == of_careful | {FORGED: 9 + flood, REPEATED: 1}
    for who in (RECORDER, PLANT, f"node-{name}"):
        assert refused[who][CONTROL] == {UNREADABLE: 3, FORGED: 6}
    assert refused[COORDINATOR][READY] == {UNREADABLE: 3, FORGED: 2}
    verdict = replay(tmp_path / "run.mcap")
    assert (verdict.exit_code, verdict.evidence.total) == (0, 0)
    assert any("has refused" in note for note in verdict.notes)
    assert {json.loads(m.payload)["who"] for m in logged(tmp_path / "run.mcap") if m.topic == EVENT} == {COORDINATOR}
