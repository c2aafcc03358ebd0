"""Whether errors die out: three answers, each with a proof or none, whatever the units and however slowly."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from agent.contract.arrays import Array
from agent.contract.gains import LinkMatrices
from agent.contract.problem import Problem
from designer import decay as module
from designer.analysis import GivenGains, analyse
from designer.decay import Rate, decay, spectral_radius
from designer.gain.exact import Operator, exact_gain
from designer.model.error_model import error_model, stacked_links
from designer.proof.by_balls import ByBalls
from designer.proof.by_floats import ByFloats
from designer.proof.prover import BALLS, FLOATS, Prover

Case = tuple[Problem, LinkMatrices, LinkMatrices]


def scalar(radius: float) -> Case:
    """One node that ignores all it measures: the error is the plant's own, and L is radius^2."""
    return chain([radius])


def chain(own: list[float]) -> Case:
    """Unbiased nodes in a line, which measure nothing, with these K_ii; the first has A, the others hear one before."""
    names = [f"n{i}" for i in range(len(own))]
    node = {"C": [[1.0]], "D": [[0.1]], "arrival_probability": 0.9, "loss": "seen"}
    problem = Problem.from_document(
        {
            "name": "chain",
            "unbiased": True,
            "plant": {"A": [[own[0]]], "B": [[1.0]], "M": [[1.0]]},
            "node": [{"name": name, **node} for name in names],
            "topology": [{"name": "t", "hears": {name: [before] for before, name in pairwise(names)}}],
            "markov": {"transition": [[1.0]], "initial": "t"},
        }
    )
    K: dict[str, dict[str, Array]] = {names[0]: {names[0]: np.array([[own[0]]])}}
    for before, name, k in zip(names, names[1:], own[1:], strict=False):
        K[name] = {before: np.array([[own[0] - k]]), name: np.array([[k]])}
    H = {name: {heard: np.zeros((1, 1)) for heard in of_node} for name, of_node in K.items()}
    return problem, {"t": K}, {"t": H}


def in_units(case: Case, units: Array) -> Case:
    """The same with x = diag(units) x'."""
    problem, K, H = case
    document, rows = problem.document(), units[:, None]
    plant = problem.plant
    document["plant"] |= {"A": (plant.A * units / rows).tolist(), "B": (plant.B / rows).tolist()}
    document["plant"] |= {"M": (plant.M * units).tolist()}
    for node, part in zip(document["node"], problem.nodes, strict=True):
        node["C"] = (part.C * units).tolist()

    def each(gains: LinkMatrices, columns: Array | float) -> LinkMatrices:
        return {
            mode: {i: {j: G * columns / rows for j, G in heard.items()} for i, heard in of_mode.items()}
            for mode, of_mode in gains.items()
        }

    return Problem.from_document(document), each(K, units), each(H, 1.0)


@pytest.mark.parametrize(
    ("radius", "stable"), [(0.5, True), (0.99999, True), (1.0 - 1e-8, True), (1.0 + 1e-8, False), (1.5, False)]
)
@pytest.mark.parametrize("makes", [FLOATS + BALLS, BALLS], ids=["floats first", "balls"])
@pytest.mark.parametrize("unit", [1.0, 1e-6, 2.0**40])
def test_stable_or_not_is_proved(radius: float, stable: bool, makes: tuple[type, ...], unit: float) -> None:
    case = in_units(scalar(radius), np.array([unit]))
    assert Prover(*case, makes=makes).stable.holds is stable


def test_on_the_border_nothing_is_said() -> None:
    """An integrator that nobody corrects: its error neither dies out nor grows."""
    assert Prover(*scalar(1.0)).stable.holds is None
    assert "not known" in analyse(scalar(1.0)[0], GivenGains(*scalar(1.0)[1:], "by hand", None)).text()


def test_a_transient_is_not_growth() -> None:
    """Twelve nodes in a line, each of which hands on more than it got: E|error|^2 grows a millionfold, and dies out."""
    problem, K, H = chain([0.5] + 12 * [-0.7])
    model = error_model(problem, *stacked_links(problem, K, H))
    gain = exact_gain(model)
    assert gain.stable
    assert gain.radius == pytest.approx(0.49, rel=1e-6)
    assert Prover(problem, K, H).stable.holds is True


