"""Has the kernel of Coq prove the gamma of a gains file: writes its numbers into a file for Coq, and runs coqc on that.

    python tools/coq_certificate.py GAINS.json FOLDER [theorem1]

FOLDER then has model.v (what is said), decide.v and sound.v (what decides it, and why that is right), and
certificate.v, the numbers of the file. Exit code 0: Coq accepts all of it; 1: it does not; 2: it was not asked.

Coq works (17) and (18) out itself from plant, gains, probabilities and gamma. Where P is not stored, or gamma is below
what (17) and (18) prove, matrices of every step of the recursion are found here in floats: Coq believes none of them.
Each of some ten to hundred steps takes Coq a second for 11 numbers in [w; eta], ten for 38: "theorem1" leaves them out.
"""

from __future__ import annotations

import json
import runpy
import shutil
import subprocess
import sys
from fractions import Fraction as Q
from operator import mul
from pathlib import Path
from typing import Any

HERE = Path(__file__).parent
CHECKER = runpy.run_path(str(HERE / "check_certificate.py"))
STEPS = 1000  # of the recursion at most
RAISED = 1e-10  # by how much of P every step is raised, so that its inequality is strict
HEAD = "Require Import QArith List model decide sound.\nImport ListNotations.\nOpen Scope Q_scope.\n"
Matrix = list[list[Any]]
Document = dict[str, Any]


def main() -> int:
    if len(sys.argv) not in (3, 4) or sys.argv[3:] not in ([], ["theorem1"]):
        print("usage: coq_certificate.py GAINS.json FOLDER [theorem1]")
        return 2
    folder = Path(sys.argv[2])
    try:
        number = dict.fromkeys(("parse_float", "parse_int"), lambda text: Q(float(text)))
        file = json.loads(Path(sys.argv[1]).read_text(), object_pairs_hook=CHECKER["unique"], **number)
        text = certificate(file, with_recursion=not sys.argv[3:])
    except (ArithmeticError, AssertionError, LookupError, OSError, TypeError, ValueError) as error:
        print(f"Coq was not asked: {type(error).__name__}: {error}")
        return 2
    if shutil.which("coqc") is None:
        print("Coq was not asked: coqc is not on PATH; Debian's package is coq")
        return 2
    folder.mkdir(parents=True, exist_ok=True)
    for source in (HERE / "coq").glob("*.v"):
        shutil.copy(source, folder)
    (folder / "certificate.v").write_text(text)
    return proved(folder)


def proved(folder: Path) -> int:
    """The exit code, by what Coq says of the four files."""
    for name in ("model", "decide", "sound", "certificate"):
        accepted, said = asked(folder, name)
        if not accepted:
            print(f"refused: {folder / name}.v is not accepted:\n{said[:2000]}")
            return 1
    print(f"proved: Coq accepts the theorems of {folder / name}.v. What it says they rest on:\n{said}")
    return 0


def asked(folder: Path, name: str) -> tuple[bool, str]:
    """Whether Coq accepts a file, and what it says."""
    ran = subprocess.run(["coqc", "-q", f"{name}.v"], cwd=folder, capture_output=True, text=True)
    return not ran.returncode, ran.stderr.strip() or ran.stdout.strip()


def certificate(file: Document, with_recursion: bool = True) -> str:
    """The file for Coq: the filters, and theorems of every gamma that the gains file claims."""
    claim, model = file["certificate"], CHECKER["model"](file["problem"], file["K"], file["H"])
    with_x = "true" if model[-1] else "false"
    of_P = [claim["gamma"]] if claim["kind"] == "lyapunov" else []
    of_P += [claim["theorem1_gamma"]] if "theorem1_gamma" in claim else []
    P = stored(file, model[-1]) if claim["form"] != "summed" or of_P else None
    lines = [HEAD, *filters(file)]
    for k, gamma in enumerate(of_P, 1):
        lines += [f"Definition P_{k} : list matrix := {listed(P)}."]
        lines += claimed(k, gamma, f"{with_x} [P_{k}]")
        lines += [f"Theorem inequalities_{k} : theorem_1 filters gamma_{k} {with_x} P_{k}."]
        lines += [f"Proof. exact (inequalities _ _ _ _ decided_{k}). Qed."]
    assert of_P or with_recursion, "(17) and (18) prove no gamma of this file"
    if claim["kind"] != "lyapunov" and with_recursion:
        levels = recursion(model, claim["gamma"], P)
        k = len(of_P) + 1
        lines += [f"Definition steps_{k} : list (list matrix) := {listed(levels)}."]
        lines += claimed(k, claim["gamma"], f"{with_x} steps_{k}")
    return "\n".join(lines) + "\n"


