"""Which run a recording holds, and with which gains: by what its metadata say and by digests, wherever a tool put them.

Somebody else's metadata may be called `run` too, and somebody else's attachment gains.json. A run is known by the
format that it states, gains by the digest that their run names.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Iterator, Sequence
from datetime import datetime
from functools import reduce
from pathlib import Path
from typing import NamedTuple

from agent.contract.errors import InputError, listed
from agent.contract.files import read_json
from agent.contract.gains import Gains
from agent.contract.problem import Problem
from agent.contract.recording import FORMAT, VERSION
from agent.contract.recording.records import Attached
from agent.contract.recording.survey import Survey

IDENTITY = ("run", "gains", "problem_digest", "seed", "steps", "started")  # metadata that make two records one run
CONTINUES = "continues"  # the status at the end of a part that another one follows
ATTACHED = {"gains.json", "problem.json", "layout.json"}
_DIGESTS = (("problem.json", "problem_digest", Problem), ("gains.json", "gains", Gains))  # that the run names
_LARGEST = 1 << 28  # bytes of an attachment that is looked into

Facts = dict[str, str]


class Run(NamedTuple):
    """A run by its metadata; `end` is None where its last word is not there."""

    facts: Facts
    end: Facts | None

    @property
    def identity(self) -> tuple[str, ...]:
        return _identity(self.facts)

    @property
    def name(self) -> str:
        return self.facts.get("run", "")

    def text(self) -> str:
        started = self.facts.get("started", "")
        details = [f"seed {self.facts.get('seed', '?')}", *([f"started {started}"] if started else [])]
        return f'"{self.name}" ({", ".join(details)})'


def runs_in(surveys: Sequence[Survey]) -> list[Run]:
    """Every run that files hold between them, in their order; equal copies and parts of one run are one.

    Raises InputError where they hold none.
    """
    found: dict[tuple[str, ...], Run] = {}
    for survey in surveys:
        begun = [facts for name, facts in survey.metadata if name == "run" and is_ours(name, facts)]
        ended = [facts for name, facts in survey.metadata if name == "end" and is_ours(name, facts)]
        for facts, end in zip(begun, _ends(begun, ended), strict=True):
            key = _identity(facts)
            before = found.get(key, Run(facts, None))
            found[key] = Run(before.facts, _later(before.end, end))
    if not found:
        raise InputError(_no_run(surveys))
    return list(found.values())


def is_ours(name: str, facts: Facts) -> bool:
    """Whether metadata are those of a run of peakmesh."""
    return (name == "run" and facts.get("format") == FORMAT) or (name == "end" and "status" in facts)


def _identity(facts: Facts) -> tuple[str, ...]:
    return tuple(facts.get(word, "") for word in IDENTITY)


def _later(one: Facts | None, other: Facts | None) -> Facts | None:
    """The last word of a run of two: a part that is not the last says that the run continues."""
    if one is None or other is None:
        return one or other
    return max(one, other, key=_place)


def _place(end: Facts) -> tuple[bool, int, int, str]:
    """By which the last of several comes last: of two parts that end in the same step, by what the next is called."""
    following = end.get("next", "")
    return end["status"] != CONTINUES, _steps(end), len(following), following


def _steps(end: Facts) -> int:
    found = number(end.get("steps", ""))
    return found if isinstance(found, int) else -1


def number(text: str) -> int | str:
    """A number that a recorder wrote down; the text itself where somebody else put something there."""
    return int(text) if text.isascii() and text.isdecimal() and len(text) < 20 else text


def _ends(begun: list[Facts], ended: list[Facts]) -> list[Facts | None]:
    """The `end` of each `run` of a file: by its place among them, or the last one where the runs are all the same."""
    if len(begun) == len(ended):
        return list(ended)
    if len({_identity(facts) for facts in begun}) == 1:
        return [reduce(_later, ended, None)] * len(begun)
    return [None] * len(begun)


def chosen(runs: list[Run], name: str | None, *, label: str) -> Run:
    """The run called `name`, by its name or the time it started; without one the only one. InputError otherwise."""
    fitting = [run for run in runs if name is None or name in (run.name, run.facts.get("started"))]
    known = " and ".join(run.text() for run in runs)
    if not fitting:
        raise InputError(f'{label} has no run "{name}"; it has {known}')
    if len(fitting) > 1:
        how = "--run NAME" if len({run.name for run in runs}) == len(runs) else "--run with the time it started"
        raise InputError(f"{label} holds {len(fitting)} runs, {known}; choose one by {how}")
    run = fitting[0]
    if run.facts.get("version") != VERSION:
        raise InputError(
            f"{label} has recording format {FORMAT} {run.facts.get('version')}; this peakmesh reads {FORMAT} {VERSION}"
        )
    return run


def window(run: Run, runs: list[Run], *, label: str) -> tuple[float, float]:
    """Log times in ns, from and before, of a run's messages among those of other runs."""
    if len(runs) == 1:
        return float("-inf"), float("inf")
    try:
        times = sorted({_nanoseconds(other.facts["started"]) for other in runs})
        own = _nanoseconds(run.facts["started"])
    except (KeyError, ValueError):
        raise InputError(f"{label}: its runs do not say when they started; their messages cannot be parted") from None
    if len(times) < len(runs):
        raise InputError(f"{label}: its runs started at the same time; their messages cannot be parted")
    place = times.index(own)
    return times[place] if place else float("-inf"), times[place + 1] if place + 1 < len(times) else float("inf")


