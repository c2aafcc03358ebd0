"""Gains as one matrix for each mode, as numpy and MATLAB have them: K[mode] (n nx, n nx) and H[mode] (n nx, ny).

Nodes stand in the order of the problem: block (i, j) is K_ij, or H_ij, what node i does with what it hears from node j,
before the weight a_ij of (8); zero where i does not hear j. In a .npz file K and H are (modes, rows, columns), in
a .mat file (rows, columns, modes), as MATLAB counts, or a cell for each mode; in JSON a matrix for each mode, by name
or in order.
"""

from __future__ import annotations

from functools import partial
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from agent.contract.arrays import Array, read_only, shape_text
from agent.contract.errors import InputError, counted
from agent.contract.extras import needing
from agent.contract.files import read_bytes, writing_whole
from agent.contract.gains import Gains, LinkMatrices
from agent.contract.problem import Problem
from designer.model.error_model import measurement_slices, rows_total

SUFFIXES = (".npz", ".mat")


def load(path: Path, problem: Problem) -> tuple[LinkMatrices, LinkMatrices]:
    """K and H of a .npz or .mat file. Raises InputError: one sentence for what is not there, or does not fit."""
    data, is_mat = BytesIO(read_bytes(path, kind="gains file")), path.suffix == ".mat"
    read = _scipy_io().loadmat if is_mat else partial(np.load, allow_pickle=False)
    try:
        content: dict[str, Any] = dict(read(data))
    except NotImplementedError:
        raise InputError(f'{path} is in the format of MATLAB 7.3; write it with save(..., "-v7")') from None
    except Exception as error:  # what is no such file breaks its reader in many ways
        raise InputError(f"{path} could not be read as a {path.suffix} file: {error}") from None
    lacking = [letter for letter in ("K", "H") if letter not in content]
    if lacking:
        raise InputError(f"{path} has no {' and no '.join(lacking)}; it needs both, a matrix for each mode")
    try:
        return unstacked(problem, *(_by_mode(content[letter], path.suffix) for letter in ("K", "H")))
    except ValueError as error:
        raise InputError(f"{path} does not fit {problem.name}: {error}") from None


def _scipy_io() -> Any:
    with needing("a .mat file"):
        from scipy import io
    return io


def _by_mode(value: Any, suffix: str) -> list[Any]:
    """A matrix for each mode. MATLAB drops a last dimension of 1."""
    array = np.asarray(value)
    if array.dtype == object:  # a cell array
        return [np.asarray(cell) for cell in array.ravel()]
    if array.ndim == 2:
        return [array]
    return list(np.moveaxis(array, -1, 0) if suffix == ".mat" else array)


def unstacked(problem: Problem, K: Any, H: Any) -> tuple[LinkMatrices, LinkMatrices]:
    """Gains for every link from a list of matrices, one for each mode, or a table of them by the modes' names.

    Raises ValueError for what does not fit: what, where, what would be right.
    """
    nx = problem.nx
    blocks = [slice(j * nx, (j + 1) * nx) for j in range(problem.n)]
    columns = {"K": (problem.n * nx, blocks), "H": (rows_total(problem), measurement_slices(problem))}
    found = []
    for letter, given in (("K", K), ("H", H)):
        width, slices = columns[letter]
        matrices = _named(letter, given, problem)
        found.append(
            {
                mode: _links(f'{letter}: mode "{mode}"', matrix, problem, s, (problem.n * nx, width), slices)
                for s, (mode, matrix) in enumerate(matrices.items())
            }
        )
    return found[0], found[1]


def _named(letter: str, given: Any, problem: Problem) -> dict[str, Any]:
    """By the names of the modes, in their order."""
    names = problem.mode_names
    if isinstance(given, dict):
        if set(given) != set(names):
            raise ValueError(f"{letter} has {counted(len(given), 'mode')}, which are not those of the problem")
        return {name: given[name] for name in names}
    if not isinstance(given, list) or len(given) != len(names):
        number = counted(len(given), "mode") if isinstance(given, list) else "no list of modes"
        raise ValueError(f"{letter} has {number}; the problem has {counted(len(names), 'mode')}")
    return dict(zip(names, given, strict=True))


def _links(
    where: str, given: Any, problem: Problem, s: int, shape: tuple[int, int], columns: list[slice]
) -> dict[str, dict[str, Array]]:
    try:
        matrix = np.array(given)
    except ValueError:
        raise ValueError(f"{where} has rows of different lengths") from None
    if matrix.dtype.kind not in "iuf" or not np.isfinite(matrix).all():
        raise ValueError(f"{where} is no matrix of finite, real numbers")
    matrix = matrix.astype(np.float64)
    if matrix.shape != shape:
        size = f"{shape[0]} x {shape[1]}, a block for every two nodes in their order"
        raise ValueError(f"{where} is {shape_text(matrix) or 'a number'}; it must be {size}")
    nx, found = problem.nx, {}
    for i, receiver in enumerate(problem.node_names):
        rows, heard = slice(i * nx, (i + 1) * nx), problem.neighbours(s, i)
        for j in range(problem.n):
            if j not in heard and matrix[rows, columns[j]].any():
                sender = problem.node_names[j]
                raise ValueError(f'{where}: "{receiver}" does not hear "{sender}" in it, so that block must be 0')
        found[receiver] = {problem.node_names[j]: read_only(matrix[rows, columns[j]]) for j in heard}
    return found


def stacked(problem: Problem, of_K: LinkMatrices, of_H: LinkMatrices) -> tuple[Array, Array]:
    """K (modes, n nx, n nx) and H (modes, n nx, ny): the inverse of `unstacked`."""
    nx, columns = problem.nx, measurement_slices(problem)
    K = np.zeros((len(problem.topologies), problem.n * nx, problem.n * nx))
    H = np.zeros((len(problem.topologies), problem.n * nx, rows_total(problem)))
    for s, mode in enumerate(problem.mode_names):
        for i, receiver in enumerate(problem.node_names):
            for j in problem.neighbours(s, i):
                rows, sender = slice(i * nx, (i + 1) * nx), problem.node_names[j]
                K[s, rows, j * nx : (j + 1) * nx] = of_K[mode][receiver][sender]
                H[s, rows, columns[j]] = of_H[mode][receiver][sender]
    return K, H


def save(gains: Gains, path: Path, *, to: str, force: bool) -> dict[str, Any]:
    """Write K, H and the names, as "npz" or "mat"; returns what to print."""
    problem, (K, H) = gains.problem, stacked(gains.problem, gains.K, gains.H)
    matlab = _scipy_io() if to == "mat" else None
    with writing_whole(path, force=force) as part, part.open("wb") as file:
        if matlab is None:
            np.savez(file, K=K, H=H, node_names=np.array(problem.node_names), mode_names=np.array(problem.mode_names))
        else:
            cells = {"node_names": [problem.node_names], "mode_names": [problem.mode_names]}
            names = {key: np.array(value, dtype=object) for key, value in cells.items()}
            matlab.savemat(file, {"K": np.moveaxis(K, 0, -1), "H": np.moveaxis(H, 0, -1), **names})
    return {"problem": problem.name, "modes": len(K), "K": K.shape[1:], "H": H.shape[1:], "output": str(path)}
