"""The certificate proved again, without a solver: mean-square stability, and gamma, for the numbers of the gains file.

Every inequality is proved for the exact matrices that the file's floats stand for (designer.proof.prover). Kind
"lyapunov" is Theorem 1, kind "exact" the recursion of the exact gain, with Theorem 1 beside it where the file has it.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from agent.contract.arrays import Array
from agent.contract.errors import InputError, listed
from agent.contract.gains import Certificate, Gains
from agent.contract.problem import Problem
from designer.proof.findings import Verdict
from designer.proof.prover import BALLS, FLOATS, Make, Prover
from designer.proof.recursion import MOST_STEPS


def verify(gains: Gains, *, makes: Sequence[Make] = FLOATS + BALLS) -> Verdict:
    """Prove all that the gains file claims, from everything as it stands in it. InputError: there is none to be read.

    `makes`: in which arithmetic.
    """
    claim, most, prover = gains.certificate, gains.certificate.horizon, prover_of(gains, makes=makes)
    if most is not None and not 1 <= most <= MOST_STEPS:
        raise InputError(f"certificate: horizon is {most}; a proof takes from 1 to {MOST_STEPS} steps")
    if claim.kind == "lyapunov":
        return prover.theorem1(claim.gamma)
    verdict = _with_interval(claim, prover, prover.exact(claim.gamma, most=MOST_STEPS if most is None else most))
    return verdict if claim.theorem1_gamma is None else verdict.joined(prover.theorem1(claim.theorem1_gamma))


def _with_interval(claim: Certificate, prover: Prover, verdict: Verdict) -> Verdict:
    """That the exact gain is where the file says: proved of both ends, left open, or proved false of one."""
    if claim.exact is None or not verdict.holds:
        return verdict
    (low, high), why = claim.exact, None
    ends = high >= claim.gamma or prover.exact(high).holds
    if not ends and prover.at_least(high) is not None:
        why = f"the exact gain is not below {high}, where the file says it ends"
    elif low <= claim.gamma and (low <= 0.0 or prover.at_least(low) is not None):
        return verdict._replace(low=low) if ends else verdict
    elif low > claim.gamma or prover.exact(low).holds:
        why = f"the exact gain is below {low}, where the file says it begins"
    return verdict if why is None else verdict._replace(holds=False, failure=why, interval_is_false=True)


def prover_of(gains: Gains, *, makes: Sequence[Make] = FLOATS + BALLS) -> Prover:
    """For the gains as they are, and the P of their certificate; or its own where that stores none."""
    _refuse_other_matrices(gains.problem, gains.certificate)
    return Prover(gains.problem, gains.K, gains.H, P=stored_P(gains), makes=makes)


def stored_P(gains: Gains) -> Array | None:
    """`lyapunov_matrix`; None where the certificate stores none."""
    return None if gains.certificate.form == "summed" else lyapunov_matrix(gains)


def lyapunov_matrix(gains: Gains) -> Array:
    """P(s) over eta = [x; e_1; ...; e_n], or over e alone, as the certificate stores it, (modes, n_eta, n_eta)."""
    problem, certificate = gains.problem, gains.certificate
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
    modes, nodes = problem.mode_names, problem.node_names
    structured = ["Q", "R"] if problem.carries_plant else ["Q"]
    needed = {"structured": structured, "full": ["P"], "summed": []}[certificate.form]
    for letter, matrices in (("R", certificate.R), ("Q", certificate.Q), ("P", certificate.P)):
        if matrices is not None and letter not in needed:
            has = listed(needed) or "nothing stored"
            raise InputError(f'certificate: form "{certificate.form}" has {has} for these errors, and no {letter}')
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
