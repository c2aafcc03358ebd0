"""The problem file: plant, nodes, topologies, Markov chain, disturbance. Eqs. (1)-(3) of Zhu et al. 2020.

Not in the paper: losses that a node sees, links that lose messages, gains that are imposed to be unbiased.
"""

from __future__ import annotations

import re
import tomllib
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import AfterValidator, Field, ValidationError, field_validator, model_validator

from agent.contract.arrays import Array, Matrix, Model, shape_text
from agent.contract.errors import InputError, counted, first_fault, listed, shortened
from agent.contract.files import kind_of, read_bytes

ROW_SUM_TOLERANCE = 1e-9


def _legal_name(name: str) -> str:
    if not re.fullmatch(r"[A-Za-z0-9_-]{1,64}", name):
        raise ValueError(f'{shortened(name)} is not a legal name: use 1 to 64 letters, digits, "-" and "_"')
    return name


Name = Annotated[str, AfterValidator(_legal_name)]
Number = Annotated[float, Field(strict=True)]  # neither "0.5" nor true is a number


class Plant(Model):
    """Eq. (1): x(k+1) = A x(k) + B w(k), z(k) = M x(k). A: (nx, nx), B: (nx, nw), M: (nz, nx)."""

    A: Matrix
    B: Matrix
    M: Matrix

    @model_validator(mode="after")
    def _check(self) -> Self:
        nx = self.A.shape[0]
        if self.A.shape[1] != nx:
            raise ValueError(f"A is {shape_text(self.A)}; it must be square")
        if self.B.shape[0] != nx:
            raise ValueError(f"B is {shape_text(self.B)}; A is {shape_text(self.A)}, so B needs {counted(nx, 'row')}")
        if self.M.shape[1] != nx:
            raise ValueError(
                f"M is {shape_text(self.M)}; A is {shape_text(self.A)}, so M needs {counted(nx, 'column')}"
            )
        return self

    @property
    def spectral_radius(self) -> float:
        """Of A: below 1 where the plant is stable."""
        return float(np.abs(np.linalg.eigvals(self.A)).max())


class Node(Model):
    """Eq. (2): y_i(k) = theta_i(k) C_i x(k) + D_i w(k). C_i: (ny_i, nx), D_i: (ny_i, nw).

    `arrival_probability` is beta_i = P(theta_i(k) = 1) of eq. (3), in (0, 1]. `loss` says what the node knows of
    theta_i(k): "hidden", as in the paper, nothing; "seen": a lost measurement does not arrive at all, and the
    innovation theta_i (C_i x + D_i w - C_i x_hat_i) is then 0. None stands for "hidden".
    """

    name: Name
    C: Matrix
    D: Matrix
    arrival_probability: Number
    loss: Literal["hidden", "seen"] | None = None

    @property
    def seen(self) -> bool:
        """Whether the node knows which of its measurements are lost."""
        return self.loss == "seen"

    @field_validator("loss")
    @classmethod
    def _one_word(cls, value: str | None) -> str | None:
        return None if value == "hidden" else value  # so that the digest does not depend on whether it is written

    @field_validator("arrival_probability")
    @classmethod
    def _in_range(cls, value: float) -> float:
        if not 0.0 < value <= 1.0:
            raise ValueError(f"{value} is not in (0, 1]; 1 means that no measurement is ever lost")
        return value

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.C.shape[0] != self.D.shape[0]:
            raise ValueError(
                f"C is {shape_text(self.C)} and D is {shape_text(self.D)}; "
                "both need one row for each measurement of the node"
            )
        return self


class Topology(Model):
    """One mode: adjacency (n, n) with a_ij > 0 where node i hears node j, and a_ii > 0."""

    name: Name
    adjacency: Matrix


class LossyLink(Model):
    """Messages from `sender` reach `receiver` with this probability, independently at every step.

    Where one does not, the receiver puts its own estimate in place of the sender's and 0 in place of its innovation.
    """

    receiver: str
    sender: str
    delivery_probability: Number

    @field_validator("delivery_probability")
    @classmethod
    def _in_range(cls, value: float) -> float:
        if not 0.0 < value <= 1.0:
            raise ValueError(f"{value} is not in (0, 1]; 1 means that every message arrives")
        return value


class MarkovChain(Model):
    """The switching of the topology: pi_st = P(r(k+1) = t | r(k) = s); `initial` names r(0)."""

    transition: Matrix
    initial: str


class DampedSine(Model):
    """w(k) = amplitude exp(-decay k) sin(frequency k), alike in every component."""

    kind: Literal["damped-sine"]
    amplitude: Number = 1.0
    decay: Number = Field(ge=0.0)
    frequency: Number = 1.0


