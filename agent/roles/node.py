"""A sensor node: measurement in, estimate out, the others' estimates in, one step of the filter."""

from __future__ import annotations

import numpy as np
from pydantic import ValidationError

from agent.bus import Bus, Incoming, Sample
from agent.contract.errors import RunBroken
from agent.contract.gains import Gains
from agent.contract.messages import MODE, Estimate, estimate, measurement, model_of
from agent.filter import Pair, innovation, step
from agent.inbox import Inbox
from agent.roles.joining import join


def run(bus: Bus, gains: Gains, *, node: str) -> None:
    """Take part as node `node` until the run is closed (Bus.receive raises RunClosed)."""
    own = gains.for_node(node)
    inbox = Inbox(own)
    problem = gains.problem
    heard = [problem.node_names[j] for j in problem.ever_heard(problem.node_index(node))]
    bus.subscribe([MODE, measurement(node), *(estimate(sender) for sender in heard if sender != node)])
    bus.advertise([estimate(node)])
    join(bus, gains)

    k = 0
    x_hat = np.zeros(problem.nx)
    made_by: tuple[str, list[str]] = ("", [])  # the mode and the senders that made x_hat
    while True:
        while (y := inbox.measurement) is None:
            _take_in(inbox, bus.receive())
        pair = Pair(x_hat, innovation(own, y, x_hat))
        try:
            sent = Estimate(
                step=k,
                x_hat=pair.x_hat.tolist(),
                innovation=pair.innovation.tolist(),
                z_hat=(own.M @ x_hat).tolist(),
                mode=made_by[0],
                heard=made_by[1],
            )
        except ValidationError:  # a message refuses NaN and infinity
            raise RunBroken(f'the estimate of node "{node}" is not finite at step {k}; its gains let it grow') from None
        bus.publish(estimate(node), sent)
        inbox.put(node, sent)
        while (lacking := inbox.lacking) > 0:
            _take_in(inbox, bus.receive(lacking))
        mode, heard_now = inbox.mode, inbox.heard
        assert mode is not None
        x_hat, made_by = step(own, mode, heard_now), (mode, list(heard_now))
        inbox.next_step()
        k += 1


def _take_in(inbox: Inbox, items: list[Incoming]) -> None:
    for item in items:
        if not isinstance(item, Sample):
            continue
        model = model_of(item.topic)
        assert model is not None  # only topics of the table are subscribed to
        sender = item.topic.split("/")[1] if item.topic.startswith("node/") else ""
        try:
            inbox.put(sender, model.decode(item.payload))
        except (ValidationError, ValueError) as error:
            raise RunBroken(f"a message on {item.topic} cannot be used: {error}") from None
