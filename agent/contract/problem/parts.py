"""The parts of a problem, each checked by itself: plant, node, topology, link, Markov chain. Eqs. (1)-(3)."""

from __future__ import annotations

import re
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import AfterValidator, Field, ValidationError, field_validator, model_validator

from agent.contract.arrays import Array, Matrix, Model, Number, Vector, shape_text
from agent.contract.errors import counted, first_fault, listed, shortened
from agent.contract.problem.sampling import sampled
from agent.contract.problem.uncertainty import OfChain, OfLink, OfNode, OfPlant, check_shape


def is_legal(name: Any) -> bool:
    """Whether a node or a mode may have this name: it becomes a part of key expressions, and of columns."""
    return isinstance(name, str) and re.fullmatch(r"[A-Za-z0-9_-]{1,64}", name) is not None


def _legal_name(name: str) -> str:
    if not is_legal(name):
        raise ValueError(f'{shortened(name)} is not a legal name: use 1 to 64 letters, digits, "-" and "_"')
    return name


Name = Annotated[str, AfterValidator(_legal_name)]


class Continuous(Model):
    """dx/dt = A_continuous x + B_continuous w, of which a sample is taken every `sample_time`."""

    A_continuous: Matrix
    B_continuous: Matrix
    sample_time: Number = Field(gt=0.0)

    @model_validator(mode="after")
    def _check(self) -> Self:
        A, B = self.A_continuous, self.B_continuous
        if A.shape[0] != A.shape[1]:
            raise ValueError(f"A_continuous is {shape_text(A)}; it must be square")
        if B.shape[0] != A.shape[0]:
            raise ValueError(
                f"B_continuous is {shape_text(B)}; A_continuous is {shape_text(A)}, so both need as many rows"
            )
        return self


CONTINUOUS = tuple(Continuous.model_fields)


class Plant(Model):
    """Eq. (1): x(k+1) = A x(k) + B w(k), z(k) = M x(k). A: (nx, nx), B: (nx, nw), M: (nz, nx).

    A plant of continuous time has A_continuous, B_continuous and `sample_time`, in one unit of time, in place of A and
    B, which follow from them (`sampling`); a saved problem has both, and they have to agree.

    `initial_error` (nx,): how far each state may be, either way, from 0, which is what the nodes begin with; a
    simulated plant begins there. None stands for 0.
    """

    A: Matrix
    B: Matrix
    M: Matrix
    A_continuous: Matrix | None = None
    B_continuous: Matrix | None = None
    sample_time: Number | None = Field(default=None, gt=0.0)
    tolerance: OfPlant | None = None
    initial_error: Vector | None = None

    @field_validator("initial_error")
    @classmethod
    def _none_for_0(cls, value: Array | None) -> Array | None:
        return None if value is None or not value.any() else value

    @model_validator(mode="before")
    @classmethod
    def _as_sampled(cls, document: Any) -> Any:
        given = {key: document.get(key) for key in CONTINUOUS} if isinstance(document, dict) else {}
        missing = [key for key, value in given.items() if value is None]
        if len(missing) == len(given):
            return document
        if missing:
            raise ValueError(f"{missing[0]} is missing; a plant of continuous time has {listed(CONTINUOUS)}")
        if ("A" in document) != ("B" in document):
            raise ValueError(f"A and B follow from {listed(CONTINUOUS)}; leave both out")
        try:
            known = Continuous.model_validate(given)
        except ValidationError as error:
            raise ValueError(first_fault(error, given)) from None
        A, B = sampled(known.A_continuous, known.B_continuous, known.sample_time)
        for key, matrix in (("A", A), ("B", B)):
            if document.get(key, matrix.tolist()) != matrix.tolist():
                raise ValueError(f"{key} is not what {listed(CONTINUOUS)} make of it; leave A and B out, or those")
        return {**document, "A": A.tolist(), "B": B.tolist()}

    @model_validator(mode="after")
    def _check(self) -> Self:
        nx = self.A.shape[0]
        if self.A.shape[1] != nx:
            raise ValueError(f"A is {shape_text(self.A)}; it must be square")
        if self.B.shape[0] != nx:
            raise ValueError(f"B is {shape_text(self.B)}; A is {shape_text(self.A)}, so B needs {counted(nx, 'row')}")
        if self.initial_error is not None and len(self.initial_error) != nx:
            raise ValueError(
                f"initial_error has {counted(len(self.initial_error), 'entry')}; A is {shape_text(self.A)}, so it has "
                f"{counted(nx, 'entry')}, one for each state"
            )
        if self.M.shape[1] != nx:
            raise ValueError(
                f"M is {shape_text(self.M)}; A is {shape_text(self.A)}, so M needs {counted(nx, 'column')}"
            )
        for name in OfPlant.model_fields:
            check_shape(name, getattr(self.tolerance, name, None), getattr(self, name))
        return self

    @property
    def spectral_radius(self) -> float:
        """Of A: below 1 where the plant is stable."""
        return float(np.abs(np.linalg.eigvals(self.A)).max())


class Node(Model):
    """Eq. (2): y_i(k) = theta_i(k) C_i x(k) + D_i w(k). C_i: (ny_i, nx), D_i: (ny_i, nw).

    `arrival_probability` is beta_i = P(theta_i(k) = 1) of eq. (3), in (0, 1]. `loss` says what the node knows of
    theta_i(k): "hidden", as in the paper, nothing; "seen": a lost measurement does not arrive at all, and the
    innovation theta_i (C_i x + D_i w - C_i x_hat_i) is then 0. None stands for "hidden". `weight` is how much the
    node's error counts: z_tilde has weight (z - z_hat_i) of it. None stands for 1.
    """

    name: Name
    C: Matrix
    D: Matrix
    arrival_probability: Number
    loss: Literal["hidden", "seen"] | None = None
    weight: Number | None = None
    tolerance: OfNode | None = None

    @property
    def seen(self) -> bool:
        """Whether the node knows which of its measurements are lost."""
        return self.loss == "seen"

    @field_validator("weight")
    @classmethod
    def _counts(cls, value: float | None) -> float | None:
        if value is not None and not 1e-6 <= value <= 1e6:
            raise ValueError(f"{value} is not in [1e-6, 1e6]; 1 counts the node as it is, 0.1 a tenth of its error")
        return None if value == 1.0 else value

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
        for name in ("C", "D"):
            check_shape(name, getattr(self.tolerance, name, None), getattr(self, name))
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
    tolerance: OfLink | None = None

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
    tolerance: OfChain | None = None
