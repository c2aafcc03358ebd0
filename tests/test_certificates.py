"""The checker in tools/, which shares no line with peakmesh, beside `verify`, on files of every kind."""

from __future__ import annotations

import ast
import copy
import json
import random
import runpy
from fractions import Fraction
from operator import mul
from pathlib import Path

import pytest
from places import ROOT

from agent.contract.gains import Gains
from designer.proof.certificate import verify

CHECKER = ROOT / "tools" / "check_certificate.py"
ELIMINATED = runpy.run_path(str(CHECKER))["eliminated"]
CORRECT, INCORRECT = (
    sorted((ROOT / "tools" / "certificates" / kind).glob("*.json")) for kind in ("correct", "incorrect")
)
DESIGNED = [*CORRECT, *sorted((ROOT / "recordings" / "golden").glob("*.gains.json"))]
PROVED, DISPROVED, UNDECIDED = 0, 1, 3


@pytest.fixture
def check(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
    """The checker as it is called: its exit code, and what it prints."""

    def run(path: Path, checker: Path = CHECKER) -> tuple[int, str]:
        monkeypatch.setattr("sys.argv", [str(checker), str(path)])
        with pytest.raises(SystemExit) as ended:
            runpy.run_path(str(checker), run_name="__main__")
        return ended.value.code, capsys.readouterr().out

    return run


def edited(path: Path, to: Path, **changes: object) -> Path:
    """The file with other entries of its certificate."""
    document = json.loads(path.read_text())
    document["certificate"] |= changes
    to.write_text(json.dumps(document))
    return to


@pytest.mark.parametrize("path", DESIGNED, ids=lambda path: path.stem)
def test_what_is_designed_is_proved(path: Path, check) -> None:
    code, said = check(path)
    assert (code, said.split(":")[0]) == (PROVED, "proved")
    assert str(Gains.load(path).certificate.gamma) in said
    assert verify(Gains.load(path)).holds


@pytest.mark.parametrize("path", INCORRECT, ids=lambda path: path.stem)
def test_what_claims_too_much_is_disproved(path: Path, check) -> None:
    """One number of a correct file is moved: by `verify` it is false, by the checker too, with a vector."""
    code, said = check(path)
    assert (code, said.split(":")[0]) == (DISPROVED, "disproved")
    assert float(said.split("v'Xv = ")[1].split()[0]) <= 0.0
    assert not verify(Gains.load(path)).holds


def test_every_kind_of_number_is_moved() -> None:
    moved = {path.stem.split("-")[0] for path in INCORRECT}
    assert moved == {"A", "B", "C", "D", "M", "K", "H", "P", "Q", "R", "Pi", "beta", "rho", "gamma", "weight"}
    kinds = {(claim.kind, claim.form) for path in CORRECT for claim in [Gains.load(path).certificate]}
    assert kinds == {("exact", "summed"), ("exact", "structured"), ("exact", "full"), ("lyapunov", "structured")}


@pytest.mark.parametrize("path", DESIGNED, ids=lambda path: path.stem)
def test_a_gamma_that_is_lower_is_not_proved(path: Path, check, tmp_path: Path) -> None:
    """Below the lower end of the exact gain nothing is proved, and W or (18) shows it."""
    claim = Gains.load(path).certificate
    assert claim.exact is not None
    lower = edited(path, tmp_path / "lower.json", gamma=claim.exact[0] * (1.0 - 1e-9))
    assert check(lower)[0] == DISPROVED


@pytest.mark.parametrize("kind", ["lyapunov", "whatever"])
def test_a_kind_is_not_believed(kind: str, check, tmp_path: Path) -> None:
    """A file that says of a gamma below the exact gain that it is of another kind is not proved for that."""
    path = next(path for path in CORRECT if path.stem == "paper-theorem2")
    gamma = Gains.load(path).certificate.gamma
    assert check(edited(path, tmp_path / "other.json", kind=kind, gamma=0.99 * gamma))[0] == DISPROVED


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("gamma", "no_gamma"),
        ('"gamma":', '"gamma":9.0,"gamma":'),
        ('"A":', '"A":[[0.1]],"A":'),
        ('"gamma":', '"gamma":NaN,"old":'),
        ("{", "["),
    ],
)
def test_what_cannot_be_read_is_undecided(old: str, new: str, check, tmp_path: Path) -> None:
    path = tmp_path / "gains.json"
    path.write_text(CORRECT[0].read_text().replace(old, new))
    code, said = check(path)
    assert (code, said.split(":")[0]) == (UNDECIDED, "undecided")


def test_rows_of_chances_sum_to_1(check, tmp_path: Path) -> None:
    """A row that does not is no chain, and dividing by its sum would make another one of it."""
    path = next(path for path in CORRECT if path.stem == "paper-exact")
    document = json.loads(path.read_text())
    for more, answer in ((1e-12, PROVED), (1e-2, UNDECIDED), (-1e-8, UNDECIDED)):
        changed = copy.deepcopy(document)
        changed["problem"]["markov"]["transition"][0][0] += more
        other = tmp_path / "row.json"
        other.write_text(json.dumps(changed))
        assert check(other)[0] == answer


def test_no_gamma_is_negative(check, tmp_path: Path) -> None:
    """Nor is its square what is meant."""
    path = next(path for path in CORRECT if path.stem == "paper-exact")
    for gamma in (0.0, -Gains.load(path).certificate.gamma):
        assert check(edited(path, tmp_path / "negative.json", gamma=gamma))[0] == DISPROVED


