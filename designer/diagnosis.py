"""Why a problem has no solution, and what in it is close to having none; in sentences that name the part.

A stable plant always has a solution: the network that ignores everything (designer.lmi.inwards). Only an unstable
plant, which is admissible where gains are unbiased and every loss is seen, has obstacles. Let A v = lambda v, |lambda|
>= 1, and let a set S of nodes be such that, in one step of any mode, with probability q at least, no message from
outside S reaches S and no measurement of S with C_j v != 0 arrives. Start every node of S with the error v. As long as
that goes on, the innovations of S are 0, the differences between its estimates are 0, and every error is lambda^k v.
So E|e_i(k)|^2 >= (q |lambda|^2)^k |v|^2, whatever the gains: q |lambda|^2 < 1 is necessary for mean-square stability.
q = 1 is a node that is blind for ever. It has to hold in every class of modes that is never left, since gamma is for
any initial mode. A node that hears nobody needs more: the volume that its errors fill has to shrink. That it does not
hold is proved here without a solver; where it holds, and no design was found all the same, parts of the problem are
relaxed in turn to see which of them is in the way. docs/theory.md, section 10.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agent.contract.arrays import Array
from agent.contract.errors import InputError, Unattainable, listed
from agent.contract.problem import Problem
from designer.model.units import natural_units
from designer.proof.hidden import grows_unseen, volume_grows

_NEARLY_UNSTABLE = 0.999
_RARELY = 0.05  # an arrival or delivery probability below this is worth a word
_NEVER_QUITE = 1e-6  # a transition probability below this, too
_SCALES = 1e6
_EXTREME = 1e100
_DEPENDENT = 1e-9  # relative to the sizes of A and C: below this, a singular value is 0
_ONE_BY_ONE = 100  # n nx modes up to which nodes and links are relaxed one by one
_COMPUTED = "; this is computed, not proved"
_HARDLY = ", as far as floats tell; by exact numbers it is not so, if only just"


def warnings(problem: Problem) -> list[str]:
    """What makes the design hard, or the result odd, though the problem is legal; each a sentence with its number."""
    return [*_warned_plant(problem), *_warned_chances(problem), *_warned_modes(problem)]


def refuse_nothing_to_estimate(problem: Problem) -> None:
    """InputError where z stays 0 whatever w is: M A^k B = 0 for every k; or where squares are no float64."""
    _refuse_extremes(problem)
    A, reached, M = problem.plant.A, problem.plant.B, problem.plant.M
    if not M.any():
        raise InputError("plant: M is zero, so there is nothing to estimate; give M a row that is not zero")
    for _ in range(problem.nx):
        if (M @ reached).any():
            return
        reached = A @ reached
    raise InputError(
        "plant: no disturbance ever reaches z (M A^k B is zero for every k), so there is nothing to estimate; "
        "give B or M entries that connect them"
    )


def _refuse_extremes(problem: Problem) -> None:
    """Entries of A may be as small as they like: what decays fast between two samples leaves hardly anything."""
    matrices = [(f"plant: {letter}", getattr(problem.plant, letter)) for letter in "ABM"]
    matrices += [(f'node "{node.name}": {letter}', getattr(node, letter)) for node in problem.nodes for letter in "CD"]
    for what, matrix in matrices:
        sizes = np.abs(matrix[matrix != 0.0])
        extreme = sizes[(sizes > _EXTREME) | ((sizes < 1.0 / _EXTREME) & (what != "plant: A"))]
        if len(extreme):
            raise InputError(
                f"{what} holds a number of size {extreme[0]:.3g}; designs take sizes from {1.0 / _EXTREME:g} to "
                f"{_EXTREME:g}, because they work with squares: choose other units"
            )


def refuse_hopeless(problem: Problem) -> None:
    """Unattainable, before anything is solved, where `obstacles` finds one."""
    found = obstacles(problem)
    proved = [sentence for sentence in found if not sentence.endswith(_COMPUTED)]
    found = [*proved, *(sentence for sentence in found if sentence not in proved)]
    if found:
        more = f" (and {len(found) - 1} more of the kind)" if len(found) > 1 else ""
        says = "has no solution" if proved else "has no solution, as far as floats tell"
        raise Unattainable(f"{problem.name} {says}: {found[0]}{more}")


def explained(problem: Problem, error: Unattainable, solvable: Callable[[Problem], bool]) -> Unattainable:
    """The error with what is known of its reason; `solvable` tries the design of a relaxed problem."""
    if not _growing(problem):
        known = "a solution exists, since the plant is stable: to ignore all measurements is one"
        return Unattainable("; ".join([str(error), known, *warnings(problem)]))
    found = [sentence for sentence in _suspected(problem) if sentence.endswith(_HARDLY)]
    found = found or [sentence for relaxed, sentence in _relaxed_one_by_one(problem) if solvable(relaxed)]
    if not found:
        found = [sentence for relaxed, sentence in _relaxed_together(problem) if solvable(relaxed)][:1]
    found += [sentence for mode, sentence in _mode_by_mode(problem) if not solvable(mode)]
    return Unattainable("; ".join([str(error), *(found or ["no single relaxation of the problem helps"])]))


# obstacles, by proof
def obstacles(problem: Problem) -> list[str]:
    """What rules out every mean-square stable network of filters of this form; empty for a stable plant.

    Floats find each, in natural units; what exact arithmetic proves false is left out, and what it does not prove says
    that it is computed.
    """
    return [sentence for sentence in _suspected(problem) if not sentence.endswith(_HARDLY)]


def _suspected(problem: Problem) -> list[str]:
    """The same, with what exact arithmetic proves false."""
    found: list[str] = []
    for eigenvalue, V in _growing(problem):
        sees = [bool(np.abs(C @ V).max() > _DEPENDENT * np.abs(C).max()) for C in _scaled(problem)[1]]
        for modes in closed_classes(problem):
            adjacency = np.any([problem.topologies[s].adjacency > 0.0 for s in modes], axis=0)
            upstream = _closure(adjacency)
            for i in range(problem.n):
                heard = np.flatnonzero(upstream[i])
                if _blind(problem, eigenvalue, heard):
                    text = _blind_text(problem, i, eigenvalue, modes, sees)
                    found += _as_proved(text, problem, [int(j) for j in heard])
                else:
                    found += _too_many_losses(problem, i, eigenvalue, sees, upstream[i], adjacency[i])
    found += _too_fast(problem) if all(sentence.endswith(_HARDLY) for sentence in found) else []
    return list(dict.fromkeys(found))


def _scaled(problem: Problem) -> tuple[Array, list[Array]]:
    """A and every C in natural units of the states."""
    units = natural_units(problem).state
    return problem.plant.A * units / units[:, None], [node.C * units for node in problem.nodes]


def _as_proved(text: str, problem: Problem, blind: list[int], lost: Sequence[float] = ()) -> list[str]:
    """The sentence that nothing shows what grows when nothing arrives of what arrives with probabilities `lost`.

    Nodes `blind` never show it.
    """
    C = np.vstack([problem.nodes[j].C for j in blind]) if blind else np.zeros((0, problem.nx))
    proved = grows_unseen(problem.plant.A, C, lost)
    return [text + {True: "", False: _HARDLY, None: _COMPUTED}[proved]]


def _growing(problem: Problem) -> list[tuple[complex, Array]]:
    """Eigenvalues with |lambda| >= 1, one of each conjugate pair, each with a basis of its eigenvectors (nx, k).

    In natural units.
    """
    A, _ = _scaled(problem)
    found: list[tuple[complex, Array]] = []
    for eigenvalue in np.linalg.eigvals(A):
        known = any(abs(eigenvalue - other) <= 1e-6 * abs(eigenvalue) for other, _ in found)
        if abs(eigenvalue) >= 1.0 and eigenvalue.imag >= 0.0 and not known:
            _, sizes, right = np.linalg.svd(A - eigenvalue * np.eye(len(A)))
            kernel = right[sizes <= max(1e-6 * np.abs(A).max(), sizes[-1])]
            found.append((complex(eigenvalue), kernel.conj().T))
    return found


def closed_classes(problem: Problem) -> list[list[int]]:
    """The classes of modes that the chain never leaves once it is in them, each of modes that lead to each other."""
    reaches = _closure(problem.markov.transition > 0.0)
    classes = [[int(t) for t in np.flatnonzero(row)] for row in reaches]
    return [modes for s, modes in enumerate(classes) if modes[0] == s and all(reaches[t, s] for t in modes)]


def _closure(related: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Reflexive and transitive: [i, j] is whether i leads to j in any number of steps."""
    reach = related | np.eye(len(related), dtype=bool)
    for _ in range(len(related).bit_length()):
        reach = reach @ reach
    return np.asarray(reach)


