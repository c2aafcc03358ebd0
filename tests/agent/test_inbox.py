"""A node steps on what belongs to its step: whatever the order of arrival, never on anything else."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from made_recordings import observer_gains, random_gains, random_problem, real_problem, simulate

from agent.contract.gains import Gains
from agent.contract.keys import model_of
from agent.contract.messages import Estimate, Measurement, Message, Mode
from agent.filter import step
from agent.inbox import Inbox

STEPS = 5
GAINS = random_gains(random_problem(5, ny=(1, 2, 1), modes=2))
NODE = "n2"


class Letter(NamedTuple):
    """A message, and the node it is from, "" for mode and measurement."""

    sender: str
    message: Message


def letters(gains: Gains, node: str) -> list[Letter]:
    """What `node` gets in a run, in the order in which it came about."""
    own = gains.for_node(node)
    senders = {link.sender for links in own.links.values() for link in links}
    topics = {"mode": "", f"node/{node}/measurement": ""} | {f"node/{sender}/estimate": sender for sender in senders}
    found = []
    for sent in simulate(gains, steps=STEPS):
        if sent.topic in topics:
            model = model_of(sent.topic)
            assert model is not None
            found.append(Letter(topics[sent.topic], model(**sent.document)))
    return found


LETTERS = letters(GAINS, NODE)


def walked(inbox: Inbox) -> list[list[float]]:
    """x_hat(1), x_hat(2), ... as far as the inbox's messages allow."""
    own, x_hats = GAINS.for_node(NODE), []
    while inbox.y is not None and inbox.mode is not None and inbox.lacking is None:
        x_hats.append(step(own, inbox.mode, inbox.heard()).tolist())
        inbox.next_step()
    return x_hats


def filled(letters: list[Letter]) -> Inbox:
    inbox = Inbox(GAINS.for_node(NODE))
    for letter in letters:
        inbox.put(*letter)
    return inbox


@given(st.permutations(LETTERS))
def test_any_order_of_arrival_gives_the_same_steps(letters: list[Letter]) -> None:
    """Bit for bit, though most messages come before their step; and they are the run's, whose sums are others."""
    x_hats = walked(filled(letters))
    assert x_hats == walked(filled(LETTERS))
    assert len(x_hats) == STEPS
    told = [
        letter.message.x_hat
        for letter in LETTERS
        if isinstance(letter.message, Estimate) and letter.sender == NODE and letter.message.step > 0
    ]
    np.testing.assert_allclose(x_hats[:-1], told, rtol=1e-12, atol=1e-14)


@given(st.lists(st.sampled_from(LETTERS), max_size=60))
def test_duplicates_change_nothing(more: list[Letter]) -> None:
    assert walked(filled([*more, *LETTERS, *more])) == walked(filled(LETTERS))


def test_without_a_message_of_its_own_a_step_waits() -> None:
    """Every message is needed: without any one of them the node stops at that message's step."""
    own = GAINS.for_node(NODE)
    gone = [letter.message.mode for letter in LETTERS if isinstance(letter.message, Mode)]
    for missing in LETTERS:
        k = missing.message.step
        needed = missing.sender == "" or missing.sender in [link.sender for link in own.links[gone[k]]]
        steps = len(walked(filled([letter for letter in LETTERS if letter != missing])))
        assert steps == (k if needed else STEPS)


def test_what_is_missing_is_named_in_turn() -> None:
    """First the measurement, then the mode, then the first of the nodes that the mode hears."""
    inbox = Inbox(GAINS.for_node(NODE))
    assert inbox.y is None
    inbox.put("", Measurement(step=0, y=[1.0]))
    assert inbox.y is not None
    assert inbox.y.tolist() == [1.0]
    assert inbox.mode is None
    mode = max(GAINS.problem.mode_names, key=lambda mode: len(GAINS.for_node(NODE).links[mode]))
    inbox.put("", Mode(step=0, mode=mode))
    senders = [link.sender for link in GAINS.for_node(NODE).links[mode]]
    assert len(senders) > 1
    for sender in senders:
        assert inbox.lacking == sender
        ny = len(GAINS.problem.nodes[GAINS.problem.node_index(sender)].C)
        inbox.put(sender, Estimate(step=0, x_hat=[0.0] * 2, innovation=[0.0] * ny, z_hat=[], mode="", heard=[]))
    assert inbox.lacking is None
    assert list(inbox.heard()) == senders