def claimed(k: int, gamma: Q, by: str) -> list[str]:
    return [
        f"Definition gamma_{k} := {number(gamma)}. (* {float(gamma)} *)",
        f"Lemma decided_{k} : decide filters gamma_{k} {by} = true.",
        "Proof. vm_cast_no_check (eq_refl true). Qed.",
        f"Theorem bound_{k} : bounded filters gamma_{k}.",
        f"Proof. exact (bound _ _ _ _ decided_{k}). Qed.",
        f"Print Assumptions bound_{k}.",
    ]


def filters(file: Document) -> list[str]:
    """Plant, nodes, network and gains, number by number."""
    problem = file["problem"]
    plant, nodes, modes = problem["plant"], problem["node"], problem["topology"]
    names = [node["name"] for node in nodes]
    links = {(link["receiver"], link["sender"]): link["delivery_probability"] for link in problem.get("link") or ()}
    sensors = [
        f"Sensor {number(v['arrival_probability'])} {'true' if v.get('loss') == 'seen' else 'false'} "
        f"{number(v.get('weight', Q(1)))} {listed(v['C'])} {listed(v['D'])}"
        for v in nodes
    ]
    K, H = (
        [[[file[letter][mode["name"]][i].get(j, []) for j in names] for i in names] for mode in modes]
        for letter in "KH"
    )
    parts = {
        **{letter: listed(plant[letter]) for letter in "ABM"},
        "nodes": "[" + ";\n    ".join(sensors) + "]",
        "rho": listed([[links.get((i, j), Q(1)) for j in names] for i in names]),
        "unbiased": "true" if problem.get("unbiased") else "false",
        "adjacency": listed([mode["adjacency"] for mode in modes]),
        "Pi": listed(problem["markov"]["transition"]),
        "K": listed(K),
        "H": listed(H),
    }
    return [
        "Definition filters : network := {|",
        ";\n".join(f"  {key} := {part}" for key, part in parts.items()) + " |}.",
    ]


def stored(file: Document, n_x: int) -> Matrix:
    """Of P in every mode the rows from the diagonal on, as far as its blocks reach."""
    claim, nodes = file["certificate"], [node["name"] for node in file["problem"]["node"]]

    def rows(mode: str) -> Matrix:
        whole = claim["form"] == "full"
        blocks = [claim["P"][mode]] if whole else [*[claim.get("R")][:n_x], *(claim["Q"][mode][i] for i in nodes)]
        return [[(X[i][j] + X[j][i]) / 2 for j in range(i, len(X))] for X in blocks for i in range(len(X))]

    return [rows(mode["name"]) for mode in file["problem"]["topology"]]


def number(q: Q | float) -> str:
    """A fraction whose denominator is a power of two, which Coq reads as it is."""
    above, below = q.as_integer_ratio()
    return f"({'-' * (above < 0)}{abs(above):#x}p-{below.bit_length() - 1})" if above else "0"


def listed(entries: Any) -> str:
    return "[" + "; ".join(map(listed, entries)) + "]" if isinstance(entries, list) else number(entries)


