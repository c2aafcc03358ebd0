"""Whether a part of the plant grows that measurements never show, or too rarely: exactly, from floats as they are."""

from __future__ import annotations

from collections.abc import Sequence
from math import prod

from flint import acb_mat, arb, arb_mat, ctx, fmpq, fmpq_mat

from agent.contract.arrays import Array

_BITS = 256


def grows_unseen(A: Array, C: Array, lost: Sequence[float] = ()) -> bool | None:
    """Whether chance |lambda|^2 >= 1 for an eigenvalue of A on the subspace that C does not show; None: not decided.

    chance is that nothing arrives of what arrives with these probabilities, the product of all 1 - p.

    A (nx, nx), C (rows, nx) with any number of rows. The subspace, all v with C A^k v = 0 for every k, is rational, and
    so is A on it; its eigenvalues are enclosed in balls. Where they lie on the border, +1 and -1 are looked at exactly.
    """
    exact = _rational(A)
    hidden = _kernel(_rational(C), exact)
    if hidden is None:
        return False
    on_it = (hidden.transpose() * hidden).inv() * (hidden.transpose() * exact * hidden)
    size = on_it.nrows()
    if not any(lost) and any(_is_eigenvalue(on_it, root) for root in (1, -1)):
        return True
    with ctx.workprec(_BITS):
        try:
            values = acb_mat(arb_mat(on_it)).eig(multiple=True)
        except ValueError:
            return None
        chance = prod((1 - arb(p) for p in lost), start=arb(1))
        sizes = [chance * abs(value) ** 2 for value in values]
        if any(size >= 1 for size in sizes):
            return True
        return False if len(values) == size and all(size < 1 for size in sizes) else None


def volume_grows(A: Array, beta: float, rows: int) -> bool | None:
    """Whether (1 - beta)^rows |det A_u|^2 >= 1, A_u of the eigenvalues of A with |lambda| > 1; None: not decided."""
    with ctx.workprec(_BITS):
        try:
            values = acb_mat(arb_mat(_rational(A))).eig(multiple=True)
        except ValueError:
            return None
        least = most = (1 - arb(beta)) ** rows
        for size in (abs(value) ** 2 for value in values):
            if not size < 1:
                most = most * size.max(arb(1))
                least = least * size if size >= 1 else least
        if least >= 1:
            return True
        return False if len(values) == len(A) and most < 1 else None


def _rational(matrix: Array) -> fmpq_mat:
    entries = [fmpq(*float(entry).as_integer_ratio()) for entry in matrix.reshape(-1)]
    return fmpq_mat(matrix.shape[0], matrix.shape[1], entries)


def _kernel(C: fmpq_mat, A: fmpq_mat) -> fmpq_mat | None:
    """A basis, in columns, of all v with C A^k v = 0, k < nx; None where there is only 0."""
    nx = A.nrows()
    rows: list[list[fmpq]] = []
    block = C
    for _ in range(nx):
        rows += [[block[i, j] for j in range(nx)] for i in range(block.nrows())]
        block = block * A
    if not rows:
        return fmpq_mat(nx, nx, [fmpq(int(i == j)) for i in range(nx) for j in range(nx)])
    reduced, rank = fmpq_mat(len(rows), nx, [entry for row in rows for entry in row]).rref()
    if rank == nx:
        return None
    pivots = [next(j for j in range(nx) if reduced[i, j] != 0) for i in range(rank)]
    free = [j for j in range(nx) if j not in pivots]
    basis = fmpq_mat(nx, len(free))
    for k, j in enumerate(free):
        basis[j, k] = fmpq(1)
        for i, pivot in enumerate(pivots):
            basis[pivot, k] = -reduced[i, j]
    return basis


def _is_eigenvalue(matrix: fmpq_mat, root: int) -> bool:
    size = matrix.nrows()
    shift = fmpq_mat(size, size, [fmpq(root * int(i == j)) for i in range(size) for j in range(size)])
    return bool((matrix - shift).det() == 0)