class Impulse(Model):
    """w(k) = amplitude at step `at`, in every component, else 0."""

    kind: Literal["impulse"]
    amplitude: Number = 1.0
    at: int = Field(default=0, ge=0, strict=True)


class White(Model):
    """w(k) independent, zero-mean, Gaussian with the given standard deviation, in every component."""

    kind: Literal["white"]
    deviation: Number = Field(gt=0.0)


class Samples(Model):
    """w(k) is row k of a CSV file (one column for each component, no header), and 0 after its last row."""

    kind: Literal["csv"]
    file: str
    values: Matrix


class WorstCase(Model):
    """w(k) is `amplitude` times the sequence of energy 1 that is worst for the gains; their file has it."""

    kind: Literal["worst-case"]
    amplitude: Number = 1.0


class Quiet(Model):
    """w(k) = 0."""

    kind: Literal["none"] = "none"


Disturbance = Annotated[DampedSine | Impulse | White | Samples | WorstCase | Quiet, Field(discriminator="kind")]


class Problem(Model):
    """A plant, the nodes that watch it, the topologies of their network and the chain that switches them."""

    name: Name
    plant: Plant
    nodes: tuple[Node, ...] = Field(alias="node", min_length=1)
    topologies: tuple[Topology, ...] = Field(alias="topology", min_length=1)
    markov: MarkovChain
    disturbance: Disturbance = Quiet()
    links: tuple[LossyLink, ...] | None = Field(default=None, alias="link", min_length=1)
    unbiased: bool | None = Field(default=None, strict=True)  # sum over j of a_ij K_ij = A, imposed; None: it is not

    @classmethod
    def load(cls, path: Path) -> Self:
        """Read a problem.toml. Raises InputError: one sentence naming the place, the value, what is right."""
        data = read_bytes(path, kind="problem file")
        try:
            document = tomllib.loads(data.decode())
        except (ValueError, RecursionError) as error:
            kind = kind_of(data)
            why = f"it is {kind}" if kind in ("a recording", "a gains file") else f"it is not valid TOML: {error}"
            raise InputError(f"{path} is not a problem file: {why}") from None
        try:
            _read_csv(document, folder=path.parent)
            return cls.from_document(document)
        except InputError as error:
            raise InputError(f"{path}: {error}") from None

    @classmethod
    def from_document(cls, document: Any) -> Self:
        """A problem from plain dicts and lists, as they stand in problem.toml or gains.json."""
        try:
            return cls.model_validate(document)
        except ValidationError as error:
            raise InputError(first_fault(error, document)) from None

    # what is there
    @cached_property
    def node_names(self) -> tuple[str, ...]:
        return tuple(node.name for node in self.nodes)

    @cached_property
    def mode_names(self) -> tuple[str, ...]:
        return tuple(topology.name for topology in self.topologies)

    @property
    def n(self) -> int:
        """Number of nodes."""
        return len(self.nodes)

    @property
    def nx(self) -> int:
        """Number of plant states."""
        return int(self.plant.A.shape[0])

    @property
    def nw(self) -> int:
        """Number of disturbances."""
        return int(self.plant.B.shape[1])

    @property
    def nz(self) -> int:
        """Number of outputs to estimate."""
        return int(self.plant.M.shape[0])

    @cached_property
    def beta(self) -> Array:
        """Arrival probabilities, (n,)."""
        return np.array([node.arrival_probability for node in self.nodes])

    @cached_property
    def delivery(self) -> Array:
        """Delivery probabilities rho_ij, from node j to node i, (n, n); 1 where no link says otherwise."""
        rho = np.ones((self.n, self.n))
        for link in self.links or ():
            rho[self.node_names.index(link.receiver), self.node_names.index(link.sender)] = link.delivery_probability
        return rho

    @property
    def carries_plant(self) -> bool:
        """Whether the errors depend on x itself: not where the gains are unbiased and every loss is seen."""
        return not self.unbiased or bool(self._hidden())

    @property
    def plant_states(self) -> int:
        """How many entries of eta are x: nx, or 0 where the errors do not depend on it."""
        return self.nx if self.carries_plant else 0

    def _hidden(self) -> list[str]:
        """The nodes that lose measurements without knowing it."""
        return [node.name for node in self.nodes if node.arrival_probability < 1.0 and not node.seen]

    def node_index(self, name: str) -> int:
        """Index of a node; InputError names the nodes there are."""
        if name not in self.node_names:
            raise InputError(f'node "{name}" does not exist; the problem has nodes {listed(self.node_names)}')
        return self.node_names.index(name)

    def mode_index(self, name: str) -> int:
        """Index of a mode; InputError names the modes there are."""
        if name not in self.mode_names:
            raise InputError(f'mode "{name}" does not exist; the problem has modes {listed(self.mode_names)}')
        return self.mode_names.index(name)

    def neighbours(self, s: int, i: int) -> tuple[int, ...]:
        """N_i of mode s: the nodes that node i hears, itself among them, ascending."""
        return tuple(int(j) for j in np.flatnonzero(self.topologies[s].adjacency[i] > 0.0))

    def ever_heard(self, i: int) -> tuple[int, ...]:
        """The nodes that node i hears in some mode, itself among them, ascending."""
        return tuple(sorted({j for s in range(len(self.topologies)) for j in self.neighbours(s, i)}))

    # what must hold
    @model_validator(mode="before")
    @classmethod
    def _unbiased_before_tables(cls, document: Any) -> Any:
        for name, table in document.items() if isinstance(document, dict) else ():
            entries = table if isinstance(table, list) else [table]
            if any(isinstance(entry, dict) and "unbiased" in entry for entry in entries):
                raise ValueError(f"unbiased stands in the table {name}; it belongs at the top, before every table")
        return document

    @model_validator(mode="before")
    @classmethod
    def _adjacency_from_hears(cls, document: Any) -> Any:
        if not isinstance(document, dict) or not isinstance(document.get("topology"), list):
            return document
        nodes = document.get("node")
        nodes = (
            [node.get("name") for node in nodes if isinstance(node, dict)] if isinstance(nodes, list | tuple) else []
        )
        if not nodes:
            return {**document, "topology": []}  # that is the fault to report, not the names that nobody has
        _refuse_duplicates("node", tuple(nodes))  # before names are looked up among them
        topologies = [_with_adjacency(topology, nodes) for topology in document["topology"]]
        return {**document, "topology": topologies}

    @model_validator(mode="after")
    def _check_nodes(self) -> Self:
        _refuse_duplicates("node", self.node_names)
        for node in self.nodes:
            if node.C.shape[1] != self.nx:
                raise ValueError(
                    f'node "{node.name}": C is {shape_text(node.C)}; the plant has {counted(self.nx, "state")}, '
                    f"so C needs {counted(self.nx, 'column')}"
                )
            if node.D.shape[1] != self.nw:
                raise ValueError(
                    f'node "{node.name}": D is {shape_text(node.D)}; the plant has {counted(self.nw, "disturbance")}, '
                    f"so D needs {counted(self.nw, 'column')}"
                )
        return self

    @model_validator(mode="after")
    def _check_topologies(self) -> Self:
        _refuse_duplicates("topology", self.mode_names)
        for topology in self.topologies:
            adjacency, where = topology.adjacency, f'topology "{topology.name}": adjacency'
            if adjacency.shape != (self.n, self.n):
                raise ValueError(
                    f"{where} is {shape_text(adjacency)}; for {counted(self.n, 'node')} it must be {self.n} x {self.n}"
                )
            for i, receiver in enumerate(self.node_names):
                for j, sender in enumerate(self.node_names):
                    if adjacency[i, j] < 0.0:
                        raise ValueError(
                            f'{where} gives "{receiver}" hearing "{sender}" the weight {adjacency[i, j]}; '
                            "a weight is 0 or positive"
                        )
                if adjacency[i, i] == 0.0:
                    raise ValueError(f'{where} has 0 for "{receiver}" itself; a node hears itself, a_ii = 1')
        return self

    @field_validator("unbiased")
    @classmethod
    def _true_or_none(cls, value: bool | None) -> bool | None:
        return value or None

    @model_validator(mode="after")
    def _check_links(self) -> Self:
        known: set[tuple[str, str]] = set()
        for link in self.links or ():
            where = f'link from "{link.sender}" to "{link.receiver}"'
            for name in (link.sender, link.receiver):
                if name not in self.node_names:
                    raise ValueError(
                        f'{where}: node "{name}" does not exist; the problem has nodes {listed(self.node_names)}'
                    )
            if link.sender == link.receiver:
                raise ValueError(f"{where}: a node has its own numbers always; name two nodes")
            if self.node_names.index(link.sender) not in self.ever_heard(self.node_names.index(link.receiver)):
                raise ValueError(f'{where}: "{link.receiver}" hears "{link.sender}" in no topology')
            if (link.receiver, link.sender) in known:
                raise ValueError(f"{where} is there twice; give it one delivery_probability")
            known.add((link.receiver, link.sender))
        return self

    @model_validator(mode="after")
    def _check_stability(self) -> Self:
        radius = self.plant.spectral_radius
        if radius < 1.0 or not self.carries_plant:
            return self
        if self.unbiased:
            raise ValueError(
                f"plant: A is unstable, its spectral radius is {radius:.6g}, and {self._hidden_text()}: "
                'its errors then contain the state; give it loss = "seen"'
            )
        raise ValueError(
            f"plant: A is unstable: its spectral radius is {radius:.6g} and must be below 1, because the errors "
            "contain the state; an unstable plant needs unbiased = true, "
            'and loss = "seen" at every node that loses measurements'
        )

    def _hidden_text(self) -> str:
        return f'node "{self._hidden()[0]}" does not know which of its measurements are lost'

    @model_validator(mode="after")
    def _check_markov(self) -> Self:
        transition, modes = self.markov.transition, self.mode_names
        if transition.shape != (len(modes), len(modes)):
            raise ValueError(
                f"markov: transition is {shape_text(transition)}; "
                f"for {counted(len(modes), 'topology')} it must be {len(modes)} x {len(modes)}"
            )
        for name, row in zip(modes, transition, strict=True):
            if (row < 0.0).any() or (row > 1.0).any():
                wrong = row[(row < 0.0) | (row > 1.0)][0]
                raise ValueError(f'markov: transition, row of "{name}", holds {wrong}; a probability lies in [0, 1]')
            if abs(row.sum() - 1.0) > ROW_SUM_TOLERANCE:
                raise ValueError(f'markov: transition, row of "{name}", sums to {row.sum():.12g}; it must sum to 1')
        if self.markov.initial not in modes:
            raise ValueError(
                f'markov: initial "{self.markov.initial}" is no topology; the topologies are {listed(modes)}'
            )
        return self

    @model_validator(mode="after")
    def _check_disturbance(self) -> Self:
        if isinstance(self.disturbance, Samples) and self.disturbance.values.shape[1] != self.nw:
            raise ValueError(
                f'disturbance: "{self.disturbance.file}" has {counted(self.disturbance.values.shape[1], "column")}; '
                f"the plant has {counted(self.nw, 'disturbance')}"
            )
        return self


