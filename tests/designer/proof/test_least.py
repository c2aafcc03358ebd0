"""What Theorem 2 cannot undercut: below everything that is certified; and false weights prove nothing."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from networks import random_gains, random_problem, real_network
from places import ROOT

from agent.contract.arrays import Array
from agent.contract.errors import InputError
from agent.contract.gains import Gains, Weights
from agent.contract.problem import Problem
from designer.cli import main
from designer.gain.exact import Operator
from designer.model.error_model import error_model
from designer.problems import find
from designer.proof import least, silent
from designer.proof.least import at_least
from designer.proof.reachable import seen_from
from designer.proof.silent import at_least_by_silence
from designer.proof.undercut import least_again
from designer.search.starts import node_regression
from designer.synthesis import design
from designer.undercut import undercut

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
def weights() -> Weights:
    """Those that prove a bound of the paper's second example."""
    found = undercut(LOSSY).weights
    assert found is not None
    return found


@pytest.fixture(scope="module")
def V(weights: Weights) -> Array:
    """The same for the states as they are."""
    V, T = weights.matrices(LOSSY.mode_names), np.linalg.inv(weights.states)
    back = np.eye(V.shape[1])
    for at in range(0, V.shape[1] - LOSSY.nw, LOSSY.nx):
        back[at : at + LOSSY.nx, at : at + LOSSY.nx] = T
    return np.asarray(back @ V @ back.T)


@problems
def test_the_optimum_is_enclosed(problem: Problem) -> None:
    """Between what is proved from below and what Theorem 1 certifies of a design there is a thousandth at most."""
    low, certified = undercut(problem).gamma, design(problem, method="decomposed").certificate.by_theorem1
    assert low is not None
    assert certified is not None
    assert low <= certified <= low * (1.0 + 1e-3)


def test_the_printed_gamma_of_the_first_example_is_below_all_that_the_theorem_gives() -> None:
    """Its best weights lie on a line that no floats meet; the disturbance that nobody sees stands on it."""
    problem = find("zhu2020-ideal")
    low, certified = undercut(problem).gamma, design(problem, method="decomposed").certificate.by_theorem1
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


def claiming(name: str, least: float, weights: Weights | None = None) -> Gains:
    """Gains of the LMI, of a problem of the paper, whose file claims that."""
    gains = Gains.load(ROOT / "recordings" / "golden" / f"{name}.gains.json")
    claim = {"lmi_least": least, "lmi_weights": weights}
    return gains.model_copy(update={"certificate": gains.certificate.model_copy(update=claim)})


def holds(gains: Gains) -> bool | None:
    found = least_again(gains)
    assert found is not None
    return found.holds


def test_what_a_file_claims_of_the_lmi_is_proved_again_refuted_or_left_open() -> None:
    """By the silent disturbance, by the P in the file, and between both, without weights, not at all."""
    found = at_least_by_silence(find("zhu2020-ideal"))
    assert found is not None
    assert holds(claiming("zhu2020-ideal", found)) is True
    assert holds(claiming("zhu2020-ideal", float(np.nextafter(found, 1.0)))) is None
    own = claiming("zhu2020-ideal", 0.1).certificate.gamma
    assert holds(claiming("zhu2020-ideal", own)) is None
    assert holds(claiming("zhu2020-ideal", float(np.nextafter(own, 1.0)))) is False
    assert holds(claiming("zhu2020-lossy", 0.3479)) is None
    assert least_again(Gains.load(ROOT / "recordings" / "golden" / "zhu2020-lossy.gains.json")) is None


def test_the_weights_of_a_file_prove_what_it_claims_and_no_more(weights: Weights) -> None:
    """Not a part in a million more; and other weights, or these for another problem, prove it no longer."""
    least, far = undercut(LOSSY).gamma, 1.0 + 1e-6
    assert least is not None
    assert holds(claiming("zhu2020-lossy", least, weights)) is True
    assert holds(claiming("zhu2020-lossy", least * far, weights)) is False
    assert holds(claiming("zhu2020-ideal", least, weights)) is False, "which has the same shape"
    document = LOSSY.document()
    document["node"][0]["arrival_probability"] = 0.9
    other = undercut(Problem.from_document(document)).weights
    for wrong in (other, stretched(weights, 0, 0), stretched(weights, -1, -1), stretched(weights, 3, 2)):
        assert holds(claiming("zhu2020-lossy", least, wrong)) is False


