"""The certificate proved again, without a solver: mean-square stability, and gamma, for the numbers of the gains file.

Every inequality is proved for the exact matrices that the file's floats stand for, in ball arithmetic
(designer.proof.balls). This module proves Theorem 1 of Zhu et al. 2020, certificates of kind "lyapunov":
(17) and (18) in every mode, with P as stored. Kind "exact" is in designer.proof.recursion.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import flint
import numpy as np
from flint import arb, arb_mat, ctx

from agent.contract.arrays import Array
from agent.contract.errors import InputError, listed
from agent.contract.gains import Certificate, Gains, LinkMatrices
from agent.contract.problem import Problem
from designer.proof.ball_model import BallModel
from designer.proof.balls import Sign, blocks, diagonal, exact, of_blocks, part, sign

BITS = (128, 256, 512, 1024)  # carried one after the other, until every inequality is proved or one proved false
MOST_STEPS = 1_000_000  # of a recursion that is proved; designs need fewer even where errors hardly decay


class Verdict(NamedTuple):
    """Whether the certificate is proved; where it is not, the inequality that fails, and by how much."""

    holds: bool
    gamma: float
    arithmetic: str
    failure: str | None
    margins: dict[str, float]  # of each inequality and mode: the least eigenvalue after scaling; not proved: <= 0


class Finding(NamedTuple):
    """One inequality, looked at."""

    inequality: str
    mode: str
    sign: Sign
    at: str = ""  # more about where

    @property
    def name(self) -> str:
        return f"{self.inequality} mode {self.mode}"


def verify(gains: Gains) -> Verdict:
    """Prove what the gains file claims, from everything as it stands in it. InputError: there is none to be read."""
    proved, P = gains.certificate, lyapunov_matrix(gains)
    if proved.kind == "lyapunov":
        return check(gains.problem, gains.K, gains.H, P=P, gamma=proved.gamma)
    from designer.proof.recursion import check_exact  # it is built on this module

    if proved.horizon is None or proved.horizon < 1:
        raise InputError(f'certificate: horizon is {proved.horizon}; kind "exact" needs the number of its steps')
    if proved.horizon > MOST_STEPS:
        raise InputError(f"certificate: horizon is {proved.horizon}; a proof takes at most {MOST_STEPS} steps")
    return check_exact(gains.problem, gains.K, gains.H, P=P, gamma=proved.gamma, horizon=proved.horizon)


def check(problem: Problem, K: LinkMatrices, H: LinkMatrices, *, P: Array, gamma: float) -> Verdict:
    """Theorem 1 for the gains of (5), P (modes, n_eta, n_eta) and gamma."""

    def findings() -> list[Finding]:
        model, modes = BallModel(problem, K, H), problem.mode_names
        return inequality_17(model, modes, P) + _inequality_18(model, modes, P, gamma)

    return decided(findings, gamma)


def inequality_17(model: BallModel, modes: tuple[str, ...], P: Array) -> list[Finding]:
    """diag{P(s), I} - [A B]'P_bar[A B] - noise > 0: minus the matrix of (17)."""
    weighed = np.tile(np.eye(model.size + model.nw), (len(modes), 1, 1))
    weighed[:, : model.size, : model.size] = P
    found = []
    for mode, S, whole in zip(modes, model.joint(symmetric(P), _blocks(model, P)), symmetric(weighed), strict=True):
        found.append(Finding("(17)", mode, sign(whole - S, diagonal(whole))))
    return found


def _inequality_18(model: BallModel, modes: tuple[str, ...], P: Array, gamma: float) -> list[Finding]:
    """P(s) - M'M / gamma^2 > 0: (18), by the Schur complement; (32)."""
    MM = model.MM * (1 / arb(gamma) ** 2)
    found, blocks_of_P = [], _blocks(model, P)
    for mode, P_s in zip(modes, symmetric(P), strict=True):
        S, sizes = P_s - MM, diagonal(P_s)
        signs = [sign(part(S, block, block), sizes[block]) for block in blocks_of_P]
        found.append(Finding("(18)", mode, of_blocks(signs)))
    return found


