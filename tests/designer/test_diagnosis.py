"""Problems that explain why they have no solution, or are close to having none: one made problem for each sentence."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from networks import random_problem, real_network

from agent.contract.errors import InputError, Unattainable
from agent.contract.problem import Problem
from designer.cli import main
from designer.diagnosis import closed_classes, explained, obstacles, refuse_nothing_to_estimate, warnings
from designer.problems import find
from designer.problems.notes import notes
from designer.proof.hidden import grows_unseen, volume_grows
from designer.synthesis import design


def network(
    *,
    A: list[list[float]] | None = None,
    sees: dict[str, list[float]] | None = None,
    beta: dict[str, float] | None = None,
    hears: list[dict[str, list[str]]] | None = None,
    transition: list[list[float]] | None = None,
    links: dict[tuple[str, str], float] | None = None,
) -> Problem:
    """A = 1.2, nodes "1" (which measures x) and "2" (which measures nothing), modes "a", "b", ...; 2 hears 1."""
    A, sees = A or [[1.2]], sees or {"1": [1.0], "2": [0.0]}
    hears = hears or [{"2": ["1"]}]
    modes, nx = [chr(ord("a") + s) for s in range(len(hears))], len(A)
    document: dict[str, Any] = {
        "name": "made",
        "unbiased": True,
        "plant": {"A": A, "B": np.eye(nx, nx + 1).tolist(), "M": np.eye(nx).tolist()},
        "node": [
            {
                "name": name,
                "C": [C],
                "D": [[0.0] * nx + [1.0]],
                "arrival_probability": (beta or {}).get(name, 1.0),
                "loss": "seen",
            }
            for name, C in sees.items()
        ],
        "topology": [{"name": mode, "hears": heard} for mode, heard in zip(modes, hears, strict=True)],
        "markov": {"transition": transition or [[1.0]], "initial": "a"},
    }
    if links:
        document["link"] = [
            {"receiver": receiver, "sender": sender, "delivery_probability": rho}
            for (receiver, sender), rho in links.items()
        ]
    return Problem.from_document(document)


def refusal(problem: Problem, method: str = "decomposed") -> str:
    with pytest.raises(Unattainable) as caught:
        design(problem, method=method)
    return str(caught.value)


# obstacles
def test_a_sound_network_has_no_obstacle_and_a_design() -> None:
    """So that the refusals below mean something."""
    problem = network()
    assert obstacles(problem) == []
    assert design(problem, method="decomposed").certificate.holds


@pytest.mark.parametrize("method", ["decomposed", "exact"])
def test_a_node_that_hears_nobody_who_sees_is_blind(method: str) -> None:
    """Refused before anything is solved, whatever the method."""
    assert refusal(network(hears=[{"1": ["2"]}]), method) == (
        'made has no solution: node "2" is blind for ever: neither it nor anyone it hears, directly or through others, '
        'measures all of the unstable part of the plant (eigenvalue 1.2); let it hear "1"'
    )


def test_what_is_heard_through_others_is_enough() -> None:
    """3 hears 2 in one mode, 2 hears 1 in another, and both come again and again."""
    sees = {"1": [1.0], "2": [0.0], "3": [0.0]}
    both = [[0.5, 0.5], [0.5, 0.5]]
    assert obstacles(network(sees=sees, hears=[{"3": ["2"]}, {"2": ["1"]}], transition=both)) == []
    found = obstacles(network(sees=sees, hears=[{"3": ["2"]}, {"2": ["1"]}], transition=[[1.0, 0.0], [0.5, 0.5]]))
    assert len(found) == 2
    assert 'node "2" is blind for ever: in mode "a", never left once entered, neither' in found[0]
    assert 'node "3" is blind for ever' in found[1]


def test_an_absorbing_class_of_modes_is_named() -> None:
    """Two modes that lead to each other and nowhere else, in neither of which 2 hears 1."""
    transition = [[0.8, 0.2, 0.0], [0.0, 0.5, 0.5], [0.0, 0.5, 0.5]]
    problem = network(hears=[{"2": ["1"]}, {}, {}], transition=transition)
    assert closed_classes(problem) == [[1, 2]]
    assert 'in modes "b" and "c", never left once entered, neither it' in obstacles(problem)[0]


def test_what_nobody_measures_is_said() -> None:
    """No topology helps there."""
    problem = network(A=[[1.2, 0.0], [0.0, 1.1]], sees={"1": [1.0, 0.0], "2": [1.0, 0.0]})
    assert obstacles(problem) == [
        "no node measures the unstable part of the plant (eigenvalue 1.1); some C must see it"
    ]


def test_a_stable_part_needs_no_sensor_and_a_marginal_one_does() -> None:
    """|lambda| = 1 does not die out by itself."""
    sees = {"1": [1.0, 0.0], "2": [0.0, 0.0]}
    assert obstacles(network(A=[[1.2, 0.0], [0.0, 0.99]], sees=sees)) == []
    assert "(eigenvalue 1)" in obstacles(network(A=[[1.2, 0.0], [0.0, 1.0]], sees=sees))[0]


def test_a_complex_pair_is_counted_once() -> None:
    """A rotation that grows: no node measures it, said once, with its size."""
    problem = network(A=[[0.0, 1.1], [-1.1, 0.0]], sees={"1": [0.0, 0.0]}, hears=[{}])
    assert [text.count("of size 1.1") for text in obstacles(problem)] == [1]
    assert obstacles(network(A=[[0.0, 1.1], [-1.1, 0.0]], sees={"1": [1.0, 0.0]}, hears=[{}])) == []


def test_losses_of_the_only_sensor_have_a_least_arrival_probability() -> None:
    """(1 - beta) 1.2^2 < 1: refused below 1 - 1/1.44 = 0.305556, designed above."""
    assert refusal(network(beta={"1": 0.3})) == (
        'made has no solution: node "1" alone sees the unstable part of the plant (eigenvalue 1.2), and its '
        "measurements arrive with probability 0.3: the mean squared error is multiplied by at least 0.7 x 1.44 = 1.008 "
        "in each step, and must shrink; arrival_probability must be above 0.305556"
    )
    assert design(network(beta={"1": 0.4}), method="decomposed").certificate.holds


def test_losses_of_all_sensors_together_are_counted() -> None:
    """Two that lose half each, against 2.1^2: 0.25 x 4.41 > 1."""
    problem = network(
        A=[[2.1]], sees={"1": [1.0], "2": [1.0]}, beta={"1": 0.5, "2": 0.5}, hears=[{"1": ["2"], "2": ["1"]}]
    )
    assert obstacles(problem) == [
        'the measurements of nodes "1" and "2", which alone see the unstable part of the plant (eigenvalue 2.1), are '
        "all lost together with probability 0.25: the mean squared error is multiplied by at least 0.25 x 4.41 = "
        "1.1025 in each step, and must shrink; raise their arrival_probability"
    ]


def test_links_have_a_least_delivery_probability_too() -> None:
    """Node 2 sees nothing and hears node 1 by a link: refused below 0.305556, designed above."""
    assert obstacles(network(links={("2", "1"): 0.3})) == [
        'all messages to node "2" (from "1") are lost together with probability 0.7: against the unstable part of the '
        "plant (eigenvalue 1.2), the mean squared error is multiplied by at least 0.7 x 1.44 = 1.008 in each step, and "
        "must shrink; raise their delivery_probability"
    ]
    assert design(network(links={("2", "1"): 0.4}), method="decomposed").certificate.holds


@pytest.mark.parametrize("seed", range(3))
def test_obstacles_are_found_only_where_there_is_no_design(seed: int) -> None:
    """Random unstable networks: none that can be designed is refused; and stable ones never are."""
    problem = real_network(random_problem(seed), seen=True, unbiased=True, radius=1.2, delivery=0.8)
    assert design(problem, method="decomposed").certificate.holds
    assert obstacles(random_problem(seed)) == []


# relaxing
DWELLS = [[0.95, 0.05], [0.5, 0.5]]


def test_the_mode_and_the_topology_that_are_in_the_way_are_found() -> None:
    """Node 2 hears node 1 in mode b only, and the chain stays in a too long; nobody is blind for ever."""
    problem = network(hears=[{}, {"2": ["1"]}], transition=DWELLS)
    assert obstacles(problem) == []
    text = refusal(problem)
    assert "if every node heard every other in every mode it would have a solution" in text
    assert text.endswith('mode "a" alone has no solution')


def test_the_node_that_loses_too_much_is_found() -> None:
    """In the mode that lasts, node 1 has only its own sensor, which loses 9 of 10."""
    problem = network(
        sees={"1": [1.0], "2": [1.0]}, beta={"1": 0.1, "2": 0.95}, hears=[{}, {"1": ["2"]}], transition=DWELLS
    )
    text = refusal(problem)
    assert 'with arrival_probability 1 at node "1" it would have a solution' in text
    assert 'at node "2"' not in text


def test_the_link_that_loses_too_much_is_found() -> None:
    """In the mode that lasts, the blind node 3 hears node 1 by a link that loses 9 of 10; in the other node 2."""
    problem = network(
        sees={"1": [1.0], "2": [1.0], "3": [0.0]},
        hears=[{"3": ["1"]}, {"3": ["2"]}],
        transition=DWELLS,
        links={("3", "1"): 0.1},
    )
    assert 'with delivery_probability 1 from "1" to "3" it would have a solution' in refusal(problem)


def test_losses_that_only_help_together_are_found() -> None:
    """Neither alone is enough: the first relaxation of all nodes, or of all links, or of both, that helps is said."""
    problem = network(
        sees={"1": [1.0], "2": [1.0]}, beta={"1": 0.5, "2": 0.5}, links={("2", "1"): 0.9}, hears=[{"2": ["1"]}]
    )

    def solvable(relaxed: Problem) -> bool:
        return bool((relaxed.beta == 1.0).all() and (relaxed.delivery == 1.0).all())

    text = str(explained(problem, Unattainable("why"), solvable))
    assert text == "why; with no measurement and no message lost it would have a solution"
    text = str(explained(problem, Unattainable("why"), lambda relaxed: bool((relaxed.beta == 1.0).all())))
    assert text == "why; with arrival_probability 1 at every node it would have a solution"
    text = str(explained(problem, Unattainable("why"), lambda relaxed: bool((relaxed.delivery == 1.0).all())))
    assert text == 'why; with delivery_probability 1 from "1" to "2" it would have a solution'
    assert str(explained(problem, Unattainable("why"), lambda relaxed: False)).endswith(
        "no single relaxation of the problem helps"
    )


def test_a_stable_plant_is_said_to_have_a_solution() -> None:
    """Then it is arithmetic, and the numbers that make it hard are listed."""
    problem = changed(find("two-nodes"), lambda document: document["plant"].update(M=[[1e7]]))
    text = str(explained(problem, Unattainable("why"), lambda relaxed: False))
    assert text.startswith(
        "why; a solution exists, since the plant is stable: to ignore all measurements is one; the l"
    )


# warnings
def changed(problem: Problem, change: Any) -> Problem:
    document = problem.document()
    change(document)
    return Problem.from_document(document)


def test_the_examples_have_nothing_to_warn_of() -> None:
    """Nor has a noise-free sensor, or one noise in two sensors: D_i D_i' may be singular."""
    for name in ("zhu2020-ideal", "zhu2020-lossy", "quadruple-tank"):
        assert warnings(find(name)) == []
    assert warnings(network(links={("2", "1"): 0.5})) == []