def _refuse_duplicates(kind: str, names: tuple[str, ...]) -> None:
    for name in names:
        if names.count(name) > 1:
            raise ValueError(f'{kind} "{name}" is there {names.count(name)} times; names must differ')


def _with_adjacency(topology: Any, nodes: list[Any]) -> Any:
    """A topology that says `hears = { "1" = ["4"] }`, as one that says `adjacency`."""
    if not isinstance(topology, dict) or "hears" not in topology:
        return topology
    where = f'topology "{topology.get("name", "?")}": hears'
    if "adjacency" in topology:
        raise ValueError(f"{where} and adjacency are both given; keep one of them")
    hears = topology["hears"]
    if not (isinstance(hears, dict) and all(isinstance(heard, list) for heard in hears.values())):
        raise ValueError(f'{where} must map a node to a list of nodes, such as {{ "1" = ["4"] }}')
    adjacency = np.eye(len(nodes))
    for receiver, heard in hears.items():
        for sender in (receiver, *heard):
            if sender not in nodes:
                name = f'"{sender}"' if isinstance(sender, str) else shortened(sender)
                raise ValueError(f"{where}: node {name} does not exist; the nodes are {listed(nodes)}")
            adjacency[nodes.index(receiver), nodes.index(sender)] = 1.0
    return {key: value for key, value in topology.items() if key != "hears"} | {"adjacency": adjacency.tolist()}


def _read_csv(document: dict[str, Any], *, folder: Path) -> None:
    """Put the numbers of `disturbance.file` into the document, so that a problem is whole without the file."""
    disturbance = document.get("disturbance")
    if not (isinstance(disturbance, dict) and disturbance.get("kind") == "csv" and "file" in disturbance):
        return
    path = folder / str(disturbance["file"])
    text = read_bytes(path, kind="CSV file of the disturbance").decode("utf-8-sig", errors="replace")
    rows: list[list[float]] = []
    for number, line in enumerate(text.splitlines(), 1):
        try:
            rows.append([float(entry) for entry in line.split(",")])
        except ValueError:
            raise InputError(f"disturbance: {path}, row {number} is not all numbers: {shortened(line)}") from None
    if not rows:
        raise InputError(f"disturbance: {path} is empty; it needs a row of numbers for each step")
    disturbance["values"] = rows