def _blind(problem: Problem, eigenvalue: complex, nodes: NDArray[np.int64]) -> bool:
    """Whether some v with A v = lambda v is in no measurement of these nodes (Popov, Belevitch, Hautus)."""
    A, C = _scaled(problem)
    rows = [A - eigenvalue * np.eye(len(A))]
    rows += [C[j] / (np.abs(C[j]).max() or 1.0) for j in nodes]
    sizes = np.linalg.svd(np.vstack(rows), compute_uv=False)
    return bool(sizes[-1] <= _DEPENDENT * max(float(np.abs(A).max()), 1.0))


def _blind_text(problem: Problem, i: int, eigenvalue: complex, modes: list[int], sees: list[bool]) -> str:
    unstable, name = _unstable(eigenvalue), problem.node_names[i]
    if _blind(problem, eigenvalue, np.arange(problem.n)):
        return f"no node measures the unstable part of the plant ({unstable}); some C must see it"
    where = ""
    if len(modes) < len(problem.mode_names):
        names = [problem.mode_names[s] for s in modes]
        where = f" in {'mode' if len(names) == 1 else 'modes'} {listed(names)}, never left once entered,"
    others = listed(name for name, seen in zip(problem.node_names, sees, strict=True) if seen)
    return (
        f'node "{name}" is blind for ever:{where} neither it nor anyone it hears, directly or through others, '
        f"measures all of the unstable part of the plant ({unstable}); let it hear {others}"
    )