def _blocks(model: BallModel, P: Array) -> list[list[int]]:
    """The blocks of P(s), the same for every mode; the states of a node, which M'M may join, stay together."""
    joined = (P != 0.0).any(axis=0)
    for e_i in model.e:
        joined[np.ix_(e_i, e_i)] = True
    return blocks(joined)


def symmetric(P: Array) -> list[arb_mat]:
    """(P + P')/2 of every mode, as x'Px sees P."""
    return [exact(P_s) if (P_s == P_s.T).all() else (exact(P_s) + exact(P_s.T)) * arb(0.5) for P_s in P]


def decided(findings: Callable[[], list[Finding]], gamma: float) -> Verdict:
    """The verdict on all findings, with as many bits as it takes; what is proved false is named first."""
    for bits in BITS:
        with ctx.workprec(bits):
            found = findings()
        failed = [finding for finding in found if not finding.sign.proved]
        false = [finding for finding in failed if finding.sign.refuted]
        if false or not failed:
            break
    margins: dict[str, float] = {}
    for finding in found:
        least = finding.sign.least if finding.sign.proved else min(finding.sign.least, 0.0)
        margins[finding.name] = min(least, margins.get(finding.name, least))
    failure = _text((false or failed)[0], bits) if failed else None
    return Verdict(
        failure is None, gamma, f"ball arithmetic of {bits} bits (flint {flint.__version__})", failure, margins
    )


def _text(failed: Finding, bits: int) -> str:
    where, least = f'{failed.inequality} fails in mode "{failed.mode}"{failed.at}', f"{failed.sign.least:.3g}"
    if failed.sign.refuted:
        return f"{where}: it is false, its least scaled eigenvalue is {least} and must be positive"
    return f"{where}: it is not proved, its least scaled eigenvalue is about {least}, which {bits} bits leave open"


def lyapunov_matrix(gains: Gains) -> Array:
    """P(s) over eta = [x; e_1; ...; e_n], or over e alone, from the stored certificate, (modes, n_eta, n_eta)."""
    problem, certificate = gains.problem, gains.certificate
    _refuse_other_matrices(problem, certificate)
    nx, p = problem.nx, problem.plant_states
    n_eta = p + problem.n * nx
    P = np.zeros((len(problem.mode_names), n_eta, n_eta))
    for s, mode in enumerate(problem.mode_names):
        if certificate.form == "full":
            P[s] = _stored(certificate.P, mode, f'P of mode "{mode}"', n_eta)
            continue
        if p:
            P[s, :nx, :nx] = _stored({"R": certificate.R} if certificate.R is not None else None, "R", "R", nx)
        for i, node in enumerate(problem.node_names):
            rows = slice(p + i * nx, p + (i + 1) * nx)
            P[s, rows, rows] = _stored((certificate.Q or {}).get(mode), node, f'Q of mode "{mode}", node "{node}",', nx)
    return P


def _refuse_other_matrices(problem: Problem, certificate: Certificate) -> None:
    """A matrix that the proof would not use is refused: whoever wrote it meant something by it."""
    modes, nodes, needed = problem.mode_names, problem.node_names, {"P"}
    if certificate.form == "structured":
        needed = {"R", "Q"} if problem.carries_plant else {"Q"}
    for letter, matrices in (("R", certificate.R), ("Q", certificate.Q), ("P", certificate.P)):
        if matrices is not None and letter not in needed:
            raise InputError(
                f'certificate: form "{certificate.form}" has {listed(sorted(needed))} for these errors, and no {letter}'
            )
    parts = [("P", "mode", certificate.P, modes), ("Q", "mode", certificate.Q, modes)]
    parts += [(f"Q of mode {mode}", "node", of_mode, nodes) for mode, of_mode in (certificate.Q or {}).items()]
    for what, kind, matrices, names in parts:
        for name in matrices or ():
            if name not in names:
                raise InputError(f'certificate: {what}: {kind} "{name}" does not exist; there are {listed(names)}')


def _stored(matrices: dict[str, Array] | None, name: str, what: str, size: int) -> Array:
    if matrices is None or name not in matrices:
        raise InputError(f"certificate: {what} is missing; it must be {size} x {size}")
    if matrices[name].shape != (size, size):
        rows, columns = matrices[name].shape
        raise InputError(f"certificate: {what} is {rows} x {columns}; it must be {size} x {size}")
    return matrices[name]
