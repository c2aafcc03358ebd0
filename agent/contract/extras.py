"""What `pip install peakmesh` leaves out, and which extra of pyproject.toml brings it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from agent.contract.errors import InputError

EXTRAS = {
    "clarabel": "design",
    "cvxpy": "design",
    "distributed": "dask",
    "foxglove": "foxglove",
    "matplotlib": "design",
    "pyarrow": "parquet",
    "rich": "design",
    "scipy": "design",
}


@contextmanager
def needing(what: str) -> Iterator[None]:
    """An import that fails for want of an extra becomes an InputError that says how `what` gets it."""
    try:
        yield
    except ModuleNotFoundError as error:
        if error.name not in EXTRAS:
            raise
        raise InputError(f"{what} needs {error.name}: pip install 'peakmesh[{EXTRAS[error.name]}]'") from error
