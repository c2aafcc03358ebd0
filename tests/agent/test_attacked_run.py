"""A real run with keys, attacked from outside and from within: nothing is accepted, nobody stops, the replay agrees.

A sensor paces it, which this test plays: the run cannot end before the attack has.
"""

from __future__ import annotations

import json
import queue
import shutil
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import zenoh
from attackers import PATIENCE, SECONDS, configuration, let_in, wait_for_listeners, wait_for_peers
from runs import decoded, logged, run_here

from agent.authority import Authority
from agent.contract.gains import Gains
from agent.contract.keys import (
    ACKNOWLEDGED,
    CONTROL,
    EVENT,
    MODE,
    alive,
    estimate,
    key,
    measurement,
    participants,
    ready,
    replay,
)
from agent.contract.messages import Acknowledged, Control, Event
from agent.contract.rights import everybody, rights
from designer.replay import replay as replayed

RUN, STEPS, BEFORE = "test", 60, 30
BLOCK = zenoh.CongestionControl.BLOCK
LIES = {
    "control": Control(order="stop", steps=0, seed=0, window=1, external=[], reason="a lie").model_dump_json(),
    "acknowledged": Acknowledged(
        steps=STEPS, messages=1, missing=0, received={}, reached={}, lacking=[], closed=True
    ).model_dump_json(),
    "mode": '{"step":31,"mode":"no such mode"}',
    "measurement": '{"step":40,"y":[1e300,1e300]}',
    "estimate": '{"step":31,"x_hat":[7.0,7.0],"innovation":[7.0],"z_hat":[7.0],"mode":"","heard":[]}',
    "refused": "your place is taken",
}


class Sensor:
    """Of node n0."""

    def __init__(self, address: str, keys: Path, stack: ExitStack) -> None:
        self._session = stack.enter_context(zenoh.open(configuration(address, keys, "sensor-n0")))
        tokens, waiting = queue.SimpleQueue[zenoh.Sample](), {"node-n0", "recorder", "coordinator"}
        self._modes = queue.SimpleQueue[zenoh.Sample]()
        self._session.declare_subscriber(key(RUN, MODE), self._modes.put)
        self._session.liveliness().declare_subscriber(key(RUN, alive("*")), tokens.put, history=True)
        while waiting:
            waiting.discard(str(tokens.get(timeout=PATIENCE).key_expr).rpartition("/")[2])
        self._token = self._session.liveliness().declare_token(key(RUN, alive("sensor-n0")))

    def wait_for_mode(self, step: int) -> None:
        """Of that step; the run is then a window behind it, or less."""
        while json.loads(self._modes.get(timeout=PATIENCE).payload.to_string())["step"] < step:
            pass

    def measure(self, first: int, last: int) -> None:
        for step in range(first, last):
            y = json.dumps({"step": step, "y": [0.5]})
            self._session.put(key(RUN, measurement("n0")), y, congestion_control=BLOCK)


def lie(session: zenoh.Session, gains: Gains, who: str) -> None:
    """Everything that others say, and that would end the run or spoil it; then something that `who` may say."""
    wait_for_peers(session, len(participants(gains.problem)))
    topics = (MODE, CONTROL, ACKNOWLEDGED, ready("plant"), measurement("n0"), estimate("n0"), EVENT)
    wait_for_listeners(session, (key(RUN, topic, who=who) for topic in topics))
    for other, own in rights(gains.problem, run=RUN).items():
        if other == who:
            continue
        for expression in own.says:
            kind = next((kind for kind in LIES if kind in expression), "")
            session.put(expression.replace("*", "x"), LIES.get(kind, "garbage"), congestion_control=BLOCK)
            session.delete(expression.replace("*", "x"))
        for token in own.shows:
            session.liveliness().declare_token(token.replace("*", "00000000000000000000-x"))
        session.declare_queryable(key(RUN, replay(other)), lambda query: query.reply(query.key_expr, "garbage"))
    marker = Event(step=BEFORE, kind="marker", who=who, detail="all that was sent before has come").encode()
    session.put(key(RUN, "event", who=who), marker, congestion_control=BLOCK)


def test_nothing_of_what_attackers_say_is_accepted(pair: Gains, pair_path: Path, tmp_path: Path) -> None:
    """No certificate, another authority's, an expired one; and a node's own, which says what is not its to say."""
    keys, other, expired = (tmp_path / name for name in ("keys", "other", "expired"))
    keys.mkdir()
    other.mkdir()
    Authority.create(keys, pair.problem.name, days=1).issue(everybody(pair.problem), days=1)
    Authority.create(other, pair.problem.name, days=1).issue(["node-n1"], days=1)
    shutil.copytree(keys, expired)
    Authority.load(expired).issue(["node-n1"], days=-0.5)  # type: ignore[arg-type]
    got_in, recording, address = set[str](), tmp_path / "run.mcap", ""
    with ExitStack() as stack:
        sensor: Any = None

        def heed(word: dict[str, Any]) -> None:
            nonlocal sensor, address
            if "listening" in word:
                address = word["listening"][0]
                sensor = Sensor(address, keys, stack)
            if "started" in word:
                sensor.measure(0, BEFORE)
                sensor.wait_for_mode(BEFORE)
                attack()
                sensor.measure(BEFORE, STEPS)

        def attack() -> None:
            outsiders = {"none": (keys, ""), "another authority": (other, "node-n1"), "expired": (expired, "node-n1")}
            got_in.update(
                let_in({name: configuration(address, *each, seconds=SECONDS) for name, each in outsiders.items()})
            )
            lie(stack.enter_context(zenoh.open(configuration(address, keys, "node-n1"))), pair, "node-n1")

        summary = run_here(pair_path, recording, heed=heed, keys=keys, steps=STEPS, window=20, external=("n0",))
    assert got_in == set()
    assert (summary["steps"], summary["missing"], summary["broken_off"]) == (STEPS, 0, "")
    assert summary["refused"]["recorder"]["event"] == {"forged": 1}  # which came after all the rest
    events = [decoded(message) for message in logged(recording) if message.topic == "event"]
    first, *others, last = [event.kind for event in events if isinstance(event, Event)]
    assert (first, set(others) - {"refused"}, last) == ("start", set(), "end")
    verdict = replayed(recording)
    assert verdict.exit_code == 0, verdict.text()
