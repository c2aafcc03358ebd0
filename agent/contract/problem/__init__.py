"""A problem: plant, nodes, topologies, Markov chain, disturbance. Eqs. (1)-(3) of Zhu et al. 2020.

Not in the paper: losses that a node sees, links that lose messages, gains that are imposed to be unbiased.

`parts` and `disturbance` are what a problem is made of, each checked by itself; `consistency` is what must hold
between them; `file` is how it is written down, `changes` how Python says it. `uncertainty` is how far
numbers may be off what really is.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cached_property
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field, field_validator, model_validator

from agent.contract.arrays import Array, Model, read_only
from agent.contract.errors import InputError, counted, listed
from agent.contract.problem import changes, consistency, file
from agent.contract.problem.disturbance import Disturbance, Quiet
from agent.contract.problem.parts import LossyLink, MarkovChain, Name, Node, Plant, Topology
from agent.contract.problem.uncertainty import Uncertainty, certain
from agent.contract.tables import table


class Problem(Model):
    """A plant, the nodes that watch it, the topologies of their network and the chain that switches them."""

    name: Name
    plant: Plant
    nodes: tuple[Node, ...] = Field(alias="node", min_length=1)
    topologies: tuple[Topology, ...] = Field(alias="topology", min_length=1)
    markov: MarkovChain
    disturbance: Disturbance = Quiet()
    links: tuple[LossyLink, ...] | None = Field(default=None, alias="link", min_length=1)
    uncertainty: Uncertainty | None = None
    unbiased: bool | None = Field(default=None, strict=True)  # sum over j of a_ij K_ij = A, imposed; None: it is not

    @classmethod
    def load(cls, path: str | Path, revise: Callable[[dict[str, Any]], None] | None = None) -> Self:
        """Read a problem.toml; `revise` may change what it says before it is checked.

        Raises InputError: one sentence naming the place, the value, what is right.
        """
        path = Path(path)
        document = file.read_toml(path)
        if revise is not None:
            revise(document)
        try:
            file.read_csv(document, folder=path.parent)
            return cls.from_document(document)
        except InputError as error:
            raise InputError(f"{path}: {error}") from None

    @classmethod
    def from_arrays(
        cls,
        name: str,
        *,
        A: ArrayLike,
        B: ArrayLike,
        M: ArrayLike,
        C: Mapping[str, ArrayLike],
        D: Mapping[str, ArrayLike],
        adjacency: Mapping[str, ArrayLike],
        transition: ArrayLike = ((1.0,),),
        initial: str | None = None,
        arrival_probability: float | Mapping[str, float] = 1.0,
        **others: Any,
    ) -> Self:
        """A problem of arrays. `C` and `D` have one for each node, by its name, `adjacency` one for each mode.

        A: (nx, nx), B: (nx, nw), M: (nz, nx), C_i: (ny_i, nx), D_i: (ny_i, nw), adjacency: (n, n) with the rows who
        hears, transition: (modes, modes). `initial` is the first mode where it is not given; `others` are further keys
        of a problem file, such as `disturbance`. Raises InputError as `load` does.
        """
        document = changes.from_arrays(
            name,
            A=A,
            B=B,
            M=M,
            C=C,
            D=D,
            adjacency=adjacency,
            transition=transition,
            initial=initial,
            arrival_probability=arrival_probability,
            others=others,
        )
        return cls.from_document(document)

    def with_(self, **values: Any) -> Self:
        """A copy with other values, under the names of a problem file; it is validated like a file.

        Tables are changed key by key, nodes and topologies by their names, all of them by "*":
        `problem.with_(plant={"A": A}, node={"*": {"arrival_probability": 0.7}})`. A `disturbance` is replaced.
        Raises InputError: one sentence for what cannot be.
        """
        return self.from_document(changes.changed(self.document(), values))

    def certain(self) -> Self:
        """A copy without tolerances: all of it is taken to be as it says."""
        return self.from_document(certain(self.document()))

    def __repr__(self) -> str:
        """In a line; `document()` has everything."""
        parts = (counted(self.n, "node"), counted(self.nx, "state"), counted(len(self.topologies), "mode"))
        return f"Problem({self.name}: {', '.join(parts)})"

    __str__ = __repr__

    def _repr_html_(self) -> str:
        """What a notebook shows: each node, and whom it hears in each mode."""
        rows = []
        for i, node in enumerate(self.nodes):
            heard = (
                f"{mode}: {', '.join(self.node_names[j] for j in self.neighbours(s, i) if j != i) or 'nobody'}"
                for s, mode in enumerate(self.mode_names)
            )
            rows.append((node.name, f"arrives with {node.arrival_probability:g}; hears in mode {'; '.join(heard)}"))
        return table(repr(self), rows)

    @model_validator(mode="before")
    @classmethod
    def _as_written(cls, document: Any) -> Any:
        document = file.adjacency_from_hears(document)
        file.refuse_unbiased_in_tables(document)
        return document

    @field_validator("unbiased")
    @classmethod
    def _true_or_none(cls, value: bool | None) -> bool | None:
        return value or None

    @model_validator(mode="after")
    def _fits_together(self) -> Self:
        consistency.check_nodes(self.nodes, self.plant)
        consistency.check_topologies(self.topologies, self.node_names)
        consistency.check_links(self.links or (), self.node_names, self.topologies)
        consistency.check_stability(self.plant, unbiased=bool(self.unbiased), hidden=self._hidden())
        consistency.check_markov(self.markov, self.mode_names)
        consistency.check_disturbance(self.disturbance, self.plant)
        return self

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
    def initial_error(self) -> Array:
        """x(0) - x_hat_i(0) of every node, at most, (nx,): a simulated plant begins with it."""
        return read_only(np.zeros(self.nx) if self.plant.initial_error is None else self.plant.initial_error)

    @cached_property
    def beta(self) -> Array:
        """Arrival probabilities, (n,)."""
        return read_only([node.arrival_probability for node in self.nodes])

    @cached_property
    def weights(self) -> Array:
        """How much the error of each node counts in z_tilde, (n,)."""
        return read_only([1.0 if node.weight is None else node.weight for node in self.nodes])

    @cached_property
    def delivery(self) -> Array:
        """Delivery probabilities rho_ij, from node j to node i, (n, n); 1 where no link says otherwise."""
        rho = np.ones((self.n, self.n))
        for link in self.links or ():
            rho[self.node_names.index(link.receiver), self.node_names.index(link.sender)] = link.delivery_probability
        return read_only(rho)

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