# The recursion, in floats: symmetric matrices as all of their rows.
def recursion(model: tuple[Any, ...], gamma: Q, P: Matrix | None) -> Matrix:
    """Y / gamma^2 of every step from M'M on until Y is below gamma^2 P, and that P; rows from the diagonal on."""
    terms, MM, Pi, n_w, _ = model
    modes = [[(float(v), [[float(a) for a in row] for row in V]) for v, V in of_mode] for of_mode in terms]
    Pi, g = [[float(p) for p in row] for row in Pi], float(gamma) ** 2

    def back(Y: list[Matrix]) -> list[Matrix]:
        bars = [summed(*(times(p, Y_t) for p, Y_t in zip(row, Y, strict=True))) for row in Pi]
        return [before(of_mode, bar, n_w, g) for of_mode, bar in zip(modes, bars, strict=True)]

    MM = [[float(a) for a in row] for row in MM]
    limit = [times(g, whole(P_s, len(MM))) for P_s in P] if P else invariant(back, MM, len(modes))
    raised = [times(RAISED, X) for X in limit]
    Y = [summed(MM, X) for X in raised]
    steps = [Y]
    while not all(map(below, Y, limit)):
        assert len(steps) < STEPS, f"the recursion does not end in {STEPS} steps"
        Y = [summed(F, X) for F, X in zip(back(Y), raised, strict=True)]
        steps.append(Y)
    upper = [[[[a / g for a in row[i:]] for i, row in enumerate(Y_s)] for Y_s in Y] for Y in steps]
    return [*upper, P or [[[a / g for a in row[i:]] for i, row in enumerate(X)] for X in limit]]


def invariant(back: Any, MM: Matrix, modes: int) -> list[Matrix]:
    """A Y that a step of the recursion makes smaller: the sum of what it makes of nearly M'M, as large as that goes."""
    size, trace = len(MM), sum(row[i] for i, row in enumerate(MM))
    MM = [[a + 1e-3 * trace / size * (i == j) for j, a in enumerate(row)] for i, row in enumerate(MM)]
    for bits in range(40):
        unit = times(2.0**-bits, MM)
        Y = [unit] * modes
        for _ in range(STEPS):
            try:
                F = back(Y)
            except ArithmeticError:  # it is worth more than gamma^2 w'w to a disturbance
                break
            if all(map(below, F, Y)):
                return Y
            Y = [summed(F_s, unit) for F_s in F]
    raise ArithmeticError("no P is found that satisfies (17)")


def before(terms: list[tuple[float, Matrix]], bar: Matrix, n_w: int, g: float) -> Matrix:
    """What a step of one mode makes of Y: the largest E eta(k+1)' Y eta(k+1) - g w'w over w, as a matrix of eta."""
    order = len(bar) + n_w
    S = [[0.0] * order for _ in range(order)]
    for variance, V in terms:
        YV = [[sum(map(mul, row, column)) for column in zip(*V, strict=True)] for row in bar]
        columns = list(zip(*YV, strict=True))
        S = [
            [a + variance * sum(map(mul, v, column)) for a, column in zip(row, columns, strict=True)]
            for row, v in zip(S, zip(*V, strict=True), strict=True)
        ]
    left = [[g * (i == j < n_w) - a for j, a in enumerate(row)] for i, row in enumerate(S)]
    return [[-a for a in row] for row in eliminated(left, n_w)]


def eliminated(X: Matrix, count: int) -> Matrix:
    """What is left of a symmetric matrix without the first rows and columns; their pivots have to be positive."""
    for _ in range(count):
        (pivot, *first), *rest = X
        if pivot <= 0:
            raise ArithmeticError("a matrix that has to be positive definite is not, in floats")
        X = [[a - b * c / pivot for a, c in zip(row, first, strict=True)] for b, *row in rest]
    return X


def below(X: Matrix, Y: Matrix) -> bool:
    """Whether Y - X is positive definite, by a margin that outdoes rounding."""
    try:
        eliminated(
            [
                [b * (1 - RAISED * (i == j)) - a for j, (a, b) in enumerate(zip(r, q, strict=True))]
                for i, (r, q) in enumerate(zip(X, Y, strict=True))
            ],
            len(X),
        )
    except ArithmeticError:
        return False
    return True


def whole(rows: Matrix, size: int) -> Matrix:
    """The matrix of which these are the rows from the diagonal on."""
    padded = [[*map(float, row), *[0.0] * (size - i - len(row))] for i, row in enumerate(rows)]
    return [[padded[min(i, j)][abs(i - j)] for j in range(size)] for i in range(size)]


def summed(*Xs: Matrix) -> Matrix:
    return [[sum(entries) for entries in zip(*rows, strict=True)] for rows in zip(*Xs, strict=True)]


def times(c: float, X: Matrix) -> Matrix:
    return [[c * a for a in row] for row in X]


if __name__ == "__main__":
    sys.exit(main())
