"""What a file is: a problem, gains, or a recording."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any

from agent.contract.errors import InputError, counted, listed
from agent.contract.files import read_bytes
from agent.contract.gains import Gains
from agent.contract.problem import Problem
from agent.contract.recording.reader import RecordingReader

MCAP_MAGIC = b"\x89MCAP"
PROBLEMS = Path(__file__).parent / "problems"


def describe(file: str | Path | None = None) -> dict[str, Any]:
    """The facts of a file, or of a built-in problem given by its name; without one, the built-in problems.

    `kind` is "problem", "gains", "recording" or "built-in problems". Raises InputError for anything else.
    """
    if file is None:
        return {"kind": "built-in problems", "problems": {name: _size(_built_in(name)) for name in built_in_names()}}
    path = Path(file)
    if not path.exists():
        if str(file) in built_in_names():
            return _problem(_built_in(str(file)))
        raise InputError(f"{path} does not exist, nor is it a built-in problem; these are {listed(built_in_names())}")
    data = read_bytes(path, kind="problem, gains file or recording")
    if data.startswith(MCAP_MAGIC):
        return {"file": str(path), **_recording(path)}
    if data.lstrip().startswith(b"{"):
        return {"file": str(path), **_gains(Gains.from_bytes(data, source=str(path)))}
    if path.suffix == ".toml":
        return {"file": str(path), **_problem(Problem.load(path))}
    raise InputError(f"{path} is neither a problem (.toml), nor a gains file (JSON), nor a recording (MCAP)")


def text(facts: dict[str, Any]) -> str:
    """The same for people: a line for each fact, topics of all nodes taken together, what gains claim as a claim."""
    if facts["kind"] == "built-in problems":
        facts = facts["problems"]
    if "messages" in facts:
        facts = facts | {"messages": _by_kind(facts["messages"])}
    if "holds" in facts:
        facts = _as_claim(facts)
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
        "measurements": sum(len(node.C) for node in problem.nodes),
        "arrival_probability": problem.beta.tolist(),
        "sees_its_losses": [node.name for node in problem.nodes if node.seen],
        "lossy_links": {f"{link.sender} to {link.receiver}": link.delivery_probability for link in problem.links or ()},
        "unbiased": bool(problem.unbiased),
        "disturbance": problem.disturbance.kind,
        "digest": problem.digest(),
    }


def _gains(gains: Gains) -> dict[str, Any]:
    proved, solver = gains.certificate, gains.solver
    return {
        "kind": "gains",
        "problem": gains.problem.name,
        "size": _size(gains.problem),
        "method": gains.method,
        "gamma": proved.gamma,
        "theorem1_gamma": proved.theorem1_gamma,
        "certificate": f"{proved.kind}, {proved.form} P",
        "holds": proved.holds,
        "verified": proved.verified,
        "lmi_gamma": proved.lmi_gamma,
        "exact": None if proved.exact is None else list(proved.exact),
        "floor": proved.floor,
        "solver": f"{solver.name} {solver.version}: {solver.status}, {solver.iterations} iterations",
        "seconds": gains.seconds.get("total"),
        "digest": gains.digest(),
    }


def _as_claim(facts: dict[str, Any]) -> dict[str, Any]:
    """Anybody may have edited the file since it was verified: what it says of itself is no verdict."""
    shown = facts | {"gamma": "not claimed"}
    if facts["holds"]:
        command = "verify" if facts["kind"] == "gains" else "replay"
        shown["gamma"] = f'claimed {facts["gamma"]}, by design; "peakmesh {command}" checks it'
    if facts.get("theorem1_gamma") is not None:
        shown["theorem1_gamma"] = f"claimed {facts['theorem1_gamma']:.6g}"
    if facts.get("lmi_gamma") is not None:
        shown["lmi_gamma"] = f"claimed {facts['lmi_gamma']:.6g}"
    if facts.get("exact"):
        shown["exact"] = "claimed between {:.6g} and {:.6g}".format(*facts["exact"])
    if facts.get("floor") is not None:
        shown["floor"] = f"claimed {facts['floor']:.6g}"
    absent = {name for name in ("theorem1_gamma", "lmi_gamma", "exact", "floor") if facts.get(name) is None}
    return {name: value for name, value in shown.items() if name not in {"holds", "verified", *absent}}


def _recording(path: Path) -> dict[str, Any]:
    with RecordingReader(path) as reader:
        counts = Counter(logged.topic for logged in reader.messages())
        run, end, gains = reader.run, reader.end or {}, reader.gains
    return {
        "kind": "recording",
        "run": run.get("run", ""),
        "problem": gains.problem.name,
        "size": _size(gains.problem),
        "gains": gains.digest(),
        "gamma": gains.certificate.gamma,
        "holds": gains.certificate.holds,
        "seed": run.get("seed", ""),
        "steps": run.get("steps", ""),
        "complete_steps": end.get("steps"),
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