def _nanoseconds(text: str) -> int:
    return round(datetime.fromisoformat(text).timestamp() * 1e9)


def _no_run(surveys: Sequence[Survey]) -> str:
    """Why there is no run in it."""
    survey = surveys[0]
    path = survey.source.path
    if survey.damage and not survey.chunks and not survey.loose:
        return f"{path} is cut or damaged before its first message: {survey.damage[0]}; nothing can be read"
    topics = sorted({channel.topic for survey in surveys for channel in survey.described})
    has = f"; its topics are {listed(topics)}" if topics else ""
    if {"mode", "plant/state"} & {topic.lstrip("/") for topic in topics}:
        has += ": they look like those of a run, so a tool may have left the metadata out; copy it with metadata"
    if any(name == "run" for name, _ in survey.metadata):
        return f"{path} is an MCAP file, but not a recording of peakmesh: its run metadata are somebody else's{has}"
    if survey.damage:
        return f"{path} is cut or damaged, and what is left of it has no run metadata: {survey.damage[0]}{has}"
    return f"{path} is an MCAP file, but not a recording of peakmesh: it has no run metadata{has}"


# Attachments.
def find_gains(run: Run, surveys: Sequence[Survey], given: Path | None, *, label: str) -> Gains:
    """The gains that the run was made with: those whose digest it names, attached or `given`. InputError otherwise."""
    wanted = run.facts.get("gains", "")
    if given is not None:
        gains = Gains.load(given)
        if wanted and gains.digest() != wanted:
            raise InputError(
                f"{given} has digest {gains.digest()[:12]}..., but the run was made with {wanted[:12]}...; give its own"
            )
        return gains
    failures = []
    for survey, attached in _named("gains.json", surveys):
        try:
            data = _data(survey, attached)
            gains = Gains.from_bytes(data, source=f"{survey.source.path}: gains.json")
        except InputError as error:
            failures.append(str(error).removesuffix("; design the gains again"))
            continue
        if not wanted or gains.digest() == wanted:
            return gains
        failures.append(
            f"{survey.source.path}: the attachment gains.json was altered or exchanged: its digest is "
            f"{gains.digest()[:12]}..., the run was made with {wanted[:12]}..."
        )
    raise InputError(_no_gains(failures, wanted, surveys, label))