def test_a_mode_that_is_never_reached_is_named() -> None:
    """The gains for it are designed all the same."""
    problem = network(hears=[{"2": ["1"]}, {"2": ["1"]}], transition=[[1.0, 0.0], [0.5, 0.5]])
    assert warnings(problem) == [
        'markov: mode "b" can never be reached from the initial mode "a"; gains are designed for all modes, since '
        "gamma holds from any"
    ]
    assert set(design(problem, method="decomposed").K) == {"a", "b"}


def test_a_plant_that_is_nearly_unstable_is_said_so() -> None:
    """With its spectral radius; not where the errors do not contain the state."""
    problem = real_network(random_problem(1), radius=0.9995)
    assert "its spectral radius is 0.9995, above 0.999" in warnings(problem)[0]
    assert warnings(real_network(random_problem(1), radius=0.9995, unbiased=True, seen=True)) == []


def test_scales_that_differ_are_said() -> None:
    """The smallest and the largest matrix, with their numbers."""

    def change(document: dict[str, Any]) -> None:
        document["plant"]["B"], document["node"][1]["C"] = [[1e-5, 0.0]], [[20.0]]

    problem = changed(network(), change)
    assert warnings(problem) == [
        'the largest number in B is 1e-05, and in C of node "2" 20: they differ by more than 1e+06; is every unit '
        "what it should be?"
    ]


