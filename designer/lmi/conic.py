"""Two conic solvers for `cones.Cones`, each with its answer in the same words. The only imports of both are here."""

from __future__ import annotations

import importlib.util
import time
from collections.abc import Callable
from importlib.metadata import version
from typing import Any, NamedTuple

import numpy as np
import scipy.sparse

from agent.contract.arrays import Array
from agent.contract.gains import Solver
from designer.lmi.cones import Cones
from designer.patience import look

_WORDS = {  # cvxpy's words, so that a gains file says the same whichever way the solver was called
    "Solved": "optimal",
    "AlmostSolved": "optimal_inaccurate",
    "PrimalInfeasible": "infeasible",
    "AlmostPrimalInfeasible": "infeasible_inaccurate",
    "solved": "optimal",
    "solved (inaccurate - reached max_iters)": "optimal_inaccurate",
    "infeasible": "infeasible",
}
_CLARABEL: dict[str, Any] = {
    "verbose": False,
    "tol_feas": 1e-9,  # a tenth of the default, for one or two iterations: what is missing must be made up in gamma
    "chordal_decomposition_enable": False,  # decomposed.py has split the large matrix already
}
_SMALL = 20  # up to this order of the cones QDLDL takes 10 to 20 % less time than what Clarabel chooses by itself
_SCS: dict[str, Any] = {"verbose": False, "eps_abs": 1e-7, "eps_rel": 1e-7, "max_iters": 50_000}


class Answer(NamedTuple):
    """What a solver says: the unknowns, and the record for the gains file."""

    u: Array
    record: Solver
    z: Array | None = None  # the multipliers of the cones, likewise their upper triangles; Clarabel's alone


def clarabel(cones: Cones, q: Array) -> Answer:
    """Clarabel's interior point method."""
    import clarabel as package

    settings = package.DefaultSettings()
    for name, value in _CLARABEL.items():
        setattr(settings, name, value)
    if max(cones.orders) <= _SMALL:
        settings.direct_solve_method = "qdldl"
    parts = [package.PSDTriangleConeT(order) for order in cones.orders]
    none = scipy.sparse.csc_matrix((len(q), len(q)))
    started, heard = time.perf_counter(), Heard()
    try:
        solver = package.DefaultSolver(none, q, cones.A, cones.b, parts, settings)
        solver.set_termination_callback(heard)
        found = solver.solve()
    except BaseException as error:
        seconds = time.perf_counter() - started
        return Answer(np.zeros(len(q)), _record("CLARABEL", failure(error), 0, (np.inf, np.inf), seconds))
    heard.raise_again()
    seconds = time.perf_counter() - started
    status = _WORDS.get(str(found.status), f"failed: {found.status}")
    return Answer(
        np.array(found.x),
        _record("CLARABEL", status, int(found.iterations), (float(found.r_prim), float(found.r_dual)), seconds),
        np.array(found.z),
    )


class Heard:
    """Looks whether it is to end at every iteration of a solver, through which nothing can be raised."""

    def __init__(self) -> None:
        self._why: BaseException | None = None

    def __call__(self, info: Any) -> bool:
        """Whether to end."""
        try:
            look()
        except BaseException as why:
            self._why = why
        return self._why is not None

    def raise_again(self) -> None:
        """After the solver has ended."""
        if self._why is not None:
            raise self._why


def scs(cones: Cones, q: Array) -> Answer:
    """SCS, a first-order method: slower and less exact, but not stopped by what stops an interior point method."""
    import scs as package

    order = np.concatenate([first + _by_rows(size) for first, size in _pieces(cones.orders)])
    data = {"A": scipy.sparse.csc_matrix(cones.A.tocsr()[order]), "b": cones.b[order], "c": q}
    started = time.perf_counter()
    found = package.SCS(data, {"s": cones.orders}, **_SCS).solve()
    seconds = time.perf_counter() - started
    info = found["info"]
    status = _WORDS.get(info["status"], f"failed: {info['status']}")
    residuals = float(info["res_pri"]), float(info["res_dual"])
    return Answer(np.asarray(found["x"]), _record("SCS", status, int(info["iter"]), residuals, seconds))


def failure(error: BaseException) -> str:
    """The status for what a solver raised; KeyboardInterrupt and its like are raised again.

    A panic of Clarabel, which is written in Rust, reaches Python as an exception that is no Exception.
    """
    if not isinstance(error, Exception) and type(error).__name__ != "PanicException":
        raise error
    words = str(error).strip() or type(error).__name__
    return f"failed: {words.splitlines()[0]}"


def installed(solve: Callable[[Cones, Array], Answer]) -> bool:
    """Whether the solver behind `clarabel` or `scs` is installed."""
    return importlib.util.find_spec(solve.__name__) is not None


def _record(name: str, status: str, iterations: int, residuals: tuple[float, float], seconds: float) -> Solver:
    finite = residuals if np.isfinite(residuals).all() else None
    return Solver(
        name=name,
        version=version(name.lower()),
        status=status,
        iterations=iterations,
        residuals=finite,
        seconds=seconds,
    )


def _pieces(orders: list[int]) -> list[tuple[int, int]]:
    """Where the triangle of each matrix begins, and its order."""
    firsts = np.cumsum([0, *(order * (order + 1) // 2 for order in orders)])
    return [(int(first), order) for first, order in zip(firsts, orders, strict=False)]


def _by_rows(order: int) -> Any:
    """SCS takes the lower triangle column by column, which is the upper one row by row."""
    rows, columns = np.triu_indices(order)
    return rows + columns * (columns + 1) // 2
