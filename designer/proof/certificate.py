"""The certificate proved again, without a solver: mean-square stability, and gamma, for the numbers of the gains file.

Every inequality is proved for the exact matrices that the file's floats stand for, in ball arithmetic
(designer.proof.balls). Kind "lyapunov" is Theorem 1 (designer.proof.by_balls), kind "exact" the recursion of the exact
gain (designer.proof.recursion).
"""

from __future__ import annotations

import numpy as np

from agent.contract.arrays import Array
from agent.contract.errors import InputError, listed
from agent.contract.gains import Certificate, Gains
from agent.contract.problem import Problem
from designer.proof.findings import Verdict
from designer.proof.recursion import check_exact
from designer.proof.by_balls import check

MOST_STEPS = 1_000_000  # of a recursion that is proved; designs need fewer even where errors hardly decay


def verify(gains: Gains) -> Verdict:
    """Prove what the gains file claims, from everything as it stands in it. InputError: there is none to be read."""
    proved, P = gains.certificate, lyapunov_matrix(gains)
    if proved.kind == "lyapunov":
        return check(gains.problem, gains.K, gains.H, P=P, gamma=proved.gamma)
    if proved.horizon is None or proved.horizon < 1:
        raise InputError(f'certificate: horizon is {proved.horizon}; kind "exact" needs the number of its steps')
    if proved.horizon > MOST_STEPS:
        raise InputError(f"certificate: horizon is {proved.horizon}; a proof takes at most {MOST_STEPS} steps")
    return check_exact(gains.problem, gains.K, gains.H, P=P, gamma=proved.gamma, horizon=proved.horizon)


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
