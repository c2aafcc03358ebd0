"""Factors of S that are none: what a library, or a mistake, may hand to a proof."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from agent.contract.arrays import Array

cholesky = np.linalg.cholesky
LIES: dict[str, Callable[[Array], Array]] = {
    "too large": lambda S: cholesky(S + 1.5 * np.eye(len(S))),
    "too small": lambda S: 1e-3 * cholesky(S + 1.5 * np.eye(len(S))),
    "nothing": np.zeros_like,
    "the diagonal": lambda S: np.diag(np.sqrt(S.diagonal() + 1.5)),
    "noise": lambda S: np.random.default_rng(0).normal(size=S.shape),
    "not a number": lambda S: np.full_like(S, np.nan),
    "infinite": lambda S: np.full_like(S, np.inf),
    "huge": lambda S: np.full_like(S, 1e200),
}