def test_what_belongs_to_a_finished_step_is_dropped() -> None:
    """A late duplicate, as a replay brings it, is not taken for the present step and not kept."""
    inbox = filled([letter for letter in LETTERS if letter.message.step < 2])
    assert len(walked(inbox)) == 2
    for letter in LETTERS:
        if letter.message.step < 2:
            inbox.put(*letter)
    assert (inbox.y, inbox.mode) == (None, None)
    kept = (inbox._measurements, inbox._modes, inbox._pairs)
    assert not any(step < 2 for steps in kept for step in steps)


def test_early_messages_do_not_serve_an_earlier_step() -> None:
    inbox = filled([letter for letter in LETTERS if letter.message.step > 0])
    assert (inbox.y, inbox.mode) == (None, None)
    assert walked(inbox) == []


def test_nothing_piles_up() -> None:
    """After its last step an inbox is empty, though it has heard nodes that no mode of the run asked for."""
    inbox = filled(LETTERS)
    walked(inbox)
    assert not any((inbox._measurements, inbox._modes, dict(inbox._pairs)))


def test_of_two_messages_of_a_step_the_first_counts() -> None:
    """Whoever comes second, and says something else, is too late."""
    others = [letter._replace(message=other(letter.message)) for letter in LETTERS]
    assert walked(filled([*LETTERS, *others])) == walked(filled(LETTERS))
    assert walked(filled([*others, *LETTERS])) != walked(filled(LETTERS))


def other(message: Message) -> Message:
    """One of the same step that says something else."""
    match message:
        case Mode(mode=mode):
            return message.model_copy(update={"mode": next(name for name in GAINS.problem.mode_names if name != mode)})
        case Measurement(y=y):
            return message.model_copy(update={"y": [value + 1.0 for value in y]})
        case Estimate(x_hat=x_hat):
            return message.model_copy(update={"x_hat": [value + 1.0 for value in x_hat]})
    return message


def test_every_node_of_a_run_can_be_walked() -> None:
    """Nodes with 1 and 2 measurements, in every mode."""
    for node in GAINS.problem.node_names:
        inbox, own = Inbox(GAINS.for_node(node)), GAINS.for_node(node)
        for letter in letters(GAINS, node):
            inbox.put(*letter)
        for _ in range(STEPS):
            assert inbox.mode is not None
            assert np.isfinite(step(own, inbox.mode, inbox.heard())).all()
            inbox.next_step()


# a node that sees its losses, and messages that are lost
def test_an_empty_measurement_is_legal_where_losses_are_seen() -> None:
    """And is not taken for one that is missing."""
    gains = observer_gains(real_problem(5, ny=(1, 2, 1)))
    inbox = Inbox(gains.for_node("n1"))
    assert inbox.y is None
    inbox.put("", Measurement(step=0, y=[]))
    assert inbox.y is not None
    assert inbox.y.tolist() == []


def test_a_lost_message_must_have_come_but_is_not_heard() -> None:
    """A modelled loss is data: the step waits for the message all the same, and then does as if it had not come."""
    inbox = filled([letter for letter in LETTERS if letter.sender != "n1"])
    k = next(k for k in range(STEPS) if "n1" in {link.sender for link in GAINS.for_node(NODE).links[modes_of_run()[k]]})
    for _ in range(k):
        inbox.next_step()
    assert inbox.mode is not None
    assert inbox.lacking == "n1"
    for letter in LETTERS:
        if letter.sender == "n1":
            inbox.put(*letter)
    assert inbox.lacking is None
    assert "n1" in inbox.heard()
    assert list(inbox.heard(lost={"n1"})) == [sender for sender in inbox.heard() if sender != "n1"]


def modes_of_run() -> list[str]:
    return [letter.message.mode for letter in LETTERS if isinstance(letter.message, Mode)]
