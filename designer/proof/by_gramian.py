"""The exact gain where chance has no say: gamma^2 is the largest eigenvalue of M G M', and balls enclose that.

Where no loss, no message and no mode makes a difference, as where all nodes ignore all measurements, z_tilde(k) is
the sum of M A^j B w(k - 1 - j) over j < k in every run. So whatever w does, |z_tilde(k)|^2 is at most the largest
eigenvalue of M G_k M' times sum |w|^2, G_k the sum of A^j B B' A'^j over j < k; and one w attains that. docs/theory.md,
section 4.
"""

from __future__ import annotations

from functools import cached_property
from typing import NamedTuple

import flint
from flint import arb, arb_mat, ctx

from agent.contract.gains import LinkMatrices
from agent.contract.problem import Problem
from designer.proof.ball_model import BallModel, is_zero
from designer.proof.balls import UNDECIDED, Sign, diagonal, identity, part, sign
from designer.proof.gramian import Gramian, square

_BITS = (512, 2048)
_LARGEST = 100  # states: to square them takes a tenth of a second


class Alone(NamedTuple):
    """eta+ = A eta + B w and z_tilde = M eta, in every mode and whatever gets lost."""

    A: arb_mat
    B: arb_mat
    M: arb_mat

    @classmethod
    def of(cls, model: BallModel) -> Alone | None:
        """The plant alone where every error moves as the plant does; None where chance or the mode has a say."""
        if any(not noise.is_nothing for of_mode in model.noise for noise in of_mode):
            return None
        first = model.AB[0]
        if not all(_equal(AB, first) for AB in model.AB):
            return None
        like = cls._alike(model)
        if like is None:
            like = cls(part(first, model.eta, model.eta), part(first, model.eta, model.w), model.M)
        return like if like.A.nrows() <= _LARGEST else None

    @classmethod
    def _alike(cls, model: BallModel) -> Alone | None:
        """All errors begin at 0 and do the same, so they are one."""
        AB, e_1 = model.AB[0], model.e[0]
        A, B = part(AB, e_1, e_1), part(AB, e_1, model.w)
        M = arb_mat(model.M.nrows(), len(e_1))
        for e_i in model.e:
            others = [k for k in model.eta if k not in e_i]
            alike = _equal(part(AB, e_i, e_i), A) and _equal(part(AB, e_i, model.w), B)
            if not (alike and is_zero(part(AB, e_i, others))):
                return None
            M += part(model.M, range(M.nrows()), e_i)
        return cls(A, B, M) if is_zero(part(model.M, range(M.nrows()), model.x)) else None


class ByGramian:
    """What is proved where chance has no say; `of` says whether that is so."""

    def __init__(self, alone: Alone, bits: int) -> None:
        self._alone, self._bits = alone, bits
        self.name = f"ball arithmetic of {bits} bits (flint {flint.__version__})"

    @classmethod
    def of(cls, problem: Problem, K: LinkMatrices, H: LinkMatrices) -> ByGramian | None:
        """With as many bits as it takes to see that A^k goes to 0; None where it is not seen, or chance has a say."""
        if not _may_be_alone(problem, H):
            return None
        for bits in _BITS:
            with ctx.workprec(bits):
                alone = Alone.of(BallModel(problem, K, H))
            found = None if alone is None else cls(alone, bits)
            if found is None or found.dies_out:
                return found
        return None

    @property
    def dies_out(self) -> bool:
        """Whether some power of A is proved to be below 1: then eta goes to 0, in every run."""
        return self._sum is not None

    def sign(self, gamma: float) -> Sign:
        """Of gamma^2 I - M G M': whether the exact gain is below gamma."""
        if self._sum is None:
            return UNDECIDED
        weighed, beyond = self._sum
        with ctx.workprec(self._bits):
            g = arb(gamma) ** 2
            eye = identity(weighed.nrows())
            sizes = diagonal(eye * g)
            below = sign(eye * (g - beyond) - weighed, sizes)
            if below.proved:
                return below
            above = sign(eye * g - weighed, sizes)
        return above._replace(proved=False)

    @cached_property
    def _sum(self) -> tuple[arb_mat, arb] | None:
        """M G_T M', and what is left out of it at most; None where A^k is not seen to go to 0."""
        A, B, M = self._alone
        with ctx.workprec(self._bits):
            found = Gramian.of(A, B)
            return None if found is None else (M * found.total * M.transpose(), square(M) * found.rest)


def _may_be_alone(problem: Problem, H: LinkMatrices) -> bool:
    """A look that costs nothing: whether measurements are ignored, or certain in a small network of one mode."""
    if not any(G.any() for of_mode in H.values() for row in of_mode.values() for G in row.values()):
        return True
    certain = ((problem.beta == 0.0) | (problem.beta == 1.0)).all() and not problem.links
    return bool(certain) and len(problem.topologies) == 1 and problem.n * problem.nx < _LARGEST


def _equal(one: arb_mat, other: arb_mat) -> bool:
    """Surely: both are numbers, not intervals."""
    return is_zero(one - other)
