"""How every participant but the coordinator joins a run, and how the publishers take part and leave."""

from __future__ import annotations

from collections.abc import Callable
from importlib.metadata import version

from agent.contract.errors import InputError, Interrupted, RecordingFailed, RunBroken, counted
from agent.contract.gains import Gains
from agent.contract.keys import COORDINATOR, PLANT, RECORDER, in_words
from agent.contract.messages import Control
from agent.network.acquaintance import refuse_version
from agent.network.bus import Bus
from agent.network.links import linked
from agent.network.words import ChannelClosed, RunClosed, UnderWay


def join(bus: Bus, gains: Gains) -> Control:
    """Enter, meet whom we deal with, say so, and wait for the start. Topics must be declared before.

    A paced run that has begun without us is joined where it is. InputError where it is one of other gains.
    """
    bus.guard.know(gains.problem)
    bus.enter()
    try:
        start = _met(bus, gains)
        bus.guard.begin(steps=start.steps, external=tuple(start.external), paced=start.period > 0.0)
        bus.has_begun, bus.is_late = True, start.step > 0
        bus.patient, bus.identity = start.period > 0.0, start.identity
        if start.period:
            bus.wait_for_nobody()
        if start.step and bus.who != RECORDER:
            bus.greeted()
        return start
    except RunClosed as closed:
        late = f"the run had ended before {in_words(bus.who)} could join it"
        raise RunBroken(closed.control.reason or late) from None


def _met(bus: Bus, gains: Gains) -> Control:
    """The order to start."""
    try:
        for _ in bus.meet(linked(gains.problem, bus.who) - {PLANT}):
            pass  # the plant meets us; whether there is one, the coordinator knows
        bus.report_ready(gains.digest())
        start = bus.wait_for_start()
    except UnderWay as run:
        start = run.start
        bus.report_ready(gains.digest())
    refuse_version(COORDINATOR, start.version, own=version("peakmesh"))
    if start.step and start.gains != gains.digest():
        raise InputError(
            f"the run that {in_words(bus.who)} would join has other gains ({start.gains[:12]}...) than its own "
            f"({gains.digest()[:12]}...); give everybody the same gains file"
        )
    return start


def take_part(bus: Bus, gains: Gains, work: Callable[[Control], None]) -> None:
    """Join, do `work` in a thread of its own until the coordinator ends the run, stay until all is recorded.

    Meanwhile the main thread answers replays and watches for the end. Raises RunBroken where the run was stopped
    or its recording may lack something, and whatever `work` raises.
    """
    start = join(bus, gains)

    def guarded() -> None:
        try:
            work(start)
        except ChannelClosed:
            return
        except Exception as error:
            bus.fail(error)

    bus.in_thread(guarded, name="work")
    try:
        while True:
            bus.receive()
    except Interrupted as asked:
        bus.wait_until_recorded()
        if bus.unrecorded:
            asked.args = (f"{asked}; the recorder has not got {counted(bus.unrecorded, 'message')} of ours",)
        raise
    except RunClosed as closed:
        bus.is_over = True
        last_word = bus.wait_for_close()
        if closed.control.order == "stop":
            raise RunBroken(closed.control.reason) from None
        if last_word is None:
            raise RunBroken("the recorder did not say that the recording is closed; it may lack messages") from None
        if last_word.broken_off is not None:
            raise RecordingFailed(f"the run has ended, but {last_word.broken_off}") from None
        if bus.unrecorded:
            raise RunBroken(f"the recording was closed without {counted(bus.unrecorded, 'message')} of ours") from None