def _no_gains(failures: list[str], wanted: str, surveys: Sequence[Survey], label: str) -> str:
    damage = [sentence for survey in surveys for sentence in survey.damage]
    hint = f"give the gains with --gains FILE (digest {wanted[:12]}...)"
    if failures:
        return f"{failures[-1]}; {hint}"
    if damage and not any(survey.chunks or survey.loose for survey in surveys):
        return f"{label} is cut or damaged before its first message: {damage[0]}; nothing can be read"
    if damage:
        return f"{label} has no attachment gains.json: {damage[0]}; {hint}"
    return f"{label} has no gains: its attachment gains.json is missing, a filter may have left it out; {hint}"


def unfit(run: Run, surveys: Sequence[Survey], used: Gains | None) -> Iterator[tuple[str, bool]]:
    """Of the attachments whose digests the run names, those of which there is none that fits: a sentence, and whether
    a checksum vouches for what is there, so that somebody has altered it; else it is damaged, or may be.

    Where the run names none, and where it names others, the gains that are `used` and their problem count.
    """
    ours = {} if used is None else {"gains": used.digest(), "problem_digest": used.problem_digest}
    for name, key, model in _DIGESTS:
        named = run.facts.get(key, "")
        wanted = ours.get(key, named)
        if named not in ("", wanted):
            yield f"the run names {name} of digest {named[:12]}..., and was held against {wanted[:12]}...", True
        there = list(_named(name, surveys))
        found = [_digest(survey, attached, model, wanted) for survey, attached in there]
        if not wanted or not found or wanted in found:
            continue
        fits = _fits(*there[-1])
        word = "is damaged: it does not fit its checksum" if fits is False else "was altered or exchanged"
        digests = f"its digest is {found[-1][:12]}..., the run's is {wanted[:12]}..."
        yield f"the attachment {name} {word}{'; ' if fits is False else ': '}{digests}", fits is True


def _fits(survey: Survey, attached: Attached) -> bool | None:
    """Whether an attachment fits its checksum, or that of the whole file; None where there is neither."""
    crc = int.from_bytes(survey.source.read(attached.start + attached.size, 4), "little")
    if not crc:
        return True if survey.is_covered else None
    return survey.source.checksum(attached.record, attached.start + attached.size) == crc


def strangers(run: Run, surveys: Sequence[Survey]) -> Iterator[str]:
    """Metadata and attachments of others, by name."""
    for survey in surveys:
        yield from (name for name, facts in survey.metadata if not is_ours(name, facts))
        yield from (attached.name for attached in survey.attachments if attached.name not in ATTACHED)
    for name, key, model in _DIGESTS:
        wanted = run.facts.get(key, "")
        found = [_digest(survey, attached, model, wanted) for survey, attached in _named(name, surveys)]
        if wanted in found:
            yield from (name for digest in found if digest != wanted)


def _digest(survey: Survey, attached: Attached, model: type[Problem] | type[Gains], wanted: str) -> str:
    """Of what is in an attachment, whatever its spaces; of its bytes where that is something else, or is `wanted`."""
    data = survey.source.read(attached.start, min(attached.size, _LARGEST))
    if hashlib.sha256(data).hexdigest() == wanted:
        return wanted
    try:
        return model.model_validate(read_json(data)).digest()
    except (ValueError, RecursionError):
        return hashlib.sha256(data).hexdigest()


def _named(name: str, surveys: Sequence[Survey]) -> Iterable[tuple[Survey, Attached]]:
    return ((survey, found) for survey in surveys for found in survey.attachments if found.name == name)


def _data(survey: Survey, attached: Attached) -> bytes:
    """The bytes of an attachment; InputError where its checksum does not fit."""
    source = survey.source
    if attached.size > _LARGEST:
        raise InputError(f"{source.path}: the attachment {attached.name} has {attached.size} bytes")
    if _fits(survey, attached) is False:
        raise InputError(f"{source.path}: the attachment {attached.name} is damaged: it does not fit its checksum")
    return source.read(attached.start, attached.size)


def attachment(survey: Survey, name: str) -> bytes | None:
    """The first sound attachment of a name; None where there is none."""
    for _, attached in _named(name, [survey]):
        try:
            return _data(survey, attached)
        except InputError:
            continue
    return None
