"""What must hold of every run, whatever happened. Each law yields sentences about what does not hold."""

from __future__ import annotations

import json
import math
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator
from itertools import combinations

from agent.contract.errors import PeakmeshError
from agent.contract.keys import COORDINATOR, estimate, node_who
from agent.contract.recording.parts import files_of
from agent.network.words import Refused
from designer.replay import replay
from simulated.network import LEASE
from simulated.world import Outcome, place_of


def nobody_hangs(outcome: Outcome) -> Iterator[str]:
    if outcome.hung:
        yield outcome.hung


def everybody_ends_with_an_honest_word(outcome: Outcome) -> Iterator[str]:
    """Success, or one sentence; never a traceback."""
    for member in outcome.members:
        error = member.process.error
        for crash in [*member.process.crashes, *([error] if error is not None else [])]:
            if not isinstance(crash, PeakmeshError):
                yield f"{member.process.name} ended in {type(crash).__name__}: {crash}"
            elif not str(crash) or "\n" in str(crash):
                yield f"{member.process.name} ended without one sentence: {crash!r}"


def a_fair_run_succeeds(outcome: Outcome) -> Iterator[str]:
    """Where nothing happened that a run does not survive, everybody is content, and nothing is missing."""
    if outcome.scenario.is_fair:
        for member in outcome.members:
            if member.process.error is not None:
                yield f"{member.process.name} gave up though nothing had happened: {member.sentence}"
        if outcome.summary is not None and (missing := outcome.summary.missing):
            yield f"{missing} messages are missing though nothing had happened"


def a_paced_run_survives(outcome: Outcome) -> Iterator[str]:
    """Whoever is killed, stands still or is cut off for less than the lease, once it has begun and before it ends."""
    scenario = outcome.scenario
    if scenario.plan.pace is None or outcome.summary is not None:
        return
    kinds = {trouble.kind for trouble in scenario.troubles}
    times = [trouble.at for trouble in scenario.troubles]
    steps = [int(fault.rpartition("step=")[2].partition(",")[0]) for fault in scenario.plan.faults if "step=" in fault]
    in_time = all(0.0 <= at <= LAST for at in [*times, *(step / scenario.plan.steps for step in steps)])
    in_time &= all(trouble.seconds < LEASE for trouble in scenario.troubles)
    if in_time and kinds <= {"kill", "freeze", "part"}:
        last = [member for member in outcome.members if member.who == COORDINATOR][-1]
        yield f"the run did not survive: {last.sentence}"


def what_succeeds_is_recorded(outcome: Outcome) -> Iterator[str]:
    """When a run says success, the recording has what was published, once, and what the summary counts."""
    summary = outcome.summary
    if summary is None or summary.broken_off:
        return
    if not outcome.recording.exists():
        yield f"the run says success, and the recording is {[path.name for path in files_of(outcome.recording)]}"
        return
    recorded = outcome.recorded
    published = Counter(place_of(p.sent) for p in outcome.published)
    if doubled := [place for place, times in recorded.items() if times > published[place]]:
        yield f"{len(doubled)} messages are recorded that were not published so often, such as {doubled[0]}"
    excused = {m.process.name for m in outcome.members if m.process.was_killed or m.process.error is not None}
    if lost := [p for p in outcome.unrecorded if p.who not in excused]:
        yield f"{len(lost)} messages are not recorded, such as number {lost[0].sent.stamp.number} of {lost[0].who}"
    if recorded.total() != summary.messages:
        yield f"{recorded.total()} messages are recorded, the summary counts {summary.messages}"


