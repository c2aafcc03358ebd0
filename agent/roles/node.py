"""A sensor node: measurement in, estimate out, the others' estimates in, one step of the filter."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from functools import partial
from itertools import count

import numpy as np

from agent.contract.gains import Gains, NodeGains
from agent.contract.keys import ACCOUNT, EVENT, MODE, PLANT, estimate, measurement, node_who, sensor_who
from agent.contract.messages import Account, Control, Estimate, Message, Mode, Way
from agent.contract.schedule import Deliveries
from agent.estimates import told
from agent.faults import Arriving, Ordeal, parse
from agent.filter import Pair, Step, innovation, step
from agent.inbox import Inbox
from agent.network.arrivals import Arrivals, way
from agent.network.bus import Bus
from agent.network.gate import Admitted, Arrived, Gate
from agent.network.words import Sample
from agent.pacing.node import PacedNode
from agent.plan import Pace
from agent.roles.joining import take_part
from agent.roles.suffering import suffer


def run(bus: Bus, gains: Gains, *, node: str, step: Step = step) -> None:
    """Take part as node `node` until the run has ended; `step` is its filter, where it has one of its own."""
    problem, own = gains.problem, gains.for_node(node)
    i = problem.node_index(node)
    senders = {problem.node_names[j]: j for j in problem.ever_heard(i)}
    modes, measurements = bus.channel(MODE), bus.channel(measurement(node))
    estimates = {sender: bus.channel(estimate(sender)) for sender in senders if sender != node}
    bus.advertise([estimate(node), EVENT, ACCOUNT])

    def work(start: Control) -> None:
        deliveries = Deliveries(problem, seed=start.seed)

        def lost(k: int) -> set[str]:
            """Losses of the model: the message is there, and counts as if it were not."""
            phi = deliveries.at(k)[i]
            return {sender for sender, j in senders.items() if not phi[j]}

        if not start.period:
            _in_lock_step(bus, own, lost, modes, measurements, estimates, step)
            return
        bus.trace()
        sensor = sensor_who(node) if node in start.external else PLANT
        paced = PacedNode(
            own,
            Pace(start.period, start.measure_by, start.hear_by),
            steps=start.steps,
            lost=lost,
            is_there=lambda topic: (sensor if topic == measurement(node) else _node_of(topic)) in bus.present,
            begins=start.step == 0,
            filter_step=step,
        )
        faults = [parse(text, problem, steps=start.steps) for text in start.faults]
        arriving = Arriving(faults, problem, node, seed=start.seed)
        ordeal = Ordeal(faults, node_who(node), begin=start.step, again=bus.is_late)
        arrivals = Arrivals(
            [gate.arrived for gate in (modes, measurements, *estimates.values())],
            in_thread=bus.in_thread,
            overflow=lambda arrived: arrived.gate.overflow(),
        )
        _against_the_clock(bus, paced, arrivals, node, arriving=arriving, ordeal=ordeal)

    take_part(bus, gains, work)


def _in_lock_step(
    bus: Bus,
    own: NodeGains,
    lost: Callable[[int], set[str]],
    modes: Gate,
    measurements: Gate,
    estimates: Mapping[str, Gate],
    filter_step: Step,
) -> None:
    """Step after step, each once everything is there, until a channel closes."""
    inbox, x_hat = Inbox(own), np.zeros(own.M.shape[1])
    mode, heard = "", list[str]()  # what made x_hat
    for k in count():
        while inbox.y is None:
            _put(inbox, measurements.next())
        sent = told(own, k, Pair(x_hat, innovation(own, inbox.y, x_hat)), mode=mode, heard=heard)
        bus.publish(estimate(own.node), sent)
        inbox.put(own.node, sent)
        while inbox.mode is None:
            _put(inbox, modes.next())
        while (sender := inbox.lacking) is not None:
            _put(inbox, estimates[sender].next())
        mode, pairs = inbox.mode, inbox.heard(lost=lost(k))
        x_hat, heard = filter_step(own, mode, pairs), list(pairs)
        inbox.next_step()
        for sender in estimates.keys() - set(heard):  # whose message was not needed must not pile up
            for admitted in estimates[sender].waiting():
                _put(inbox, admitted)


def _against_the_clock(
    bus: Bus, paced: PacedNode, arrivals: Arrivals[Arrived], node: str, *, arriving: Arriving, ordeal: Ordeal
) -> None:
    """Steps as they are due, until all are made or a channel closes."""
    while not paced.done:
        for (gate, sample), at in arrivals.until(paced.wake):
            topic, admitted = gate.topic, gate.open(sample)
            if admitted is None:
                paced.refused(topic, at)
                continue
            sender, message = _sender(topic), admitted.message
            delay = arriving.delay(topic, message.step)
            if delay < math.inf:
                paced.take(sender, message, at + delay, partial(_way, sample, at, delay))
            if isinstance(message, Mode):
                suffer(ordeal.due(message.step))
                bus.step = max(bus.step, message.step + 1)
        for message in paced.advance(time.monotonic()):
            if isinstance(message, Account):
                message = message.model_copy(update={"processor": time.process_time()})
            bus.publish(_topic_of(message, node), message)
            paced.published(message, time.monotonic())


def _way(sample: Sample, at: float, delay: float) -> Way | None:
    """Where a message that arrived `at` spent its time; a delay that a fault asks for is one of the wire."""
    found = way(sample, at)
    return None if found is None else found._replace(wire=found.wire + delay)


def _topic_of(message: Message, node: str) -> str:
    match message:
        case Estimate():
            return estimate(node)
        case Account():
            return ACCOUNT
    return EVENT


def _node_of(topic: str) -> str:
    return node_who(topic.split("/")[1])


def _sender(topic: str) -> str:
    """The node that a message is from or for, "" for the mode."""
    return topic.split("/")[1] if topic != MODE else ""


def _put(inbox: Inbox, admitted: Admitted) -> None:
    inbox.put(_sender(admitted.topic), admitted.message)
