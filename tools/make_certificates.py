"""Makes `certificates/`: gains files that a checker must accept, and mutants of them that it must refuse.

    python tools/make_certificates.py

Small networks of every kind are designed. Of some, one number at a time is moved in the direction in which the file
claims too much: it is kept where `verify` proves it false.
"""

from __future__ import annotations

import copy
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "tests" / "support")]

from networks import random_problem, real_network, real_networks  # noqa: E402

from agent.contract.errors import InputError  # noqa: E402
from agent.contract.gains import Gains  # noqa: E402
from agent.contract.problem import Problem  # noqa: E402
from designer.proof.certificate import lyapunov_matrix, verify  # noqa: E402
from designer.synthesis import design  # noqa: E402

FOLDER = Path(__file__).parent / "certificates"
BUDGET = 3.0  # CPU seconds of a search; what is proved is proved of whatever it finds
STEPS = (1e-5, -1e-5, 1e-3, -1e-3, 2e-2, -2e-2, 0.2, -0.2, 0.9, -0.9)  # by which a number is moved, relative to it
Document = dict[str, Any]
Place = tuple[str | int, ...]

# Where each kind of number stands in a gains file, and in which file it is moved.
MUTANTS: dict[str, tuple[str, Place]] = {
    "A": ("paper-exact", ("problem", "plant", "A", 0, 0)),
    "B": ("paper-exact", ("problem", "plant", "B", 0, 0)),
    "C": ("paper-exact", ("problem", "node", 0, "C", 0, 0)),
    "D": ("paper-exact", ("problem", "node", 1, "D", 0, 0)),
    "M": ("paper-exact", ("problem", "plant", "M", 0, 0)),
    "K": ("paper-exact", ("K", "m0", "n0", "n0", 0, 0)),
    "H": ("paper-exact", ("H", "m1", "n1", "n1", 0, 0)),
    "weight": ("paper-exact", ("problem", "topology", 0, "adjacency", 0, 0)),
    "beta-hidden": ("paper-exact", ("problem", "node", 1, "arrival_probability")),
    "beta-seen": ("seen", ("problem", "node", 1, "arrival_probability")),
    "Pi": ("paper-exact", ("problem", "markov", "transition", 0, 0)),
    "Pi-links": ("links", ("problem", "markov", "transition", 1, 0)),
    "rho": ("links", ("problem", "link", 0, "delivery_probability")),
    "rho-unbiased-unstable": ("unbiased-seen-links-unstable", ("problem", "link", 0, "delivery_probability")),
    "beta-unbiased-unstable": ("unbiased-seen-links-unstable", ("problem", "node", 1, "arrival_probability")),
    "A-two-states": ("paper-two-states", ("problem", "plant", "A", 1, 1)),
    "K-some-seen-links": ("some-seen-links", ("K", "m0", "n1", "n1", 0, 0)),
    "Q": ("seen-decomposed", ("certificate", "Q", "m0", "n1", 0, 0)),
    "R": ("paper-theorem2", ("certificate", "R", 0, 0)),
    "P": ("full", ("certificate", "P", "m1", 1, 1)),
    "H-theorem2": ("paper-theorem2", ("H", "m1", "n1", "n1", 0, 0)),
    "gamma": ("paper-exact", ("certificate", "gamma")),
    "gamma-links": ("some-seen-links", ("certificate", "gamma")),
    "gamma-theorem2": ("theorem2-alone", ("certificate", "gamma")),
    "gamma-beside": ("seen-decomposed", ("certificate", "theorem1_gamma")),
}


def designed() -> dict[str, Document]:
    """A gains file for each kind of model and of certificate."""
    paper, real = random_problem(7, n=2, nx=1), real_networks(3, n=2, nx=1)
    made = {
        "paper-exact": design(paper, method="exact", budget=BUDGET),
        "paper-two-states": design(random_problem(5, n=2, nx=2), method="exact", budget=BUDGET),
        "paper-theorem2": design(paper, method="theorem2"),
        "slow": design(real_network(random_problem(5, n=2, nx=2), radius=0.98), method="least-variance"),
        "two-outputs-theorem2": design(random_problem(5, n=2, nx=2, nz=2), method="theorem2"),
    }
    for kind, problem in real.items():
        made[kind.replace(", ", "-").replace(" ", "-")] = design(problem, method="exact", budget=BUDGET)
    for kind in ("seen", "unbiased, seen, links, unstable"):
        made[f"{kind.replace(', ', '-')}-decomposed"] = design(real[kind], method="decomposed")
    documents = {name: gains.document() for name, gains in made.items()}
    documents["theorem2-alone"] = alone(documents["paper-theorem2"])
    documents["full"] = full(made["paper-theorem2"])
    return documents


def alone(document: Document) -> Document:
    """Theorem 1's bound without the exact gain beside it."""
    found = copy.deepcopy(document)
    claim = found["certificate"]
    claim |= {"kind": "lyapunov", "gamma": claim.pop("theorem1_gamma")}
    return found


def full(gains: Gains) -> Document:
    """The same P, stored as one matrix of each mode."""
    found = gains.document()
    claim = found["certificate"]
    claim["P"] = dict(zip(gains.problem.mode_names, lyapunov_matrix(gains).tolist(), strict=True))
    claim["form"] = "full"
    del claim["Q"], claim["R"]
    return found


def mutants(document: Document, place: Place) -> Iterator[Document]:
    """The file with one number moved, up and down; one that may be above its lower end claims none."""
    for step in STEPS:
        found = copy.deepcopy(document)
        found["certificate"].pop("exact", None)
        inner = found
        for key in place[:-1]:
            inner = inner[key]
        inner[place[-1]] *= 1.0 + step
        if "transition" in place:
            inner[1] = 1.0 - inner[0]
        try:
            found["problem_digest"] = Problem.from_document(found["problem"]).digest()
            yield Gains.from_document(found).document()
        except InputError:  # such as a probability above 1
            continue


def false(document: Document) -> bool:
    verdict = verify(Gains.from_document(document))
    return not verdict.holds and "it is false" in (verdict.failure or "")


def write(folder: str, name: str, document: Document) -> None:
    path = FOLDER / folder / f"{name}.json"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(Gains.from_document(document).canonical())


def main() -> None:
    shutil.rmtree(FOLDER, ignore_errors=True)
    documents = designed()
    for name, document in documents.items():
        write("correct", name, document)
    for name, (base, place) in MUTANTS.items():
        found = next((mutant for mutant in mutants(documents[base], place) if false(mutant)), None)
        print(name, base, "found" if found else "NOT FOUND", flush=True)
        if found:
            write("incorrect", name, found)


if __name__ == "__main__":
    main()