@pytest.mark.parametrize(
    ("nodes", "own", "onwards", "H", "stable"),
    [
        (70, 0.0, 1.4, 0.0, True),
        (30, 0.95, 1.5, 0.05, True),
        (60, 0.5, -2.5, 0.1, True),
        (20, 1.001, 1.5, 0.0, False),
        (12, 1.01, 3.0, 0.0, False),
    ],
)
def test_a_line_that_hands_on_more_than_it_gets_is_decided(
    nodes: int, own: float, onwards: float, H: float, stable: bool
) -> None:
    """The square of its transient is beyond the digits of a float; in other units there is none."""
    problem, K, gains_H = chain([0.5] + (nodes - 1) * [own])
    names = problem.node_names
    for before, name in pairwise(names):
        K["t"][name][before] = np.array([[onwards]])
        gains_H["t"][name][name] = np.array([[H]])
    problem = Problem.from_document(problem.document() | {"unbiased": False})
    assert Prover(problem, K, gains_H).stable.holds is stable


def test_balanced_units_leave_no_weight_that_is_handed_on() -> None:
    """Nor do they change what moves itself alone; a circle keeps its mean."""
    line, circle = chain([0.5] + 9 * [0.3]), np.array([[0.0, 4.0], [1.0, 0.0]])
    for name, before in zip(line[0].node_names[1:], line[0].node_names, strict=False):
        line[1]["t"][name][before] = np.array([[40.0]])
    line = Problem.from_document(line[0].document() | {"unbiased": False}), *line[1:]
    operator = operator_of(line)
    units = module.balance(operator.corner, 1, 11)
    unit = np.zeros((1, 11, 11))
    unit[0, 10, 10] = units[10] ** 2
    handed = operator.corner(unit)[0].diagonal() / units**2
    assert handed[10] == pytest.approx(0.09)
    assert handed[9] < 0.1
    found = module.balance(lambda Y: circle.T @ Y @ circle, 1, 2)
    assert found[0] / found[1] in (1.0, 2.0, 0.5)
    assert np.array_equal(module.balance(lambda Y: 0.25 * Y, 1, 3), np.ones(3))


@pytest.mark.parametrize("own", [0.0, 0.9])
def test_nor_is_a_long_one(own: float) -> None:
    """In a line of 64 nodes rounding alone makes eigenvalues above 1 of the whole, and so do 300 steps if own = 0.9."""
    problem, K, H = chain([0.5] + 63 * [own - 1.2])
    for i, name in enumerate(problem.node_names[1:], 1):
        K["t"][name] = {problem.node_names[i - 1]: np.array([[1.2]]), name: np.array([[own]])}
    problem = Problem.from_document(problem.document() | {"unbiased": False})
    model = error_model(problem, *stacked_links(problem, K, H))
    operator = Operator(model)
    radius = decay(operator.corner, 1, operator.units, model.moves).radius
    assert radius == pytest.approx(max(0.25, own**2), rel=1e-6)


def test_a_rate_that_is_proved_wrong_is_not_told(monkeypatch: pytest.MonkeyPatch) -> None:
    for radius, says in ((0.9, 1.1), (1.1, 0.9)):
        monkeypatch.setattr(module, "spectral_radius", lambda *given, says=says: Rate(says))
        problem, K, H = scalar(radius)
        H["t"]["n0"]["n0"][:] = 1e-6  # so that losses have a say
        analysis = analyse(problem, GivenGains(K, H, "by hand", None))
        assert "how fast in the long run, floats do not tell" in analysis.text()
        assert analysis.document()["radius"] is None


def test_near_the_border_no_sentence_of_an_analysis_contradicts_another(monkeypatch: pytest.MonkeyPatch) -> None:
    """The rate is told by what it is below 1, and the worst policy by what it attains in the steps looked at."""
    monkeypatch.setattr("designer.analysis._MOST_OF_POLICY", (20, 4e6))
    analysis = analyse(scalar(1.0 - 1e-5)[0], GivenGains(*scalar(1.0 - 1e-5)[1:], "by hand", None))
    said = analysis.text()
    assert "in the long run each step multiplies E|error|^2 by 1 - 2e-05" in said
    assert analysis.policy_gain is not None
    assert analysis.ladder.exact is not None
    assert analysis.policy_gain < 0.1 * analysis.ladder.exact[0]
    assert f"its gain is {analysis.policy_gain:.6g}, and it takes more steps" in said
    fast = analyse(scalar(0.9)[0], GivenGains(*scalar(0.9)[1:], "by hand", None))
    assert "takes more steps" not in fast.text()


def operator_of(case: Case) -> Operator:
    problem, K, H = case
    return Operator(error_model(problem, *stacked_links(problem, K, H)))


