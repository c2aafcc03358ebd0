"""What Theorem 2 cannot undercut: below everything that is certified; and false weights prove nothing."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from networks import random_gains, random_problem, real_network
from places import ROOT

from agent.contract.arrays import Array
from agent.contract.gains import Gains
from agent.contract.problem import Problem
from designer.cli import main
from designer.gain.exact import Operator
from designer.lmi import multipliers
from designer.lmi.multipliers import least_of_lmi
from designer.model.error_model import error_model
from designer.problems import find
from designer.proof import least, silent
from designer.proof.least import at_least
from designer.proof.reachable import seen_from
from designer.proof.silent import at_least_by_silence, least_again
from designer.search.starts import node_regression
from designer.synthesis import design

LOSSY = find("zhu2020-lossy")
PROBLEMS = {
    "paper, example 2": LOSSY,
    "hidden losses": random_problem(11),
    "seen losses, lossy links": real_network(random_problem(11), seen=["n1"], delivery=0.7),
    "unstable": real_network(random_problem(11), seen=True, delivery=0.7, unbiased=True, radius=1.1),
    "unbiased with hidden losses": real_network(random_problem(11), seen=["n1"], delivery=0.7, unbiased=True),
}
problems = pytest.mark.parametrize("problem", PROBLEMS.values(), ids=PROBLEMS)


@pytest.fixture(scope="module")
def V() -> Array:
    """Weights that prove a bound of the paper's second example."""
    return next(V for V in multipliers.multipliers(LOSSY) if at_least(LOSSY, V) is not None)


@problems
def test_the_optimum_is_enclosed(problem: Problem) -> None:
    """Between what is proved from below and what Theorem 1 certifies of a design there is a thousandth at most."""
    low, certified = least_of_lmi(problem), design(problem, method="decomposed").certificate.by_theorem1
    assert low is not None
    assert certified is not None
    assert low <= certified <= low * (1.0 + 1e-3)


def test_the_printed_gamma_of_the_first_example_is_below_all_that_the_theorem_gives() -> None:
    """Its best weights lie on a line that no floats meet; the disturbance that nobody sees stands on it."""
    problem = find("zhu2020-ideal")
    low, certified = least_of_lmi(problem), design(problem, method="decomposed").certificate.by_theorem1
    assert low is not None
    assert certified is not None
    assert 0.23 < low <= certified <= low * (1.0 + 1e-3)


@problems
def test_no_gains_leave_less_of_a_regression(problem: Problem) -> None:
    """With any moments: E e_i+ e_i+' - Res_i > 0 for any gains, by the error model, which shares no code with it."""
    rng = np.random.default_rng(3)
    K_bar, H_bar = random_gains(problem, seed=3)
    operator = Operator(error_model(problem, K_bar, H_bar))
    order, nx, modes = operator.size + operator.nw, problem.nx, len(problem.topologies)
    roots = rng.normal(size=(modes, order, order))
    moments = roots @ roots.swapaxes(1, 2)
    arrived = operator.carry(moments)
    for i in range(problem.n):
        at = slice(operator.p + i * nx, operator.p + (i + 1) * nx)
        left = np.array([residual(problem, s, i, moments[s]) for s in range(modes)])
        best = np.array([by_floats(problem, s, i, moments[s]) for s in range(modes)])
        assert left == pytest.approx(best, rel=1e-6, abs=1e-9 * np.abs(best).max())
        for t in range(modes):
            least_arrives = np.tensordot(operator.transition[:, t], left, axes=1)
            assert np.linalg.eigvalsh(arrived[t, at, at] - least_arrives).min() > 0.0


def residual(problem: Problem, s: int, i: int, moments: Array) -> Array:
    with least.ctx.workprec(256):
        (V,) = least.symmetric(moments[None])
        Res = least._residual(least.regression(problem, s, i, seen_from(problem)), V, np.ones(len(moments), dtype=bool))
        return np.array([float(entry.mid()) for entry in Res.entries()]).reshape(problem.nx, problem.nx)


def by_floats(problem: Problem, s: int, i: int, moments: Array) -> Array:
    """The same by the regression that the search starts from."""
    found = node_regression(problem, s, i)
    across, gram = found.t @ moments @ found.mean.T, found.mean @ moments @ found.mean.T
    gram = gram + sum(noise @ moments @ noise.T for noise in found.noises)
    return np.asarray(found.t @ moments @ found.t.T - across @ np.linalg.pinv(gram, rcond=1e-12) @ across.T)


def test_weights_that_do_not_fit_prove_nothing(V: Array) -> None:
    """A sign turned, an error weighed too much or too little, weights of another mode, what is no number."""
    p, nx = LOSSY.plant_states, LOSSY.nx
    errors = slice(p, p + LOSSY.n * nx)
    turned, indefinite, heavy, light, lost = -V, V.copy(), V.copy(), V.copy(), V.copy()
    indefinite[0, -1, -1] *= -1.0
    heavy[:, errors, errors] *= 1.01
    light[2:, :p, :p] *= 0.5
    lost[1, 0, 0] = np.nan
    for wrong in (turned, indefinite, heavy, light, lost, V[[1, 0, 2, 3]]):
        assert at_least(LOSSY, wrong) is None