def test_rare_arrivals_and_transitions_are_said() -> None:
    """Each with its number."""
    problem = network(
        sees={"1": [1.0], "2": [1.0]},
        beta={"2": 0.01},
        hears=[{"2": ["1"]}, {}],
        transition=[[1.0 - 1e-7, 1e-7], [0.5, 0.5]],
        links={("2", "1"): 0.02},
    )
    assert warnings(problem) == [
        'node "2": arrival_probability 0.01 is below 0.05; its measurements hardly count',
        'link from "1" to "2": delivery_probability 0.02 is below 0.05; its messages hardly count',
        'markov: the probability 1e-07 of going from "a" to "b" is below 1e-06; gamma counts the mode as possible all '
        "the same",
    ]


PROBLEM = """
name = "made"
plant = { A = [[0.5]], B = [[1.0]], M = [[1.0]] }
node = [{ name = "1", C = [[1.0]], D = [[1.0]], arrival_probability = 0.01 }]
topology = [{ name = "a", adjacency = [[1]] }]
markov = { transition = [[1.0]], initial = "a" }
"""


def test_the_command_warns_on_stderr_and_in_json(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The design is made all the same."""
    path = tmp_path / "made.toml"
    path.write_text(PROBLEM)
    output = str(tmp_path / "made.gains.json")
    assert main(["design", str(path), "-o", output, "--method", "decomposed", "--json"]) == 0
    printed = capsys.readouterr()
    said = 'node "1": arrival_probability 0.01 is below 0.05; its measurements hardly count'
    assert f"warning: {said}" in printed.err
    assert json.loads(printed.out)["warnings"] == [said]


# notes
def test_a_column_of_w_that_is_several_things_is_noted() -> None:
    """The plant's and a noise, or the noise of two nodes; the node's own measurements may share one."""
    own = find("two-nodes").document()

    def noted(left: list[float], right: list[float], B: list[float]) -> list[str]:
        nodes = [node | {"D": [D]} for node, D in zip(own["node"], (left, right), strict=True)]
        return notes(Problem.from_document(own | {"node": nodes, "plant": own["plant"] | {"B": [B]}}))

    assert notes(find("two-nodes")) == notes(find("quadruple-tank")) == notes(find("inverted-pendulum")) == []
    assert noted([0.0, 1.0, 0.0], [0.0, 0.0, 0.0], [1.0, 0.0, 1.0]) == []
    (said,) = noted([0.0, 1.0, 0.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0])
    assert said.startswith('column 2 of w is the noise of nodes "left" and "right": gamma is for disturbances that ')
    (said,) = noted([0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 1.0])
    assert said.startswith('column 3 of w moves the plant and is the noise of node "left": ')
    (said,) = noted([0.0, 1.0, 1.0], [0.0, 1.0, 1.0], [1.0, 0.0, 1.0])
    assert "(and 1 more column of the kind)" in said


def test_the_command_notes_it_of_problems_that_are_the_users(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """On stderr, and in --json; of the paper's own examples in --json and by show alone."""
    path, output = tmp_path / "made.toml", str(tmp_path / "made.gains.json")
    path.write_text(PROBLEM)
    note = notes(Problem.load(path))[0]
    assert main(["design", str(path), "-o", output, "--method", "decomposed", "--json"]) == 0
    printed = capsys.readouterr()
    assert (printed.err.count(note), json.loads(printed.out)["notes"]) == (1, [note])
    assert main(["analyse", str(path), "--gains", output, "--json"]) == 0
    printed = capsys.readouterr()
    assert (printed.err.count(note), json.loads(printed.out)["notes"]) == (1, [note])
    assert main(["show", str(path)]) == 0
    assert note in capsys.readouterr().out

    built_in = notes(find("zhu2020-lossy"))
    assert main(["design", "zhu2020-lossy", "-o", output, "--force", "--method", "decomposed", "--json"]) == 0
    printed = capsys.readouterr()
    assert ("column 1 of w" in printed.err, json.loads(printed.out)["notes"]) == (False, built_in)
    assert main(["show", "zhu2020-lossy", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["notes"] == built_in


def pendulum(rate: float, C: list[list[float]], **changes: object) -> Problem:
    """An inverted pendulum whose angle is measured, its rate in units of 1 / `rate` rad/s."""
    document = {
        "name": "pendulum",
        "unbiased": True,
        "plant": {"A": [[1.0, 0.02 / rate], [0.2 * rate, 1.0]], "B": [[0.0], [0.1 * rate]], "M": [[1.0, 0.0]]},
        "node": [{"name": "a", "C": C, "D": [[0.05]], "arrival_probability": 0.9, "loss": "seen"}],
        "topology": [{"name": "t", "hears": {}}],
        "markov": {"transition": [[1.0]], "initial": "t"},
    }
    return Problem.from_document(document | changes)


@pytest.mark.parametrize("rate", [1.0, 1e5, 1e-6, 2.0**30])
def test_units_make_nobody_blind(rate: float) -> None:
    assert obstacles(pendulum(rate, [[1.0, 0.0]])) == []
    sees_nothing = obstacles(pendulum(rate, [[0.0, 0.0]]))
    assert len(sees_nothing) == 1
    assert not sees_nothing[0].endswith("computed, not proved")


def test_a_sensor_that_shows_what_grows_a_little_is_no_obstacle() -> None:
    """Floats take an entry of 1e-12 for nothing; exact arithmetic does not."""
    plant = {"A": [[1.2, 0.0], [0.0, 0.5]], "B": [[1.0], [1.0]], "M": [[1.0, 1.0]]}
    assert obstacles(pendulum(1.0, [[1e-12, 1.0]], plant=plant)) == []
    assert len(obstacles(pendulum(1.0, [[0.0, 1.0]], plant=plant))) == 1


def test_what_is_hidden_but_for_rounding_is_named_where_no_gains_are_found() -> None:
    """In decimals v = [1, 1] is hidden; as floats stand, it is not, by 1e-17, and no other reason is to be had."""
    plant = {"A": [[1.3, 0.1], [0.2, 1.2]], "B": [[1.0], [0.3]], "M": [[1.0, 0.0]]}
    problem = pendulum(1.0, [[1.0, -1.0]], plant=plant)
    assert obstacles(problem) == []
    said = str(explained(problem, Unattainable("no gains"), lambda relaxed: True))
    assert said == (
        "no gains; no node measures the unstable part of the plant (eigenvalue 1.4); some C must see it, as far as "
        "floats tell; by exact numbers it is not so, if only just"
    )


@pytest.mark.parametrize(
    ("A", "C", "lost", "grows"),
    [
        ([[1.2, 0.0], [0.0, 0.5]], [[0.0, 1.0]], [], True),
        ([[1.2, 0.0], [0.0, 0.5]], [[1.0, 0.0]], [0.0], False),
        ([[1.2, 0.0], [0.0, 0.5]], [[0.0, 1.0]], [0.31], False),  # 1.44 x 0.69 < 1
        ([[1.2, 0.0], [0.0, 0.5]], [[0.0, 1.0]], [0.3], True),
        ([[1.2, 0.0], [0.0, 0.5]], [[1e-300, 1.0]], [], False),
        ([[1.0, 1.0], [0.0, 1.0]], [[0.0, 0.0]], [0.0], True),  # a double integrator, on the border
        ([[0.0, 1.0], [-1.0, 0.0]], [[0.0, 0.0]], [0.0], True),  # and a rotation
        ([[0.0, 1.5], [-1.5, 0.0]], [[0.0, 0.0]], [0.0], True),
        ([[1.2, 0.0], [0.0, 0.5]], [], [0.5], False),
        ([[2.0, 0.0], [0.0, 0.5]], [], [0.42, 0.4, 0.03, 0.25939092309515355], False),  # 0.25, if rounded
    ],
)
def test_what_grows_unseen_is_decided_exactly(
    A: list[list[float]], C: list[list[float]], lost: list[float], grows: bool
) -> None:
    assert grows_unseen(np.array(A), np.array(C).reshape(-1, 2), lost) is grows


# what one node needs that hears nobody
CRITICAL = {
    "scalar": ([[1.25]], [1.0], 0.36),
    "two growing states, one measurement": ([[1.25, 0.0], [1.0, 1.1]], [1.0, 1.0], 1.0 - 1.0 / (1.25 * 1.1) ** 2),
    "one growing state of three": ([[1.25, 1.0, 0.0], [0.0, 0.9, 7.0], [0.0, 0.0, 0.6]], [1.0, 0.0, 2.0], 0.36),
}


@pytest.mark.parametrize("case", CRITICAL)
def test_the_critical_arrival_probability_of_intermittent_observations(case: str) -> None:
    """Known from the literature: 1 - 1/prod |lambda|^2, here 0.36, 0.4711 and 0.36. Just above, gains are certified."""
    A, C, critical = CRITICAL[case]
    alone = {"A": A, "sees": {"1": C}, "hears": [{}]}
    below, above = (network(**alone, beta={"1": critical + off}) for off in (-0.001, 0.02))
    with pytest.raises(Unattainable, match=f"has no solution: .* must be above {critical:.6g}$"):
        design(below)
    assert obstacles(network(**alone, beta={"1": critical + 0.0001})) == []
    assert design(above, method="least-variance").certificate.holds


def test_that_no_constant_gain_exists_is_said() -> None:
    """Where no eigenvalue alone is in the way, but all together are; another node that listens helps nobody."""
    A, C, critical = CRITICAL["two growing states, one measurement"]
    sees = {"1": C, "2": [0.0, 0.0]}
    (found,) = obstacles(network(A=A, sees=sees, hears=[{"2": ["1"]}], beta={"1": 0.46}))
    assert found == (
        'no constant gain exists: node "1" hears nobody in mode "a", the unstable eigenvalues of A multiply to 1.375, '
        f"and (1 - 0.46) x 1.375^2 = 1.02094 has to be below 1; arrival_probability must be above {critical:.6g}"
    )
    heard = network(A=A, sees={"1": C, "2": C}, hears=[{"1": ["2"], "2": ["1"]}], beta={"1": 0.46, "2": 0.46})
    assert obstacles(heard) == []


def test_a_stable_plant_has_a_solution_however_rarely_measurements_arrive() -> None:
    assert obstacles(network(A=[[0.9, 0.0], [0.0, 0.5]], sees={"1": [1.0, 0.0]}, hears=[{}], beta={"1": 1e-300})) == []


@pytest.mark.parametrize(
    ("change", "where"),
    [
        ({"plant": {"B": [[1e101, 0.0]]}}, "plant: B holds a number of size 1e+101"),
        ({"plant": {"M": [[5e-324]]}}, "plant: M holds a number of size 4.94e-324"),
        ({"node": {"*": {"D": [[0.0, -1e200]]}}}, 'node "1": D holds a number of size 1e+200'),
    ],
)
def test_numbers_whose_squares_are_none_are_refused(change: dict[str, Any], where: str) -> None:
    problem = network().with_(**change)
    for refuses in (lambda: design(problem), lambda: refuse_nothing_to_estimate(problem)):
        with pytest.raises(InputError, match=f"^{re.escape(where)}; designs take sizes from 1e-100 to 1e"):
            refuses()


def test_whether_a_volume_grows_is_decided_by_balls() -> None:
    A = np.array([[1.25, 0.0], [1.0, 1.1]])
    critical = 1.0 - 1.0 / 1.375**2
    assert volume_grows(A, critical - 1e-15, 1) is True
    assert volume_grows(A, critical + 1e-15, 1) is False
    assert volume_grows(A, critical - 1e-15, 2) is False
    assert volume_grows(np.array([[2.0]]), 0.75, 1) is True
    assert volume_grows(np.array([[0.0, 1.25], [-1.25, 0.0]]), 0.59, 1) is True  # 0.59 < 1 - 1 / 1.25^4 = 0.5904
    assert volume_grows(np.array([[0.0, 1.25], [-1.25, 0.0]]), 0.591, 1) is False


def test_a_continuous_time_matrix_is_noted() -> None:
    """And no other: one eigenvalue that is not negative is enough."""
    document = random_problem(4).document()
    document["plant"]["A"] = [[-0.01, -0.992], [0.0, -0.75]]
    (found,) = [text for text in notes(Problem.from_document(document)) if "continuous" in text]
    assert found.startswith("every eigenvalue of A has a negative real part, as of a continuous-time model; A must be")
    document["plant"]["A"] = [[0.01, -0.992], [0.0, -0.75]]
    assert not any("continuous" in text for text in notes(Problem.from_document(document)))


@pytest.mark.parametrize(
    ("A", "said"),
    [
        ([[0.0, 1.0], [0.0, -0.5]], "no eigenvalue of A has a positive real part"),  # a mass with friction
        ([[0.0, 0.7], [-0.7, 0.0]], "no eigenvalue of A has a positive real part"),  # an oscillator
        ([[0.0, 1.0], [9.81, -0.1]], "the real part -3.182 of an eigenvalue of A is below -1"),  # an inverted pendulum
        ([[0.0, 1.0], [0.0, 0.0]], None),  # two steps of delay
        ([[0.0, 0.0], [0.0, 0.0]], None),
        ([[1.1, 1.0], [0.0, 0.9]], None),
        ([[-0.9, 0.0], [0.0, 0.9]], None),
    ],
)
def test_integrators_and_what_falls_over_are_noted_and_delays_are_not(A: list[list[float]], said: str | None) -> None:
    seen = [{**node, "loss": "seen"} for node in random_problem(4).document()["node"]]
    document = random_problem(4).document() | {"unbiased": True, "node": seen}
    document["plant"]["A"] = A
    found = [text for text in notes(Problem.from_document(document)) if "continuous" in text]
    assert [text.split(", as of")[0] for text in found] == ([] if said is None else [said])
