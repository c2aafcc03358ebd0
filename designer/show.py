"""What a file is: a problem, gains, or a recording."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from agent.contract.errors import InputError, counted, listed
from agent.contract.gains import Gains
from agent.contract.keys import EVIDENCE
from agent.contract.layout import foxglove_layout
from agent.contract.problem import Problem
from agent.contract.problem.parts import Plant
from agent.contract.recording.contents import number
from agent.contract.recording.reader import Progress, RecordingReader
from agent.contract.recording.source import Source
from designer.problems import find, is_another, text_of
from designer.problems.notes import notes
from designer.problems.written import to_toml

MCAP_MAGIC = b"\x89MCAP"
LARGEST = 1 << 28  # bytes of a problem or gains file
PROBLEMS = Path(__file__).parent / "problems"


def describe(
    file: str | Path | None = None,
    *,
    run: str | None = None,
    gains: Path | None = None,
    report: Progress | None = None,
    settings: Sequence[str] = (),
) -> dict[str, Any]:
    """The facts of a file, or of a built-in problem given by its name; without one, the built-in problems.

    `kind` is "problem", "gains", "recording" or "built-in problems". Of a recording, `run` chooses among several runs,
    `gains` is the gains file where a tool left its own out, and `report` is told the bytes read, and of how many. The
    file is read once, so it may be a pipe. `settings` are for a problem (designer/problems/settings.py). Raises
    InputError for anything else.
    """
    if settings:
        _refuse_settings(file, settings)
        return {"file": str(file)} | _problem(find(str(file), settings))
    if file is None:
        return {"kind": "built-in problems", "problems": {name: _size(_built_in(name)) for name in built_in_names()}}
    path = Path(file)
    if not path.exists():
        if str(file) in built_in_names():
            return _problem(_built_in(str(file)))
        raise InputError(f"{path} does not exist, nor is it a built-in problem; these are {listed(built_in_names())}")
    source = Source(path, kind="problem, gains file or recording")
    try:
        if source.read(0, len(MCAP_MAGIC)) == MCAP_MAGIC:
            with RecordingReader(source, run=run, gains=gains, needs_gains=False) as reader:
                return {"file": str(path), **_recording(reader, report)}
        if source.size > LARGEST:
            raise InputError(f"{path} has {source.size} bytes, and does not begin as a recording (MCAP) does")
        data = source.read(0, source.size)
    finally:
        source.close()
    if data.lstrip().startswith(b"{"):
        return {"file": str(path), **_gains(Gains.from_bytes(data, source=str(path)))}
    if path.suffix == ".toml":
        return {"file": str(path), **_problem(Problem.load(path))}
    raise InputError(f"{path} is neither a problem (.toml), nor a gains file (JSON), nor a recording (MCAP)")


def _refuse_settings(file: str | Path | None, settings: Sequence[str]) -> None:
    if file is None or (Path(file).suffix != ".toml" and str(file) not in built_in_names()):
        raise InputError(f"--set {settings[0]} is for a problem, a .toml file or a built-in one")


def as_toml(file: str | Path, *, settings: Sequence[str] = ()) -> str:
    """A problem as the text of its file: a built-in one with its comments, that of gains, or one with `settings`.

    Raises InputError where there is no problem, or its disturbance is a table that stands in another file.
    """
    path = Path(file)
    if str(file) in built_in_names() and not settings:
        return text_of(str(file))
    if settings or path.suffix == ".toml":
        _refuse_settings(file, settings or ["--toml"])
        problem = find(str(file), settings)
    else:
        problem = Gains.load(path).problem
    if problem.disturbance.kind == "csv":
        raise InputError(f"{path}: its disturbance is the table of a CSV file, which --toml does not write")
    return to_toml(problem)


def attachment(path: Path, name: str, *, run: str | None = None, gains: Path | None = None) -> bytes:
    """What is attached to a recording under a name; `run` and `gains` as in `describe`.

    gains.json and problem.json are those that the run was made with, by their digests, whatever else has these names;
    a layout.json that a tool left out is made anew. Raises InputError where there is nothing of the kind.
    """
    with RecordingReader(path, run=run, gains=gains, needs_gains=False) as reader:
        match name:
            case "gains.json":
                return reader.gains.canonical()
            case "problem.json":
                return reader.gains.problem.canonical()
        data = reader.attachment(name)
        if data is not None:
            return data
        if name == "layout.json":
            return json.dumps(foxglove_layout(reader.gains.problem)).encode()
        there = listed(sorted({"gains.json", "problem.json", "layout.json", *reader.attached}))
        raise InputError(f'{path} has no attachment "{name}"; it has {there}')


def text(facts: dict[str, Any]) -> str:
    """The same for people: a line for each fact, topics of all nodes taken together, what gains claim as a claim."""
    if facts["kind"] == "built-in problems":
        facts = facts["problems"]
    if "messages" in facts:
        facts = facts | {"messages": _by_kind(facts["messages"])}
    if "holds" in facts:
        facts = _as_claim(facts)
    if "others" in facts:
        facts = facts | {"others": list(facts["others"]), "notes": "; ".join(facts["notes"])}
    width = max(map(len, facts)) + 2
    return "\n".join(f"{name.replace('_', ' '):{width}}{_plain(value)}" for name, value in facts.items())


def built_in_names() -> list[str]:
    """The names of the problems that come with peakmesh."""
    return sorted(path.stem for path in PROBLEMS.glob("*.toml"))


def _built_in(name: str) -> Problem:
    return Problem.load(PROBLEMS / f"{name}.toml")


def _size(problem: Problem) -> str:
    sizes = (problem.n, "node"), (problem.nx, "state"), (len(problem.topologies), "mode")
    return ", ".join(counted(number, noun) for number, noun in sizes)


def _problem(problem: Problem) -> dict[str, Any]:
    return {
        "kind": "problem",
        "name": problem.name,
        "nodes": list(problem.node_names),
        "modes": list(problem.mode_names),
        "states": problem.nx,
        "disturbances": problem.nw,
        "outputs": problem.nz,
        **_sampled(problem.plant),
        "measurements": sum(len(node.C) for node in problem.nodes),
        "arrival_probability": problem.beta.tolist(),
        "sees_its_losses": [node.name for node in problem.nodes if node.seen],
        "lossy_links": {f"{link.sender} to {link.receiver}": link.delivery_probability for link in problem.links or ()},
        "unbiased": bool(problem.unbiased),
        **_beside(problem),
        "disturbance": problem.disturbance.kind,
        "notes": notes(problem),
        "digest": problem.digest(),
    }


def _beside(problem: Problem) -> dict[str, Any]:
    """What may stand beside the numbers of a problem, where it does."""
    parts: list[tuple[str, Any]] = [("plant", problem.plant), *((node.name, node) for node in problem.nodes)]
    parts += [(f"{link.sender} to {link.receiver}", link) for link in problem.links or ()]
    said = [(f" of {name}", part.tolerance) for name, part in (*parts, ("markov", problem.markov))]
    found: dict[str, Any] = {
        "weights": {node.name: node.weight for node in problem.nodes if node.weight is not None},
        "initial_error": None if problem.plant.initial_error is None else problem.plant.initial_error.tolist(),
        "tolerances": {
            f"{key}{of}": size for of, sizes in said if sizes is not None for key, size in sizes.document().items()
        },
    }
    if problem.uncertainty is not None:
        found["tolerances"] |= {f"all {name}": size for name, size in problem.uncertainty.document().items()}
    return {name: value for name, value in found.items() if value}


def _sampled(plant: Plant) -> dict[str, Any]:
    """What is known of a plant of continuous time; nothing of another."""
    if plant.sample_time is None:
        return {}
    how = (
        "A = exp(A_continuous T), B = integral of exp(A_continuous t) B_continuous from 0 to T, w held between samples"
    )
    return {"sample_time": plant.sample_time, "discretised": f"{how}; A = {plant.A.tolist()}, B = {plant.B.tolist()}"}


def _gains(gains: Gains) -> dict[str, Any]:
    proved, solver = gains.certificate, gains.solver
    return {
        "kind": "gains",
        "problem": gains.problem.name,
        "problem_digest": gains.problem_digest,
        "is_another": is_another(gains.problem),
        "size": _size(gains.problem),
        "method": gains.method,
        "gamma": proved.gamma,
        "theorem1_gamma": proved.theorem1_gamma,
        "certificate": f"{proved.kind}, {proved.form} P",
        "holds": proved.holds,
        "verified": proved.verified,
        "lmi_gamma": proved.lmi_gamma,
        "lmi_least": proved.lmi_least,
        "exact": None if proved.exact is None else list(proved.exact),
        "floor": proved.floor,
        "solver": f"{solver.name} {solver.version}: {solver.status}, {solver.iterations} iterations",
        "seconds": gains.seconds.get("total"),
        "digest": gains.digest(),
    }


def _as_claim(facts: dict[str, Any]) -> dict[str, Any]:
    """Anybody may have edited the file since it was verified: what it says of itself is no verdict."""
    shown = facts | {"gamma": "not claimed"}
    if facts.get("is_another"):
        shown["problem"] = f"{facts['problem']}, which is NOT the built-in problem of this name"
    if facts["holds"]:
        command = "verify" if facts["kind"] == "gains" else "replay"
        shown["gamma"] = f'claimed {facts["gamma"]}, by design; "peakmesh {command}" checks it'
    if facts.get("theorem1_gamma") is not None:
        shown["theorem1_gamma"] = f"claimed {facts['theorem1_gamma']:.6g}"
    for name in ("lmi_gamma", "lmi_least"):
        if facts.get(name) is not None:
            shown[name] = f"claimed {facts[name]:.6g}"
    if facts.get("exact"):
        shown["exact"] = "claimed between {:.6g} and {:.6g}".format(*facts["exact"])
    if facts.get("floor") is not None:
        shown["floor"] = f"claimed {facts['floor']:.6g}"
    absent = {
        name for name in ("theorem1_gamma", "lmi_gamma", "lmi_least", "exact", "floor") if facts.get(name) is None
    }
    return {name: value for name, value in shown.items() if name not in {"holds", "verified", "is_another", *absent}}


def _recording(reader: RecordingReader, report: Progress | None) -> dict[str, Any]:
    counts = Counter(logged.topic for logged in reader.messages(report) if logged.topic != EVIDENCE)
    run, end, notes = reader.run, reader.end or {}, [*reader.notes]
    try:
        gains: Gains | None = reader.gains
    except InputError as error:
        gains = None
        notes.append(str(error).removeprefix(f"{reader.path} ").removeprefix(f"{reader.path}: "))
    return {
        "kind": "recording",
        "run": run.get("run", ""),
        "problem": run.get("problem", "") if gains is None else gains.problem.name,
        "size": "" if gains is None else _size(gains.problem),
        "gains": run.get("gains", "") if gains is None else gains.digest(),
        **({} if gains is None else {"gamma": gains.certificate.gamma, "holds": gains.certificate.holds}),
        "seed": number(run.get("seed", "")),
        "steps": number(run.get("steps", "")),
        "complete_steps": number(end["steps"]) if "steps" in end else None,
        "external": [name for name in run.get("external", "").split(",") if name],
        "started": run.get("started", ""),
        "messages": dict(sorted(counts.items())),
        "missing": {
            key.removeprefix("missing."): int(count)
            for key, count in end.items()
            if key.startswith("missing.") and count.isdigit() and int(count)
        },
        "status": end.get("status", "cut: it has no end"),
        "reason": end.get("reason", ""),
        "damage": reader.damage,
        "notes": [*notes, *reader.faults],
        "others": {**reader.foreign, **dict.fromkeys(reader.strangers)},
    }


def _by_kind(counts: dict[str, int]) -> dict[str, int]:
    """Messages of each kind of topic: node/<n>/estimate for all nodes together."""
    kinds: Counter[str] = Counter()
    for topic, count in counts.items():
        words = topic.split("/")
        kinds["/".join(["node", "*", *words[2:]]) if words[0] == "node" else topic] += count
    return {"all": sum(kinds.values()), **kinds}


def _plain(value: Any) -> str:
    if value is None or value in ("", [], {}):
        return "-"
    match value:
        case bool():
            return "yes" if value else "no"
        case float():
            return f"{value:.6g}"
        case list():
            shown = [_plain(entry) for entry in value]
            return ", ".join(shown if len(shown) <= 12 else [*shown[:10], f"... {len(shown) - 11} more ...", shown[-1]])
        case dict():
            return "; ".join(f"{name}: {_plain(entry)}" for name, entry in value.items())
    return str(value)