def _too_many_losses(
    problem: Problem,
    i: int,
    eigenvalue: complex,
    sees: list[bool],
    upstream: NDArray[np.bool_],
    hears: NDArray[np.bool_],
) -> list[str]:
    """The condition for S = everybody upstream of node i, and for S = {i}."""
    factor, beta, unstable = abs(eigenvalue) ** 2, problem.beta, _unstable(eigenvalue)
    eyes = [j for j in range(problem.n) if upstream[j] and sees[j]]
    lost = float(np.prod([1.0 - beta[j] for j in eyes]))
    if lost * factor >= 1.0:
        blind = [j for j in range(problem.n) if upstream[j] and not sees[j]]
        names = listed(problem.node_names[j] for j in eyes)
        if len(eyes) == 1:
            text = (
                f"node {names} alone sees the unstable part of the plant ({unstable}), and its measurements arrive "
                f"with probability {beta[eyes[0]]:g}: {_growth(lost, factor)}; "
                f"arrival_probability must be above {1.0 - 1.0 / factor:.6g}"
            )
            return _as_proved(text, problem, blind, [beta[j] for j in eyes])
        text = (
            f"the measurements of nodes {names}, which alone see the unstable part of the plant ({unstable}), are all "
            f"lost together with probability {lost:.6g}: {_growth(lost, factor)}; raise their arrival_probability"
        )
        return _as_proved(text, problem, blind, [beta[j] for j in eyes])
    senders = [j for j in range(problem.n) if hears[j] and j != i]
    ways = [*(problem.delivery[i, j] for j in senders), *([beta[i]] if sees[i] else [])]
    cut = float(np.prod([1.0 - p for p in ways]))
    if senders and cut * factor >= 1.0:
        name = problem.node_names[i]
        own = ", as is its own measurement," if sees[i] else ""
        text = (
            f'all messages to node "{name}" (from {listed(problem.node_names[j] for j in senders)}) are lost together'
            f"{own} with probability {cut:.6g}: against the unstable part of the plant ({unstable}), "
            f"{_growth(cut, factor)}; raise their delivery_probability"
        )
        return _as_proved(text, problem, [] if sees[i] else [i], ways)
    return []