def stretched(weights: Weights, row: int, column: int) -> Weights:
    """One number of one mode, a part in ten thousand larger."""
    rows = [numbers.copy() for numbers in weights.V["2"]]
    rows[row][column] *= 1.0 + 1e-4
    return weights.model_copy(update={"V": {**weights.V, "2": tuple(rows)}})


@pytest.mark.parametrize(
    ("least", "code", "says"),
    [
        (0.3297, 0, "proved  no gains have less than 0.3297 by an LMI of this form: no node sees some disturbance"),
        (0.3297735, 1, "claims too much: no gains have less by an LMI than 0.3297735, it says, but its own have less"),
        (0.329773, 0, "claimed lmi_least = 0.329773: not proved here; no weights are stored"),
    ],
)
def test_verify_says_which(
    least: float, code: int, says: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "gains.json"
    path.write_bytes(claiming("zhu2020-ideal", least).canonical())
    assert main(["verify", str(path)]) == code
    assert says in capsys.readouterr().out


def test_verify_proves_by_the_weights_of_a_file(
    weights: Weights, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path, least = tmp_path / "gains.json", undercut(LOSSY).gamma
    assert least is not None
    path.write_bytes(claiming("zhu2020-lossy", least, weights).canonical())
    assert main(["verify", str(path)]) == 0
    assert f"proved  no gains have less than {least} by an LMI of this form: by the weights" in capsys.readouterr().out
    assert main(["verify", str(path), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["lmi_least"] == "proved"
    path.write_bytes(claiming("zhu2020-lossy", least * (1.0 + 1e-6), weights).canonical())
    assert main(["verify", str(path)]) == 1
    assert f"but its weights show no more than {least}; gamma = 0.347" in capsys.readouterr().out


def test_weights_that_are_none_are_refused_as_a_file_is_read(weights: Weights) -> None:
    """A mode too many, a row too long, states that are not those of the problem."""
    short = {mode: rows[:-1] for mode, rows in weights.V.items()}
    for wrong, why in (
        ({"V": {**weights.V, "9": weights.V["1"]}}, "modes are"),
        ({"V": short}, "no lower triangle of 11 rows"),
        ({"states": np.eye(3)}, "must have 2 columns"),
    ):
        with pytest.raises(InputError, match=why):
            claiming("zhu2020-lossy", 0.3, weights.model_copy(update=wrong))


# what is not looked at, and what w never moves
def test_entries_that_nothing_looks_at_may_be_anything() -> None:
    """Of a line of nodes two far ones never meet; what is 0 there is no number, and what somebody looks at is."""
    chain = np.eye(4, dtype=bool) | np.eye(4, k=1, dtype=bool) | np.eye(4, k=-1, dtype=bool)
    everything = np.ones(4, dtype=bool)
    assert sorted(map(sorted, least.cliques(chain, everything))) == [[0, 1], [1, 2], [2, 3]]
    ring = chain.copy()
    ring[0, 3] = ring[3, 0] = True
    assert list(least.cliques(ring, everything)) == [[0, 1, 2, 3]], "a ring cannot always be completed"


def test_states_that_w_never_moves_change_nothing() -> None:
    """One more state, which is measured and is part of z, but moves by itself: it stays 0, and so does its error."""
    document = LOSSY.document()
    plant = document["plant"]
    plant["A"] = [[*row, 0.3] for row in plant["A"]] + [[0.0, 0.0, 0.9]]
    plant["B"], plant["M"] = [*plant["B"], [0.0]], [[*row, 5.0] for row in plant["M"]]
    for node in document["node"]:
        node["C"] = [[*row, 1.0] for row in node["C"]]
    still = Problem.from_document(document)
    assert undercut(still).gamma == undercut(LOSSY).gamma