@pytest.mark.parametrize("large", [False, True])
def test_the_radius_is_that_of_the_eigenvalues(large: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """By Arnoldi's method too, and in whatever units."""
    if large:
        monkeypatch.setattr(module, "_FEW", 0)
    case = chain([0.9, 0.3, -0.5, 0.7, 0.2])
    operator = operator_of(case)
    expected = float(np.abs(np.linalg.eigvals(module._matrix(operator.corner, 1, 5))).max())
    assert spectral_radius(operator.corner, 1, 5).radius == pytest.approx(expected, rel=1e-9)
    assert expected == pytest.approx(0.81, rel=1e-9)


def test_without_scipy_it_is_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    operator = operator_of(chain([0.9, 0.3, -0.5, 0.7, 0.2]))
    monkeypatch.setattr(module, "_FEW", 0)
    found = []
    for has_scipy in (True, False):
        monkeypatch.setattr(module, "find_spec", {"scipy": has_scipy}.get)
        found.append(spectral_radius(operator.corner, 1, 5))
    assert found[1] == pytest.approx(found[0], rel=1e-6, abs=1e-9)


@pytest.mark.parametrize(("seed", "tight_up_to", "digits"), [(0, module._TIGHT_UP_TO, 9), (0, 0, 4), (5, 0, 2)])
def test_as_many_digits_are_known_as_are_said(
    seed: int, tight_up_to: int, digits: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Y to A'YA has 2485 unknowns, and the square of what A has; where it grows first, that is told least well."""
    monkeypatch.setattr(module, "_TIGHT_UP_TO", tight_up_to)
    A = np.random.default_rng(seed).normal(size=(70, 70))
    A *= 0.95 / np.abs(np.linalg.eigvals(A)).max()
    rate = spectral_radius(lambda Y: A.T @ Y @ A, 1, 70)
    assert rate.digits == digits
    assert abs(rate.radius - 0.95**2) < 0.5 * 10.0**-digits


@pytest.mark.parametrize(("digits", "says"), [(9, "by 0.823457"), (4, "by about 0.8235")])
def test_no_more_digits_are_printed_than_are_known(digits: int, says: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "spectral_radius", lambda *given: Rate(0.823456789, digits))
    problem, K, H = chain([0.9, 0.3])
    next(iter(H.values()))["n0"]["n0"][0, 0] = 0.1  # chance has a say
    told = analyse(problem, GivenGains(K, H, "by hand", None)).text()
    assert f"multiplies E|error|^2 {says}\n" in told


def test_the_radius_of_a_large_network_is_known_to_four_digits(monkeypatch: pytest.MonkeyPatch) -> None:
    operator = operator_of(chain([0.9, 0.3, -0.5, 0.7, 0.2]))
    monkeypatch.setattr(module, "_FEW", 0)
    monkeypatch.setattr(module, "DENSE", 0)
    assert spectral_radius(operator.corner, 1, 5).radius == pytest.approx(0.81, rel=1e-3)


@pytest.mark.parametrize("radius", [0.9, 0.9999, 1.001])
def test_large_networks_are_solved_without_a_matrix(radius: float, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "DENSE", 0)
    monkeypatch.setattr(module, "_TERMS", 5)
    operator = operator_of(chain([radius, 0.3, -0.5, 0.7]))
    found = decay(operator.corner, 1, np.ones(4))
    assert found.total is not None
    assert found.rest is not None
    assert np.allclose(found.rest, found.total - operator.corner(found.total))
    assert np.linalg.eigvalsh(found.rest).min() > 0.0
    assert found.dies_out is (radius < 1.0)


# mutants of what is proved
@pytest.mark.parametrize("make", [ByFloats, lambda *case: ByBalls(*case, bits=128)], ids=["floats", "balls"])
def test_no_other_Z_proves_anything(make: type) -> None:
    """The Z of stable errors with its sign changed, that of unstable ones raised to a positive one."""
    by = make(*scalar(0.99))
    Z = ByFloats(*scalar(0.99)).model.decay.total
    assert Z is not None
    assert all(sign.proved for sign in by.decreasing(Z))
    assert all(sign.refuted for sign in by.decreasing(-Z))
    by = make(*scalar(1.01))
    Z = ByFloats(*scalar(1.01)).model.decay.total
    assert Z is not None
    assert all(sign.proved for sign in by.decreasing(Z))
    assert all(sign.refuted for sign in by.positive(Z))
    assert all(sign.refuted for sign in by.decreasing(np.abs(Z)))


def test_a_wrong_sum_makes_nothing_stable(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whoever finds Z is not believed: what is found for other errors proves nothing of these."""
    right = ByFloats(*scalar(0.99)).model.decay
    monkeypatch.setattr("designer.proof.float_model.decay", lambda *given: right)
    assert Prover(*scalar(1.01)).stable.holds is None
