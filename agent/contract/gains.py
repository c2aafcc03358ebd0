"""The gains file: the problem, the gains of eq. (5), and what was proved of them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, Self

import numpy as np
from pydantic import Field, model_validator

from agent.contract.arrays import Array, Matrix, Model, Number, Vector, shape_text
from agent.contract.errors import InputError, listed
from agent.contract.files import RepeatedKey, kind_of, read_bytes, read_json, write_whole
from agent.contract.problem import Problem
from agent.contract.tables import table

FORMAT = "peakmesh-gains"
VERSION = 1
_ENERGY = 1e-9  # that of `worst_case` may be off 1 by

Gamma = Annotated[Number, Field(gt=1e-150, lt=1e150)]  # so that gamma^2 is a float64
Share = Annotated[Number, Field(ge=0.0, le=1.0)]

# gains[mode][i][j]: node i receives from node j; only where a_ij > 0 in that mode
LinkMatrices = dict[str, dict[str, dict[str, Matrix]]]


class Solver(Model):
    """What the solver said. Not believed: the certificate is computed again without it."""

    name: str
    version: str
    status: str
    iterations: int
    residuals: tuple[Number, Number] | None = None  # primal and dual, as the solver measures them
    seconds: float


class BoxClaim(Model):
    """What is said of every model in the box that the problem has: its `uncertainty`, and every `tolerance`.

    `ends`, `rows` and `signs` say which corner the worst model is that was found (`designer.box.extent.truth_at`); a
    proof makes its weights from there, by `start` and `rounds` (`designer.box.weights`), and believes none of it.
    """

    gamma: Gamma | None = None  # None: none is proved, and that is why:
    why_not: str | None = None
    found: Number | None = None  # the exact gain of the worst model that was found; None: it is not stable
    ends: tuple[bool, ...]
    rows: tuple[int, ...]
    signs: tuple[int, ...]
    start: int = Field(default=0, strict=True, ge=0)
    rounds: tuple[tuple[Gamma, Share], ...] = Field(default=(), max_length=100)


class Weights(Model):
    """What proves `lmi_least`: V(s) >= 0 on [T x; T e_1; ...; T e_n; w], or without x where P is over e alone.

    Of V(s) the rows of the lower triangle. Where nothing looks at an entry it may be 0, and stands for any other.
    `designer.proof.least` proves from them whatever they prove, and believes none of it.
    """

    states: Matrix  # T, (r, nx): r of them are what w brings about
    V: dict[str, tuple[Vector, ...]]

    @classmethod
    def of(cls, states: Array, V: Array, modes: Sequence[str]) -> Self:
        """V (modes, order, order), symmetric."""
        rows = {mode: tuple(row[: k + 1] for k, row in enumerate(V_s)) for mode, V_s in zip(modes, V, strict=True)}
        return cls(states=states, V=rows)

    def matrices(self, modes: Sequence[str]) -> Array:
        """V again."""
        order = len(self.V[modes[0]])
        V = np.zeros((len(modes), order, order))
        for V_s, mode in zip(V, modes, strict=True):
            for k, row in enumerate(self.V[mode]):
                V_s[k, : k + 1] = V_s[: k + 1, k] = row
        return V


class Certificate(Model):
    """What is proved: sup_k E ||z_tilde(k)||^2 <= gamma^2 sum_k ||w(k)||^2, from zero initial error.

    The expectation is over modes, losses and deliveries; one run may exceed it. P is over the reduced error state
    eta = [x; e_1; ...; e_n], nodes in file order, or e alone where the errors do not depend on x. Kind "lyapunov" is
    Theorem 1, (17) and (18) for P. Kind "exact" is the recursion of the exact gain, which P ends by (17); it may have
    Theorem 1's gamma for the same P beside its own.
    """

    gamma: Gamma  # the least that is proved
    kind: Literal["lyapunov", "exact"]
    theorem1_gamma: Gamma | None = None  # kind "exact": proved too, by (18)
    form: Literal["structured", "full", "summed"]  # summed: P is not stored; who verifies sums it from the gains
    R: Matrix | None = None  # structured: P(s) = diag{R, Q_1(s), ..., Q_n(s)}, each (nx, nx); None with e alone
    Q: dict[str, dict[str, Matrix]] | None = None  # Q[mode][node]
    P: dict[str, Matrix] | None = None  # full: P[mode]
    horizon: int | None = Field(default=None, strict=True)  # kind "exact": the proof needs no more steps than this
    lmi_gamma: Number | None = None  # where an LMI was solved: its optimum, as the solver gave it
    lmi_least: Number | None = None  # proved: no gains have less by an LMI of this form
    lmi_weights: Weights | None = None  # which prove it; None: nothing does, or a disturbance that no node sees
    lmi_why_not: str | None = None  # why there is no lmi_least beside an lmi_gamma
    lmi_exact: tuple[Number, Number] | None = None  # the gain of the LMI's gains, where those are not these
    exact: tuple[Number, Number] | None = None  # the gain lies between these
    floor: Number | None = None
    box: BoxClaim | None = None  # where the problem says how far its numbers may be off
    holds: bool = Field(strict=True)
    verified: str  # what was verified, and how
    margins: dict[str, Number]  # by how much each inequality holds; all positive where it does

    @property
    def by_theorem1(self) -> float | None:
        """The gamma that (17) and (18) prove, for a P that is stored."""
        return self.gamma if self.kind == "lyapunov" else self.theorem1_gamma

    @property
    def box_gamma(self) -> float | None:
        """What is claimed for every model of the problem's box."""
        return None if self.box is None else self.box.gamma

    @model_validator(mode="after")
    def _check_claims(self) -> Self:
        if self.theorem1_gamma is not None and (self.kind != "exact" or self.form == "summed"):
            raise ValueError(
                'theorem1_gamma stands beside the gamma of kind "exact", for a P that is stored; kind '
                f'"{self.kind}" with form "{self.form}" has none'
            )
        return self