def _too_fast(problem: Problem) -> list[str]:
    """Nodes that hear nobody, in a mode that is never left: the volume that their errors fill has to shrink."""
    found: list[str] = []
    sizes = np.abs(np.linalg.eigvals(_scaled(problem)[0]))
    volume = float(np.prod(sizes[sizes > 1.0]))
    if volume == 1.0:  # nothing grows
        return []
    for modes in closed_classes(problem):
        for i, node in enumerate(problem.nodes if len(modes) == 1 else ()):
            rows, beta = len(node.C), node.arrival_probability
            grows = problem.neighbours(modes[0], i) == (i,) and (1.0 - beta) ** rows * volume**2 >= 1.0
            proved = volume_grows(problem.plant.A, beta, rows) if grows else False
            if proved is False:
                continue
            power = f"^{rows}" if rows > 1 else ""
            text = (
                f'no constant gain exists: node "{node.name}" hears nobody in mode "{problem.mode_names[modes[0]]}", '
                f"the unstable eigenvalues of A multiply to {volume:.6g}, and (1 - {beta:g}){power} x {volume:.6g}^2 = "
                f"{(1.0 - beta) ** rows * volume**2:.6g} has to be below 1; "
                f"arrival_probability must be above {1.0 - volume ** (-2.0 / rows):.6g}"
            )
            found.append(text if proved else text + _COMPUTED)
    return found


def _growth(chance: float, factor: float) -> str:
    return (
        f"the mean squared error is multiplied by at least {chance:.6g} x {factor:.6g} = {chance * factor:.6g} in each "
        "step, and must shrink"
    )


def _unstable(eigenvalue: complex) -> str:
    value = f"{eigenvalue.real:.6g}" if eigenvalue.imag == 0.0 else f"{eigenvalue:.6g}, of size {abs(eigenvalue):.6g}"
    return f"eigenvalue {value}"


# reasons, by relaxing
def _relaxed_one_by_one(problem: Problem) -> Iterator[tuple[Problem, str]]:
    """One node that loses nothing, or one link that loses nothing."""
    if problem.n * problem.nx * len(problem.mode_names) > _ONE_BY_ONE:
        return
    for i, node in enumerate(problem.nodes):
        if node.arrival_probability < 1.0:
            document = problem.document()
            document["node"][i]["arrival_probability"] = 1.0
            said = f'with arrival_probability 1 at node "{node.name}" it would have a solution'
            yield Problem.from_document(document), said
    for k, link in enumerate(problem.links or ()):
        if link.delivery_probability < 1.0:
            document = problem.document()
            document["link"][k]["delivery_probability"] = 1.0
            said = f'with delivery_probability 1 from "{link.sender}" to "{link.receiver}" it would have a solution'
            yield Problem.from_document(document), said