def test_weights_may_be_of_any_size(V: Array) -> None:
    assert at_least(LOSSY, 2.0**20 * V) == at_least(LOSSY, V)


def test_without_a_check_a_false_bound_would_pass(V: Array, monkeypatch: pytest.MonkeyPatch) -> None:
    """So it is that what is left for R and Q has to be positive definite that refuses these weights."""
    certified = design(LOSSY, method="decomposed").certificate.by_theorem1
    errors = slice(LOSSY.plant_states, LOSSY.plant_states + LOSSY.n * LOSSY.nx)
    wrong = V.copy()
    wrong[:, errors, errors] *= 0.999  # no longer positive definite, and less for the errors to carry
    assert at_least(LOSSY, wrong) is None
    monkeypatch.setattr(least, "_positive", lambda U: True)
    believed = at_least(LOSSY, wrong)
    assert certified is not None
    assert believed is not None
    assert believed > certified


def one_node(*, a: float, stays: float, beta: float = 1.0) -> Problem:
    """A node with one state, alone, in two modes."""
    return Problem.from_document(
        {
            "name": "one",
            "plant": {"A": [[a]], "B": [[1.0]], "M": [[1.0]]},
            "node": [{"name": "a", "C": [[1.0]], "D": [[-1.0]], "arrival_probability": beta}],
            "topology": [{"name": "s", "hears": {}}, {"name": "t", "hears": {}}],
            "markov": {"transition": [[stays, 1.0 - stays], [1.0 - stays, stays]], "initial": "s"},
        }
    )


def test_the_silent_disturbance_by_hand() -> None:
    """w = beta x keeps the mean of y at 0 and x+ = (a + beta) x: gamma^2 >= ((a + beta)^2 - 1) / beta^2, no less."""
    for beta in (1.0, 0.75):
        problem = one_node(a=0.75, stays=0.5, beta=beta)
        low, square = at_least_by_silence(problem), ((0.75 + beta) ** 2 - 1.0) / beta**2
        assert low is not None
        assert low**2 == pytest.approx(square, rel=1e-12)
        assert low**2 <= square
        certified = design(problem, method="decomposed").certificate.by_theorem1
        assert certified is not None
        assert low <= certified


def test_what_is_silent_has_to_grow_within_its_mode() -> None:
    """Where the chain leaves the mode before x has grown, R and Q of the other modes may be as large as they like."""
    assert at_least_by_silence(one_node(a=0.75, stays=0.25)) is None  # 0.25 * 1.75^2 < 1
    assert at_least_by_silence(one_node(a=-0.75, stays=0.5)) is None  # it decays


def test_a_silent_disturbance_is_hidden_from_all_who_are_heard() -> None:
    """A second node, which measures x without w, shows it: who hears that node is not fooled."""
    document = one_node(a=0.75, stays=0.5).document()
    document["node"] = [*document["node"], {"name": "b", "C": [[1.0]], "D": [[0.0]], "arrival_probability": 1.0}]
    for topology in document["topology"]:
        topology.update(adjacency=[[1.0, 1.0], [0.0, 1.0]])
    assert at_least_by_silence(Problem.from_document(document)) is None
    for topology in document["topology"]:
        topology.update(adjacency=[[1.0, 0.0], [0.0, 1.0]])
    assert at_least_by_silence(Problem.from_document(document)) == at_least_by_silence(one_node(a=0.75, stays=0.5))


def test_eigenvalues_that_balls_do_not_tell_apart_prove_nothing() -> None:
    """A double one has no vector that is enclosed; a complex pair none that is real."""
    for rows in ([[2.0, 0.0], [0.0, 2.0]], [[1.0, -2.0], [2.0, 1.0]]):
        assert list(silent._real_pairs(silent.exact(np.array(rows)))) == []


def claiming(name: str, least: float) -> Gains:
    """Gains of the LMI, of a problem of the paper, whose file claims that."""
    gains = Gains.load(ROOT / "recordings" / "golden" / f"{name}.gains.json")
    return gains.model_copy(update={"certificate": gains.certificate.model_copy(update={"lmi_least": least})})


def test_what_a_file_claims_of_the_lmi_is_proved_again_refuted_or_left_open() -> None:
    """By the silent disturbance, by the P in the file, and between both not at all."""
    found = at_least_by_silence(find("zhu2020-ideal"))
    assert found is not None
    assert least_again(claiming("zhu2020-ideal", found)) is True
    assert least_again(claiming("zhu2020-ideal", float(np.nextafter(found, 1.0)))) is None
    own = claiming("zhu2020-ideal", 0.1).certificate.gamma
    assert least_again(claiming("zhu2020-ideal", own)) is None
    assert least_again(claiming("zhu2020-ideal", float(np.nextafter(own, 1.0)))) is False
    assert least_again(claiming("zhu2020-lossy", 0.3479)) is None


@pytest.mark.parametrize(
    ("least", "code", "says"),
    [
        (0.3297, 0, "proved  no gains have less than 0.3297 by"),
        (0.3297735, 1, "its own have less"),
        (0.329773, 0, "claimed lmi_least = 0.329773: not proved here"),
    ],
)
def test_verify_says_which(
    least: float, code: int, says: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "gains.json"
    path.write_bytes(claiming("zhu2020-ideal", least).canonical())
    assert main(["verify", str(path)]) == code
    assert says in capsys.readouterr().out
