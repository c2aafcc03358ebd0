"""A sensor node: measurement in, estimate out, the others' estimates in, one step of the filter."""

from __future__ import annotations

from itertools import count

import numpy as np
from pydantic import ValidationError

from agent.contract.arrays import Array
from agent.contract.errors import RunBroken
from agent.contract.gains import Gains, NodeGains
from agent.contract.keys import MODE, decode, estimate, measurement
from agent.contract.messages import Control, Estimate
from agent.contract.schedule import Deliveries
from agent.filter import innovation, step
from agent.inbox import Inbox
from agent.network.bus import Bus
from agent.network.words import Sample
from agent.roles.joining import take_part


def run(bus: Bus, gains: Gains, *, node: str) -> None:
    """Take part as node `node` until the run has ended."""
    problem, own = gains.problem, gains.for_node(node)
    i = problem.node_index(node)
    senders = {problem.node_names[j]: j for j in problem.ever_heard(i)}
    modes, measurements = bus.channel(MODE), bus.channel(measurement(node))
    estimates = {sender: bus.channel(estimate(sender)) for sender in senders if sender != node}
    bus.advertise([estimate(node)])

    def work(start: Control) -> None:
        inbox, deliveries = Inbox(own), Deliveries(problem, seed=start.seed)
        x_hat = np.zeros(problem.nx)
        mode, heard = "", list[str]()  # what made x_hat
        for k in count():
            while inbox.y is None:
                _put(inbox, measurements.next())
            sent = _sent(own, k, x_hat, inbox.y, mode, heard)
            bus.publish(estimate(node), sent)
            inbox.put(node, sent)
            while inbox.mode is None:
                _put(inbox, modes.next())
            while (sender := inbox.lacking) is not None:
                _put(inbox, estimates[sender].next())
            phi = deliveries.at(k)[i]  # a loss of the model: the message is there, and counts as if it were not
            mode, pairs = inbox.mode, inbox.heard(lost={sender for sender, j in senders.items() if not phi[j]})
            x_hat, heard = step(own, mode, pairs), list(pairs)
            inbox.next_step()
            for sender in estimates.keys() - set(heard):  # whose message was not needed must not pile up
                for sample in estimates[sender].waiting():
                    _put(inbox, sample)

    take_part(bus, gains, work)


def _sent(own: NodeGains, k: int, x_hat: Array, y: Array, mode: str, heard: list[str]) -> Estimate:
    try:
        return Estimate(
            step=k,
            x_hat=x_hat.tolist(),
            innovation=innovation(own, y, x_hat).tolist(),
            z_hat=(own.M @ x_hat).tolist(),
            mode=mode,
            heard=heard,
        )
    except ValidationError:  # a message refuses NaN and infinity
        raise RunBroken(f'the estimate of node "{own.node}" is not finite at step {k}; its gains let it grow') from None


def _put(inbox: Inbox, sample: Sample) -> None:
    sender = sample.topic.split("/")[1] if sample.topic != MODE else ""
    try:
        inbox.put(sender, decode(sample.topic, sample.payload))
    except ValueError as error:
        raise RunBroken(f"a message on {sample.topic} cannot be used: {error}") from None