class Gains(Model):
    """Gains K_ij, H_ij of eq. (5) for every mode; the filter step multiplies them by a_ij."""

    format: Literal["peakmesh-gains"] = "peakmesh-gains"
    version: Literal[1] = 1
    problem: Problem
    problem_digest: str
    method: str
    K: LinkMatrices  # each (nx, nx)
    H: LinkMatrices  # each (nx, ny_j)
    certificate: Certificate
    solver: Solver
    seconds: dict[str, Number]  # of each phase of the design, and "total"
    worst_case: Matrix | None = None  # (steps, nw), energy 1: the worst fixed w, where the problem asks for it

    @classmethod
    def of(
        cls,
        problem: Problem,
        K: LinkMatrices,
        H: LinkMatrices,
        *,
        method: str,
        certificate: Certificate,
        solver: Solver,
        **seconds: float,
    ) -> Self:
        """New gains for a problem; `seconds` are of each phase in which they were made."""
        return cls(
            problem=problem,
            problem_digest=problem.digest(),
            method=method,
            K=K,
            H=H,
            certificate=certificate,
            solver=solver,
            seconds=seconds | {"total": sum(seconds.values(), 0.0)},
        )

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read a gains.json. Raises InputError for a file that is missing, cut, foreign or edited."""
        return cls.from_bytes(read_bytes(Path(path), kind="gains file"), source=str(path))

    @classmethod
    def from_bytes(cls, data: bytes, *, source: str) -> Self:
        """Gains from the bytes of a gains.json; `source` names them in errors."""
        try:
            document = read_json(data)
        except (ValueError, RecursionError) as error:
            kind = kind_of(data)
            why = str(error) if isinstance(error, RepeatedKey) else f"it is not valid JSON: {error}"
            why = f"it is {kind}" if kind in ("a recording", "a problem file") else why
            hint = f"; design it first: peakmesh design {source}" if kind == "a problem file" else ""
            raise InputError(f"{source} is not a gains file: {why}{hint}") from None
        if not isinstance(document, dict) or document.get("format") != FORMAT:
            raise InputError(f'{source} is not a gains file: it does not say "format": "{FORMAT}"')
        if document.get("version") != VERSION:
            raise InputError(
                f"{source} has gains format {document.get('version')!r}; this peakmesh reads {VERSION}: "
                "design the gains again"
            )
        try:
            return cls.from_document(document)
        except InputError as error:
            raise InputError(f"{source}: {error}") from None

    @property
    def gamma(self) -> float:
        """What the certificate claims."""
        return self.certificate.gamma

    def __repr__(self) -> str:
        """In a line; `document()` has everything."""
        claim = "claimed" if self.certificate.holds else "not claimed"
        return f"Gains({self.problem.name} by {self.method}: gamma = {self.gamma:.6g}, {claim})"

    __str__ = __repr__

    def _repr_html_(self) -> str:
        """What a notebook shows."""
        claim = self.certificate
        exact = "" if claim.exact is None else f"between {claim.exact[0]} and {claim.exact[1]}"
        facts = {"method": self.method, "gamma": str(self.gamma), "exact gain": exact, "verified": claim.verified}
        return table(repr(self), ((name, value) for name, value in facts.items() if value))

    def save(self, path: str | Path, *, force: bool = False) -> None:
        """Write canonical JSON, whole or not at all."""
        write_whole(Path(path), self.canonical(), force=force)

    def for_node(self, name: str) -> NodeGains:
        """What node `name` needs to run."""
        problem = self.problem
        i = problem.node_index(name)
        links = {
            mode: tuple(
                Link(
                    sender := problem.node_names[j],
                    float(problem.topologies[s].adjacency[i, j]),
                    self.K[mode][name][sender],
                    self.H[mode][name][sender],
                )
                for j in problem.neighbours(s, i)
            )
            for s, mode in enumerate(problem.mode_names)
        }
        node = problem.nodes[i]
        A = problem.plant.A if problem.unbiased else None
        rows = {
            mode: np.hstack([*([] if A is None else [A]), *(block for _, a, K, H in heard for block in (a * K, a * H))])
            for mode, heard in links.items()
        }
        return NodeGains(name, node.C, node.arrival_probability, problem.plant.M, links, rows, node.seen, A)

    @model_validator(mode="after")
    def _check_digest(self) -> Self:
        if self.problem_digest != self.problem.digest():
            raise ValueError(
                f"the problem in it has digest {self.problem.digest()[:12]}..., the gains were designed for "
                f"{self.problem_digest[:12]}...: the problem was edited afterwards; design the gains again"
            )
        return self

    @model_validator(mode="after")
    def _check_links(self) -> Self:
        check_links(self.problem, self.K, self.H)
        return self

    @model_validator(mode="after")
    def _check_weights(self) -> Self:
        weights, problem = self.certificate.lmi_weights, self.problem
        if weights is None:
            return self
        states, order = len(weights.states), len(weights.states) * (problem.n + bool(problem.plant_states)) + problem.nw
        if weights.states.shape[1] != problem.nx or states > problem.nx:
            raise ValueError(
                f"certificate: lmi_weights: states is {shape_text(weights.states)}; it must have {problem.nx} columns, "
                "and no more rows than that"
            )
        _same_names("certificate: lmi_weights: V", weights.V, problem.mode_names, "modes")
        for mode, rows in weights.V.items():
            lengths = [len(row) for row in rows]
            if lengths != list(range(1, order + 1)):
                raise ValueError(
                    f'certificate: lmi_weights: V of mode "{mode}" is no lower triangle of {order} rows, the '
                    "first of 1 number and each of one more than the one above it"
                )
        return self

    @model_validator(mode="after")
    def _check_worst_case(self) -> Self:
        if self.worst_case is not None and self.worst_case.shape[1] != self.problem.nw:
            raise ValueError(
                f"worst_case is {shape_text(self.worst_case)}; it needs a column for each disturbance of the plant, "
                f"{self.problem.nw}"
            )
        energy = 1.0 if self.worst_case is None else float((self.worst_case**2).sum())
        if abs(energy - 1.0) > _ENERGY:
            raise ValueError(f"worst_case has energy {energy:.9g}; it must be a sequence of energy 1")
        return self


def check_links(problem: Problem, K: LinkMatrices, H: LinkMatrices) -> None:
    """Raise ValueError unless there is a gain of the right shape for every link of the problem, and for no other."""
    for letter, gains in (("K", K), ("H", H)):
        _same_names(letter, gains, problem.mode_names, "modes")
        for s, mode in enumerate(problem.mode_names):
            _same_names(f'{letter}: mode "{mode}"', gains[mode], problem.node_names, "nodes")
            for i, receiver in enumerate(problem.node_names):
                where = f'{letter}: mode "{mode}": node "{receiver}"'
                neighbours = problem.neighbours(s, i)
                heard = tuple(problem.node_names[j] for j in neighbours)
                _same_names(where, gains[mode][receiver], heard, "nodes that it hears in this mode")
                for j, sender in zip(neighbours, heard, strict=True):
                    columns = problem.nx if letter == "K" else problem.nodes[j].C.shape[0]
                    gain = gains[mode][receiver][sender]
                    if gain.shape != (problem.nx, columns):
                        raise ValueError(
                            f'{where}: from "{sender}" is {shape_text(gain)}; it must be {problem.nx} x {columns}'
                        )
    if problem.unbiased:
        _refuse_bias(problem, K)


def _refuse_bias(problem: Problem, K: LinkMatrices) -> None:
    """sum over j of a_ij K_ij = A, but for the rounding of K_ii."""
    for s, topology in enumerate(problem.topologies):
        for i, receiver in enumerate(problem.node_names):
            heard = problem.neighbours(s, i)
            terms = [topology.adjacency[i, j] * K[topology.name][receiver][problem.node_names[j]] for j in heard]
            size = np.sum(np.abs(terms), axis=0) + np.abs(problem.plant.A)
            bias = np.abs(np.sum(terms, axis=0) - problem.plant.A)
            if (bias > 4.0 * (len(heard) + 2) * 2.0**-53 * size).any():
                raise ValueError(
                    f'K: mode "{topology.name}": node "{receiver}": the sum of a_ij K_ij differs from A by '
                    f"{bias.max():.3g}; the problem says that its gains are unbiased"
                )


class Link(NamedTuple):
    """What node i hears from node j in one mode."""

    sender: str
    weight: float  # a_ij
    K: Array  # K_ij, (nx, nx)
    H: Array  # H_ij, (nx, ny_j)


class NodeGains(NamedTuple):
    """One node's slice of the gains."""

    node: str
    C: Array  # C_i, (ny_i, nx)
    arrival_probability: float  # beta_i
    M: Array  # (nz, nx)
    links: dict[str, tuple[Link, ...]]  # mode -> what the node hears in it, itself among them
    rows: dict[
        str, Array
    ]  # mode -> eq. (5) as one matrix: [a_ij K_ij, a_ij H_ij] of the links, in their order, after A
    seen: bool = False  # whether it knows which of its measurements are lost
    A: Array | None = None  # of the plant, where the gains are unbiased: a_ii K_ii is A less what others get


def _same_names(where: str, found: dict[str, Any], expected: tuple[str, ...], what: str) -> None:
    if set(found) != set(expected):
        raise ValueError(f"{where} has gains for {listed(found) or 'none'}; the {what} are {listed(expected)}")
