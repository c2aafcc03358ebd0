"""`peakmesh verify`: a certificate proved again, without a solver, and of which problem it is."""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from agent.commands.options import Subcommands, add_command, load_gains
from agent.contract.errors import EXIT_GOOD, EXIT_NO, InputError, counted, listed
from designer.commands import add_set
from designer.commands.within import add_within, asked

if TYPE_CHECKING:
    from agent.contract.gains import Gains
    from agent.contract.problem import Problem
    from designer.proof.undercut import LeastAgain

PROVED = {
    "lyapunov": "mean-square stability, and gamma by (17) and (18) of Theorem 1 in every mode",
    "exact": "mean-square stability by (17), and gamma by the recursion of the exact gain",
    "gramian": "that the errors die out, and gamma by their gramian, since chance has no say",
}
_ANSWERS = {True: "proved", False: "false", None: "open"}
_BESIDE = {"name", "disturbance", "tolerance", "initial", "initial_error"}  # what a proof of gamma does not depend on


def add_verify(commands: Subcommands) -> None:
    """Describe `verify` to the parser."""
    verify = add_command(commands, "verify", verify_command, "prove a certificate again, without a solver")
    verify.add_argument("gains", type=Path, metavar="GAINS", help="gains file")
    verify.add_argument(
        "problem", nargs="?", metavar="PROBLEM", help="problem.toml, or a built-in problem, that they have to be for"
    )
    add_set(verify)
    verify.add_argument(
        "--balls", action="store_true", help="in ball arithmetic alone: slower, and nothing is assumed of numpy"
    )
    add_within(verify)
    verify.add_argument("--json", action="store_true", help="print one JSON object")


def verify_command(options: argparse.Namespace) -> int:
    """`peakmesh verify GAINS [PROBLEM]`."""
    from designer.box.claim import with_box
    from designer.problems import find
    from designer.proof.certificate import verify
    from designer.proof.prover import BALLS, FLOATS
    from designer.proof.undercut import least_again

    if options.settings and options.problem is None:
        raise InputError(f"--set {options.settings[0]} is for PROBLEM; name the problem that the gains have to be for")
    gains = load_gains(options.gains)
    problem = gains.problem if options.problem is None else find(options.problem, options.settings)
    differs = _differences(gains.problem, problem)
    if set(differs) - _BESIDE:
        return _for_another(gains, options, differs)
    asked(problem, options.within)  # what is no box is refused before anything is proved
    started = time.perf_counter()
    try:
        verdict = verify(gains, makes=BALLS if options.balls else FLOATS + BALLS)
        verdict, in_box = with_box(verdict, gains, problem, options.within, balls=options.balls)
        least = least_again(gains) if verdict.holds else None
    except InputError as error:
        raise InputError(f"{options.gains}: {error}") from None
    if least is not None and least.holds is False:
        why = f"no gains have less by an LMI than {gains.certificate.lmi_least}, it says, but {least.how}"
        verdict = verdict._replace(holds=False, failure=why)
    asked_for = bool(options.within) or "tolerance" in differs
    good = EXIT_GOOD if verdict.holds and not (asked_for and in_box and in_box.gamma is None) else EXIT_NO
    seconds, claim = time.perf_counter() - started, gains.certificate
    within = "" if in_box is None or in_box.verdict is None else in_box.verdict.arithmetic
    how = "; ".join(dict.fromkeys(part for part in (verdict.arithmetic, within, f"{seconds:.2f} s") if part))
    proved = [PROVED["gramian" if verdict.by_gramian else claim.kind]]
    if claim.theorem1_gamma is not None:
        proved.append(f"gamma = {claim.theorem1_gamma} too, by (17) and (18) of Theorem 1 for the same P")
    if least is not None and least.holds:
        proved.append(f"no gains have less than {claim.lmi_least} by an LMI of this form: {least.how}")
    if options.json:
        said: dict[str, object] = {"kind": claim.kind, "theorem1_gamma": claim.theorem1_gamma, "seconds": seconds}
        said["lmi_least"] = None if least is None else _ANSWERS[least.holds]
        said["within"] = None if in_box is None else in_box.document()
        of = _of_problem(gains, options.gains)
        print(json.dumps(verdict._asdict() | said | of | {"claimed": _claimed(gains, verdict.low, least)}))
        return good
    lines = [f"of      {text}" for text in _whose(gains, differs)]
    if verdict.holds:
        if verdict.low is not None:
            proved.append(f"the exact gain is between {verdict.low} and {verdict.gamma}: below, some w does worse")
        lines = [f"holds: gamma = {verdict.gamma} is proved", *lines, *(f"proved  {text}" for text in proved)]
        lines += [] if in_box is None else in_box.of_verify()
        lines += [f"claimed {text}" for text in _claimed(gains, verdict.low, least)]
    else:
        no = f"gamma = {verdict.gamma} is not proved for {options.gains}: {verdict.failure}"
        if verdict.interval_is_false:
            false = f"{options.gains} says what is proved false: {verdict.failure}"
            no = f"{false}; gamma = {verdict.gamma} itself is proved"
        if least is not None and least.holds is False:
            no = f"{options.gains} claims too much: {verdict.failure}; gamma = {verdict.gamma} itself is proved"
        lines = [f"does not hold: {no}", *lines]
    print("\n".join([*lines, f"in      {how}"]))
    return good