def test_what_is_left_is_rounded_to_the_side_that_is_asked_for() -> None:
    """Of small integers, where rounding is all that counts: against fractions."""
    rng = random.Random(0)
    for order in (2, 3, 4) * 40:
        A = [[rng.randint(-4, 4) for _ in range(order)] for _ in range(order)]
        full = [[sum(map(mul, a, b)) + (2 if i == j else 0) for j, b in enumerate(A)] for i, a in enumerate(A)]
        exact = Fraction(full[-1][-1]) - _taken(full)
        rows = [row[i:] for i, row in enumerate(full)]
        (above, _), (below, _) = (ELIMINATED(rows, order - 1, up) for up in (1, -1))
        assert above is None or above[0][0] >= exact
        assert below is None or below[0][0] <= exact


def _taken(full: list[list[int]]) -> Fraction:
    """By what the last entry falls as all before it are eliminated."""
    X = [[Fraction(a) for a in row] for row in full]
    last = X[-1][-1]
    for k in range(len(X) - 1):
        for i in range(k + 1, len(X)):
            factor = X[i][k] / X[k][k]
            X[i] = [a - factor * b for a, b in zip(X[i], X[k], strict=True)]
    return last - X[-1][-1]


def test_no_probability_is_above_1(check, tmp_path: Path) -> None:
    """What is negative of a variance would make up for anything."""
    assert check(_of_the_first_node(tmp_path, "arrival_probability", 1.5))[0] == UNDECIDED


def test_what_it_does_not_know_it_does_not_decide(check, tmp_path: Path) -> None:
    """A problem file that says more some day may mean another model."""
    assert check(_of_the_first_node(tmp_path, "delay", 0.5))[0] == UNDECIDED


def test_what_may_be_off_changes_nothing_of_what_is_claimed_of_the_numbers_as_they_are(check, tmp_path: Path) -> None:
    assert check(_of_the_first_node(tmp_path, "tolerance", {"C": "1%", "arrival_probability": 0.1}))[0] == PROVED


def _of_the_first_node(folder: Path, key: str, value: object) -> Path:
    """A correct file of which the problem says this of its first node."""
    document = json.loads(CORRECT[0].read_text())
    document["problem"]["node"][0][key] = value
    path = folder / "gains.json"
    path.write_text(json.dumps(document))
    return path


def test_the_own_gain_of_an_unbiased_node_is_the_exact_one(check, tmp_path: Path) -> None:
    """A less all others, as the node steps by; the one in the file, which is that rounded, is not used."""
    document = json.loads(next(path for path in CORRECT if path.stem == "unbiased").read_text())
    document["K"]["m0"]["n0"]["n0"] = [[99.0]]
    path = tmp_path / "gains.json"
    path.write_text(json.dumps(document))
    assert check(path)[0] == PROVED


BROKEN = {  # a line of the checker, what is wrong with it, and a file on which it then errs
    "nothing is left to chance": ("if 0 < p < 1} |", "if p is form} |", "beta-hidden"),
    "links are not": ("if 0 < p < 1} |", 'if 0 < p < 1 and name[0] == "theta"} |', "rho"),
    "all is delivered": ("rho.get((names[i], names[j]), Q(1))", "Q(1)", "Pi-links"),
    "seen is hidden": ("if seen[j] else total", "if not seen[j] else total", "beta-seen"),
    "all count alike": ('v.get("weight", Q(1))', "Q(1)", "weighted"),
    "x is left out": ('0 if p.get("unbiased") and', "0 if", "gamma-links"),
    "no weights": ("scaled(K_i[names[j]], a[j])", "K_i[names[j]]", "unbiased"),
    "modes as likely": ("a / sum(row) for a in row", "Q(1, len(Pi)) for a in row", "paper-exact"),
    "(17) holds": ("over(X, gP, k, 1), over(X, gP, k, -1)", "[[1]], [[1]]", "H-theorem2"),
    "(18) holds": ("less(scaled(X, t), scaled(MM, g))", "X", "gamma-beside"),
    "any end is one": ("proved(map(less, gP, Y))", "True", "D"),
    "twice g": ("[[g] + [0]", "[[2 * g] + [0]", "H"),
    "a mode is left out": ("zip(Y, Pi[s], strict=True)", "zip(Y, [1 - Pi[s][0], *Pi[s][1:]])", "Pi"),
    "all pivots are positive": ("if pivot <= 0", "if pivot == 0", "gamma"),
}


@pytest.mark.parametrize("what", BROKEN)
def test_a_checker_that_is_wrong_is_found_out(what: str, check, tmp_path: Path) -> None:
    old, new, stem = BROKEN[what]
    text = CHECKER.read_text()
    assert text.count(old) == 1
    broken = tmp_path / "broken.py"
    broken.write_text(text.replace(old, new))
    path = next(path for path in CORRECT + INCORRECT if path.stem == stem)
    assert (check(path, broken)[0] == PROVED) is (path in INCORRECT)


def test_it_is_short_and_by_itself() -> None:
    text = CHECKER.read_text()
    imported = {name.name for node in ast.walk(ast.parse(text)) if isinstance(node, ast.Import) for name in node.names}
    imported |= {node.module for node in ast.walk(ast.parse(text)) if isinstance(node, ast.ImportFrom)}
    assert imported == {"json", "sys", "fractions", "math", "operator"}
    assert len(text.splitlines()) <= 120
