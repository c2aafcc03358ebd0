"""peakmesh as a library: what the commands do, as functions, and their results as objects.

    import peakmesh

    gains = peakmesh.design("two-nodes")
    print(peakmesh.run(gains, "run.mcap", steps=100).replay().text())

Importing it loads nothing else; each name is fetched when it is first used. `docs/library.md` shows them all.

The two packages behind it are called `agent` and `designer`, as somebody's own file may be, too. Such a file beside a
script or a notebook is no harm: from the first use on these names are ours in this process. Who has imported one of
their own before is told so.
"""

from __future__ import annotations

import sys
from importlib import import_module, util
from importlib.machinery import PathFinder
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from agent.contract.errors import InputError, PeakmeshError, RunBroken, Unattainable
    from agent.contract.gains import Gains
    from agent.contract.problem import Problem
    from peakmesh.answers import analyse, design, figures, find, load, replay, simulate, verify
    from peakmesh.mesh import Mesh
    from peakmesh.running import Run, run

__all__ = [
    "Gains",
    "InputError",
    "Mesh",
    "PeakmeshError",
    "Problem",
    "Run",
    "RunBroken",
    "Unattainable",
    "analyse",
    "design",
    "figures",
    "find",
    "load",
    "replay",
    "run",
    "simulate",
    "verify",
]

_WHERE = {
    "agent.contract.errors": ("InputError", "PeakmeshError", "RunBroken", "Unattainable"),
    "agent.contract.gains": ("Gains",),
    "agent.contract.problem": ("Problem",),
    "peakmesh.answers": ("analyse", "design", "figures", "find", "load", "replay", "simulate", "verify"),
    "peakmesh.mesh": ("Mesh",),
    "peakmesh.running": ("Run", "run"),
}
_MODULES = {name: module for module, names in _WHERE.items() for name in names}


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module 'peakmesh' has no attribute {name!r}; it has {', '.join(__all__)}")
    claim()
    found = globals()[name] = getattr(import_module(_MODULES[name]), name)
    return found


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})


def claim() -> None:
    """Have `agent` and `designer` be ours, whatever stands in the current folder. Raises ImportError: they are not."""
    here = Path(__file__).resolve()
    home = next(folder for folder in here.parents if (folder / "agent" / "contract").is_dir())
    for name in ("agent", "designer"):
        module = sys.modules.get(name)
        if module is None:
            spec = PathFinder.find_spec(name, [str(home)])
            assert spec is not None
            assert spec.loader is not None
            module = sys.modules[name] = util.module_from_spec(spec)
            spec.loader.exec_module(module)
        elif Path(str(module.__file__)).resolve().parent != home / name:
            raise ImportError(
                f"{module.__file__} has been imported as {name!r}, which is the name of a package of peakmesh; import "
                "peakmesh and use it first, or rename that file"
            )