def _differences(found: Problem, wanted: Problem) -> list[str]:
    """The parts of two problems that differ, as they are called in a problem file."""

    def differing(one: dict[str, Any], other: dict[str, Any]) -> set[str]:
        return {key for key in one.keys() | other.keys() if one.get(key) != other.get(key)}

    differs = differing(_parts(found.certain()), _parts(wanted.certain()))
    more = differing(_parts(found), _parts(wanted)) - differs
    return sorted(differs | ({"tolerance"} if more else set()))


def _parts(problem: Problem) -> dict[str, Any]:
    """The document, and by itself what gamma is for any of; links that lose nothing are none."""
    document = problem.document()
    lossy = [link for link in document.get("link") or () if link["delivery_probability"] < 1.0 or "tolerance" in link]
    beside = {
        "initial": document["markov"].pop("initial"),
        "initial_error": document["plant"].pop("initial_error", None),
    }
    return {**document, **beside, "link": lossy}


def _for_another(gains: Gains, options: argparse.Namespace, differs: list[str]) -> int:
    """The answer where the gains are for another problem than the one that is given."""
    why = (
        f"they are for another problem than {options.problem}: {listed(differs)} "
        f"{'differ' if len(differs) > 1 else 'differs'}; {_whose(gains, [])[0]}"
    )
    if options.json:
        of = _of_problem(gains, options.gains)
        print(json.dumps({"holds": False, "gamma": gains.certificate.gamma, "failure": why, **of}))
    else:
        print(f"does not hold: {options.gains} proves nothing of {options.problem}: {why}")
    return EXIT_NO


def _of_problem(gains: Gains, path: Path) -> dict[str, object]:
    from designer.problems import is_another

    return {
        "file": str(path),
        "problem": gains.problem.name,
        "problem_digest": gains.problem_digest,
        "is_another": is_another(gains.problem),
    }


def _whose(gains: Gains, differs: list[str]) -> list[str]:
    """Of which problem something is said."""
    from designer.problems import is_another

    problem = gains.problem
    lines = [
        f"{problem.name}, digest {gains.problem_digest[:12]}...: {counted(problem.n, 'node')}, "
        f"{counted(problem.nx, 'state')}, {counted(len(problem.topologies), 'mode')}"
    ]
    if is_another(problem):
        lines.append(f"a problem that is NOT the built-in one of the name {problem.name}")
    if differs:
        found = f"a problem that differs from the one given in {listed(differs)}"
        lines.append(f"{found}, on which this gamma does not depend")
    return lines


def _claimed(gains: Gains, low: float | None, least: LeastAgain | None) -> list[str]:
    """What stands in the file too, and is not proved here."""
    beside = ("floor", "lmi_gamma", "lmi_exact", *(("exact",) if low is None else ()))
    there = [name for name in beside if getattr(gains.certificate, name) is not None]
    found = [f"{listed(there)}: computed by whoever designed the gains"] if there else []
    if least is not None and least.holds is None:
        found.append(f"lmi_least = {gains.certificate.lmi_least}: not proved here; {least.how}")
    if gains.worst_case is not None:
        found.append("worst_case: a w of energy 1; that no other fixed w does worse is not proved")
    return found