def the_replay_agrees(outcome: Outcome) -> Iterator[str]:
    """As far as the recording goes; of a run that says success, to its end.

    Where messages are lost with the process that held them, which the other laws allow of few, a replay cannot know
    what others did with them, or why they had none: then it accuses nobody, but need not find that all is there. Nor
    does it accuse anybody of what a run that ended badly has not recorded.
    """
    if not files_of(outcome.recording):
        return
    try:
        verdict = replay(outcome.recording if outcome.recording.exists() else files_of(outcome.recording)[0])
    except Exception as error:
        yield f"the replay ends in {type(error).__name__}: {error}"
        return
    if outcome.unrecorded:
        if verdict.outcome == "diverges":
            yield f"messages are lost, and the replay accuses: {verdict.text()}"
        return
    if verdict.first_divergence is not None:
        yield f"the replay diverges: {verdict.first_divergence.text()}"
    elif outcome.summary is not None and not verdict.agrees:
        yield f"the run says success, and its replay: {verdict.text().splitlines()[0]}"


def nobody_runs_twice(outcome: Outcome) -> Iterator[str]:
    """Of two processes of one name one alone goes on, and one alone is content; until they meet, both may speak."""
    spans: defaultdict[str, list[float]] = defaultdict(list)
    for published in outcome.published:
        spans[published.who].append(published.at)
    for a, b in combinations(outcome.members, 2):
        if a.who != b.who:
            continue
        if a.process.error is None and b.process.error is None and not (a.process.was_killed or b.process.was_killed):
            yield f"both {a.process.name} and {b.process.name} ended well"
        one, other = spans.get(a.process.name), spans.get(b.process.name)
        refused = isinstance(a.process.error, Refused), isinstance(b.process.error, Refused)
        if one and other and max(one[0], other[0]) < min(one[-1], other[-1]) and refused != (False, True):
            yield f"{a.process.name} and {b.process.name} published at the same time"


def the_untouched_go_on(outcome: Outcome) -> Iterator[str]:
    """In a paced run that succeeds, who suffers nothing has a finite estimate of every step."""
    plan, names = outcome.scenario.plan, outcome.scenario.gains.problem.node_names
    if plan.pace is None or outcome.summary is None:
        return
    steps: defaultdict[str, set[int]] = defaultdict(set)
    for published in outcome.published:
        topic = published.sent.topic
        if topic.endswith("/estimate"):
            document = json.loads(published.sent.payload)
            if not all(map(math.isfinite, document["x_hat"])):
                yield f"{topic} is not finite at step {document['step']}"
            steps[topic].add(document["step"])
    for name in names:
        if _is_untouched(outcome, node_who(name)) and (lacking := set(range(plan.steps)) - steps[estimate(name)]):
            yield f"node {name} has no estimate of step {min(lacking)}, though nothing befell it"


def _is_untouched(outcome: Outcome, who: str) -> bool:
    scenario = outcome.scenario
    name = who.removeprefix("node-")
    weather = scenario.weather
    rough = (weather.dropped or weather.disordered or weather.stutter) and weather.victims in ("", who)
    parts = any(t.kind in ("part", "freeze") and t.seconds > 1.0 for t in scenario.troubles)
    without_modes = any(t.who == COORDINATOR and t.kind == "kill" for t in scenario.troubles)
    return not (
        rough
        or without_modes
        or any(COORDINATOR in fault for fault in scenario.plan.faults)
        or parts
        or any(who in (trouble.who, trouble.other) for trouble in scenario.troubles)
        or any(f"node={name}," in fault or f">{name}" in fault for fault in scenario.plan.faults)
    )


LAST = 0.6  # part of a run after which who is killed may not be back before it ends
LAWS: tuple[Callable[[Outcome], Iterator[str]], ...] = (
    nobody_hangs,
    everybody_ends_with_an_honest_word,
    a_fair_run_succeeds,
    a_paced_run_survives,
    what_succeeds_is_recorded,
    the_replay_agrees,
    nobody_runs_twice,
    the_untouched_go_on,
)


def broken(outcome: Outcome) -> list[str]:
    """The laws that do not hold of a run, and why not."""
    return [f"{law.__name__}: {words}" for law in LAWS for words in law(outcome)]