def _relaxed_together(problem: Problem) -> Iterator[tuple[Problem, str]]:
    """Nothing lost of one kind, nothing lost at all, everybody hearing everybody: from little to much."""
    arrive = [{**node, "arrival_probability": 1.0} for node in problem.document()["node"]]
    deliver = {key: value for key, value in problem.document().items() if key != "link"}
    all_hear = [{"name": name, "adjacency": np.ones((problem.n, problem.n)).tolist()} for name in problem.mode_names]
    plan: list[tuple[dict[str, Any], str]] = []
    if (problem.beta < 1.0).any():
        plan.append(({**problem.document(), "node": arrive}, "with arrival_probability 1 at every node"))
    if (problem.delivery < 1.0).any():
        plan.append((deliver, "with no message lost"))
    if len(plan) == 2:
        plan.append(({**deliver, "node": arrive}, "with no measurement and no message lost"))
    plan.append(({**problem.document(), "topology": all_hear}, "if every node heard every other in every mode"))
    for document, condition in plan:
        yield Problem.from_document(document), f"{condition} it would have a solution"


def _mode_by_mode(problem: Problem) -> Iterator[tuple[Problem, str]]:
    """Each mode as if it were the only one."""
    if len(problem.mode_names) == 1:
        return
    for s, name in enumerate(problem.mode_names):
        document = problem.document()
        document["topology"] = [document["topology"][s]]
        document["markov"] = {"transition": [[1.0]], "initial": name}
        heard = problem.topologies[s].adjacency > 0.0
        at = problem.node_index
        links = [link for link in document.pop("link", []) if heard[at(link["receiver"]), at(link["sender"])]]
        if links:
            document["link"] = links
        yield Problem.from_document(document), f'mode "{name}" alone has no solution'


# warnings
def _warned_plant(problem: Problem) -> Iterator[str]:
    radius = problem.plant.spectral_radius
    if problem.carries_plant and radius > _NEARLY_UNSTABLE:
        yield (
            f"plant: A is nearly unstable: its spectral radius is {radius:.9g}, above {_NEARLY_UNSTABLE}; "
            "the errors contain the state, so gamma may be large and the solver may stall"
        )
    plant = problem.plant
    matrices = {"A": plant.A, "B": plant.B, "M": plant.M}
    matrices |= {f'C of node "{node.name}"': node.C for node in problem.nodes}
    sizes = {name: float(np.abs(matrix).max()) for name, matrix in matrices.items() if matrix.any()}
    if sizes:
        small, large = min(sizes, key=lambda name: sizes[name]), max(sizes, key=lambda name: sizes[name])
        if sizes[large] > _SCALES * sizes[small]:
            yield (
                f"the largest number in {small} is {sizes[small]:.3g}, and in {large} {sizes[large]:.3g}: they differ "
                f"by more than {_SCALES:.0e}; is every unit what it should be?"
            )


def _warned_chances(problem: Problem) -> Iterator[str]:
    for node in problem.nodes:
        if node.arrival_probability < _RARELY:
            yield (
                f'node "{node.name}": arrival_probability {node.arrival_probability:g} is below {_RARELY}; '
                "its measurements hardly count"
            )
    for link in problem.links or ():
        if link.delivery_probability < _RARELY:
            yield (
                f'link from "{link.sender}" to "{link.receiver}": delivery_probability {link.delivery_probability:g} '
                f"is below {_RARELY}; its messages hardly count"
            )


def _warned_modes(problem: Problem) -> Iterator[str]:
    names, transition = problem.mode_names, problem.markov.transition
    reached = _closure(transition > 0.0)[problem.mode_index(problem.markov.initial)]
    unreached = [name for name, there in zip(names, reached, strict=True) if not there]
    if unreached:
        yield (
            f"markov: {'mode' if len(unreached) == 1 else 'modes'} {listed(unreached)} can never be reached from the "
            f'initial mode "{problem.markov.initial}"; gains are designed for all modes, since gamma holds from any'
        )
    for s, t in np.argwhere((transition > 0.0) & (transition < _NEVER_QUITE)):
        yield (
            f'markov: the probability {transition[s, t]:.3g} of going from "{names[s]}" to "{names[t]}" is below '
            f"{_NEVER_QUITE:g}; gamma counts the mode as possible all the same"
        )
