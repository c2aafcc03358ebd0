"""Who may import whom, held against the code, and against what processes really load."""

from __future__ import annotations

import ast
import json
import subprocess
import sys
from collections.abc import Iterator
from functools import cache

import pytest
from places import ROOT

# The house: every room, and the rooms that it may import from. A room is a folder, or a module outside any folder; the
# longest name that fits is a module's room. It stands below what it imports, so there is no circle. What both packages
# share, agent.contract, is open to all; of the runtime nothing else is open to the designer, but for the command line.
OPEN = "agent.contract"
ROOMS = {
    # the runtime
    "agent.contract": "",
    "agent.contract.recording": "",
    "agent.plan": "",
    "agent.faults": "",
    "agent.product": "",
    "agent.filter": "agent.product",
    "agent.inbox": "agent.filter",
    "agent.guard": "agent.plan",
    "agent.refusals": "agent.guard",
    "agent.estimates": "agent.filter agent.product",
    "agent.embed": "agent.contract.recording agent.filter agent.product",
    "agent.pacing": "agent.estimates agent.filter agent.inbox agent.plan",
    "agent.receipts": "",
    "agent.signals": "",
    "agent.network": "agent.guard agent.plan agent.signals",
    "agent.authority": "agent.network",
    "agent.roles": "agent.contract.recording agent.estimates agent.faults agent.filter agent.guard agent.inbox "
    "agent.network agent.pacing agent.plan agent.product agent.receipts agent.refusals agent.signals",
    "agent.children": "",
    "agent.guests": "",
    "agent.launch": "agent.children agent.contract.recording agent.guests agent.plan agent.signals",
    "agent.conform": "agent.estimates agent.filter agent.guard agent.guests agent.network agent.roles agent.signals",
    "agent.doctor": "agent.children agent.network agent.roles",
    "agent.commands": "agent.authority agent.contract.recording agent.doctor agent.faults agent.guard agent.guests "
    "agent.launch agent.network agent.plan agent.roles",
    "agent.within": "agent.filter agent.network agent.roles",
    "agent.cli": "agent.commands",
    "agent.__main__": "agent.cli",
    "agent.nursery": "agent.children agent.cli agent.network agent.roles",
    # the mathematics
    "designer.patience": "",
    "designer.coordinates": "",
    "designer.decay": "",
    "designer.steered": "",
    "designer.invariants": "designer.decay designer.steered",
    "designer.model": "designer.coordinates",
    "designer.gain": "designer.coordinates designer.decay designer.invariants designer.model "
    "designer.patience designer.steered",
    "designer.proof": "designer.coordinates designer.decay designer.invariants designer.patience designer.steered",
    "designer.lmi": "designer.gain designer.model designer.patience designer.proof",
    "designer.workers": "designer.patience",
    "designer.search": "designer.coordinates designer.decay designer.gain designer.invariants designer.lmi "
    "designer.model designer.patience designer.proof designer.workers",
    "designer.problems": "",
    "designer.diagnosis": "designer.model designer.proof",
    "designer.ladder": "designer.lmi",
    "designer.single_run": "designer.coordinates designer.gain designer.model designer.proof",
    "designer.start": "designer.coordinates designer.gain designer.ladder designer.model designer.proof "
    "designer.single_run",
    "designer.beyond_gamma": "designer.gain designer.model designer.start",
    "designer.undercut": "designer.coordinates designer.lmi designer.model designer.patience designer.proof "
    "designer.search",
    "designer.box": "designer.coordinates designer.decay designer.gain designer.invariants designer.ladder "
    "designer.model designer.patience designer.proof designer.search",
    "designer.synthesis": "designer.box designer.coordinates designer.diagnosis designer.gain designer.lmi "
    "designer.model designer.patience designer.proof designer.search designer.undercut",
    "designer.stacked": "designer.model",
    "designer.analysis": "designer.beyond_gamma designer.box designer.diagnosis designer.gain designer.invariants "
    "designer.ladder designer.lmi designer.model designer.proof designer.search designer.stacked designer.undercut",
    "designer.ranking": "designer.analysis designer.box designer.gain designer.ladder designer.model designer.search "
    "designer.synthesis",
    "designer.conformity": "designer.model designer.problems designer.search",
    "designer.what_if": "designer.gain designer.ladder designer.lmi designer.model designer.proof designer.search "
    "designer.synthesis designer.workers",
    "designer.sweep": "designer.ladder designer.problems designer.search designer.synthesis designer.workers",
    "designer.reproduce": "designer.gain designer.ladder designer.lmi designer.model designer.problems designer.search "
    "designer.synthesis designer.undercut",
    "designer.simulation": "designer.gain designer.model designer.start designer.workers",
    "designer.ledger": "designer.coordinates designer.gain designer.model designer.proof",
    "designer.chance": "designer.single_run designer.start",
    "designer.replay": "agent.contract.recording designer.chance designer.ledger designer.model designer.proof "
    "designer.start",
    "designer.identify": "designer.box designer.gain designer.model designer.replay",
    "designer.report": "designer.beyond_gamma designer.chance designer.ladder designer.model designer.proof "
    "designer.replay",
    "designer.compare": "agent.contract.recording",
    "designer.export": "designer.model designer.replay",
    "designer.watch": "designer.ledger",
    "designer.show": "agent.contract.recording designer.problems",
    "designer.commands": "agent.commands agent.conform agent.contract.recording agent.embed agent.guests "
    "agent.signals designer.analysis designer.beyond_gamma designer.box designer.compare designer.conformity "
    "designer.diagnosis designer.export designer.gain designer.identify designer.ladder designer.patience "
    "designer.problems designer.proof designer.ranking designer.replay designer.report designer.reproduce "
    "designer.search designer.show designer.simulation designer.stacked designer.sweep designer.synthesis "
    "designer.watch designer.what_if",
    "designer.cli": "agent.cli agent.commands designer.commands",
    "designer.__main__": "designer.cli",
    # the library, whose source stands in designer/library/
    "peakmesh.answers": "designer.analysis designer.box designer.problems designer.proof designer.replay "
    "designer.report designer.search designer.simulation designer.synthesis",
    "peakmesh.sensors": "",
    "peakmesh.functions": "agent.within peakmesh.sensors",
    "peakmesh.running": "agent.commands agent.contract.recording agent.guests agent.launch agent.plan designer.replay "
    "peakmesh.answers peakmesh.functions peakmesh.sensors",
    "peakmesh.mesh": "designer.replay peakmesh.answers peakmesh.functions peakmesh.running peakmesh.sensors",
    "peakmesh": "peakmesh.answers peakmesh.mesh peakmesh.running",
    "peakmesh.background": "agent.commands peakmesh peakmesh.running",
    "peakmesh.testing": "peakmesh peakmesh.mesh",
}
LIBRARY = "designer/library/"  # what is in it is imported without that, so that no other folder's modules are

# Each outside thing behind as few doors as can be.
DOORS = {
    "zenoh": ["agent/network/session.py", "designer/library/peakmesh/sensors.py"],
    "cryptography": ["agent/authority.py"],
    "foxglove": ["agent/roles/viewer.py"],
    "mcap": ["agent/contract/recording/"],
    "zstandard": ["agent/contract/recording/"],
    "lz4": ["agent/contract/recording/"],
    "cvxpy": ["designer/lmi/"],
    "clarabel": ["designer/lmi/"],
    "scipy": [
        "designer/decay.py",
        "designer/lmi/",
        "designer/gain/products.py",
        "designer/proof/sparse.py",
        "designer/identify/fit.py",
        "designer/export/matlab.py",
        "designer/stacked.py",
    ],
    "pyarrow": ["designer/export/tables.py"],
    "flint": ["designer/proof/"],
    "matplotlib": ["designer/report/", "designer/library/peakmesh/answers.py"],  # there for the type checker
    "setproctitle": ["agent/nursery.py"],
    "shtab": ["designer/commands/program.py"],
    "rich": ["agent/commands/words.py", "designer/commands/", "designer/watch/table.py"],
    "distributed": ["designer/workers.py"],
}

# These know no clock, no chance, no other thread; nor, by the table above, a network.
PURE = [
    "agent/estimates.py",
    "agent/faults.py",
    "agent/filter.py",
    "agent/inbox.py",
    "agent/pacing/",
    "agent/product.py",
    "agent/receipts.py",
]
IMPURE = [
    "time",
    "datetime",
    "random",
    "secrets",
    "socket",
    "threading",
    "asyncio",
    "os",
    "subprocess",
    "agent.network",
]

# Command lines answer at once: before a command is called they import the standard library and these alone.
LAZY = [
    "agent/cli.py", "agent/commands/", "agent/__main__.py", "designer/cli.py", "designer/commands/",
    "designer/__main__.py", "designer/library/peakmesh/__init__.py",
]  # fmt: skip
LIGHT = [
    "agent.cli", "agent.commands", "agent.plan", "agent.signals", "agent.contract.errors", "agent.contract.extras",
    "agent.contract.files",
    "designer.cli", "designer.commands", "designer.patience",
]  # fmt: skip


def sources() -> dict[str, str]:
    """Every module of both packages, by its path."""
    files = [path for package in ("agent", "designer") for path in (ROOT / package).rglob("*.py")]
    return {path.relative_to(ROOT).as_posix(): path.read_text() for path in files}


def imported(tree: ast.AST) -> Iterator[str]:
    """Full dotted names; a relative import begins with a dot."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            module = "." * node.level + (node.module or "")
            yield from (f"{module}.{alias.name}" for alias in node.names)


def imported_at_once(tree: ast.Module) -> Iterator[str]:
    """Without what waits in functions, or is for the type checker alone."""
    for statement in tree.body:
        for_types = isinstance(statement, ast.If) and ast.unparse(statement.test) == "TYPE_CHECKING"
        if not isinstance(statement, ast.FunctionDef) and not for_types:
            yield from imported(statement)


def begins(name: str, prefix: str) -> bool:
    return name == prefix or name.startswith(prefix + ".")


def within(path: str, places: list[str]) -> bool:
    return any(path == place or (place.endswith("/") and path.startswith(place)) for place in places)


def room_of(name: str) -> str | None:
    """The room that a module, or what is in it, stands in; None for what is not of peakmesh."""
    return max((room for room in ROOMS if begins(name, room)), key=len, default=None)


def module_of(path: str) -> str:
    return path.removeprefix(LIBRARY).removesuffix(".py").removesuffix("/__init__").replace("/", ".")


def forbidden(path: str, name: str) -> bool:
    """Whether the tables do not let the module at `path` import `name`."""
    here, there = room_of(module_of(path)), room_of(name)
    if name.startswith("."):
        return True
    if there is not None and there != here and there != OPEN and there not in ROOMS[here or OPEN].split():
        return True
    if any(begins(name, thing) and not within(path, doors) for thing, doors in DOORS.items()):
        return True
    return within(path, PURE) and any(begins(name, impure) for impure in IMPURE)


def violations(files: dict[str, str]) -> list[str]:
    """Every import that the tables forbid, as "file: module"."""
    return [found for path, source in files.items() for found in violations_in(path, source)]


@cache  # every planted import meets all the other files again
def violations_in(path: str, source: str) -> list[str]:
    tree = ast.parse(source)
    found = [f"{path}: {name}" for name in imported(tree) if forbidden(path, name)]
    if within(path, LAZY):
        for name in imported_at_once(tree):
            standard = name.split(".")[0] in sys.stdlib_module_names
            if not standard and not any(begins(name, light) for light in LIGHT):
                found.append(f"{path}: {name} at once")
    return found


def test_the_code_keeps_to_the_table() -> None:
    assert violations(sources()) == []


def test_every_module_has_a_room_and_every_room_is_used() -> None:
    """Rooms are all there, every permission is made use of, and the packages themselves import nothing."""
    files = sources()
    rooms = {path: room_of(module_of(path)) for path in files}
    assert [path for path, room in rooms.items() if room is None] == ["agent/__init__.py", "designer/__init__.py"]
    assert not any(list(imported(ast.parse(files[path]))) for path, room in rooms.items() if room is None)
    used = {
        (here, there)
        for path, here in rooms.items()
        for name in imported(ast.parse(files[path]))
        if (there := room_of(name)) not in (None, OPEN, here)
    }
    assert used == {(here, there) for here, rest in ROOMS.items() for there in rest.split()}


def test_no_room_imports_from_one_below_it() -> None:
    """So that there is no circle."""
    above = list(ROOMS)
    for here, rest in ROOMS.items():
        assert [there for there in rest.split() if above.index(there) >= above.index(here)] == [], here


def test_every_door_exists() -> None:
    files = sources()
    for place in [*(door for doors in DOORS.values() for door in doors), *PURE, *LAZY]:
        assert any(within(path, [place]) for path in files), place


@pytest.mark.parametrize(
    ("path", "line", "found"),
    [
        ("agent/roles/node.py", "import designer.model.error_model", "designer.model.error_model"),
        ("agent/launch.py", "from designer import synthesis", "designer.synthesis"),
        ("agent/roles/plant.py", "import zenoh", "zenoh"),
        ("agent/network/bus.py", "import zenoh", "zenoh"),
        ("agent/roles/plant.py", "def f():\n    import zenoh", "zenoh"),
        ("agent/roles/recorder.py", "from mcap.writer import Writer", "mcap.writer.Writer"),
        ("agent/contract/recording/reader.py", "from scipy import linalg", "scipy.linalg"),
        ("agent/contract/gains.py", "from agent.filter import Pair", "agent.filter.Pair"),
        ("agent/contract/gains.py", "import agent.contract.recording", "agent.contract.recording"),
        ("agent/contract/gains.py", "from agent import plan", "agent.plan"),
        ("agent/contract/gains.py", "from ..filter import Pair", "..filter.Pair"),
        ("agent/filter.py", "import random", "random"),
        ("agent/inbox.py", "from time import monotonic", "time.monotonic"),
        ("agent/receipts.py", "import threading", "threading"),
        ("designer/proof/by_balls.py", "import cvxpy as cp", "cvxpy"),
        ("designer/synthesis.py", "try:\n    import clarabel\nexcept ImportError:\n    pass", "clarabel"),
        ("designer/replay/proofs.py", "from agent.filter import step", "agent.filter.step"),
        ("designer/replay/__init__.py", "from agent import filter", "agent.filter"),
        ("designer/replay/__init__.py", "import agent.inbox", "agent.inbox"),
        ("designer/show.py", "import agent.cli", "agent.cli"),
        ("designer/model/units.py", "from designer import gain", "designer.gain"),
        ("designer/gain/floor.py", "from designer.lmi import theorem2", "designer.lmi.theorem2"),
        ("designer/proof/balls.py", "import designer.model.error_model", "designer.model.error_model"),
        ("designer/lmi/cones.py", "from designer.search.barrier import Barrier", "designer.search.barrier.Barrier"),
        ("designer/proof/by_balls.py", "import matplotlib.pyplot", "matplotlib.pyplot"),
        ("agent/cli.py", "import numpy", "numpy at once"),
        ("agent/commands/options.py", "from agent.contract.gains import Gains", "agent.contract.gains.Gains at once"),
        ("designer/cli.py", "if True:\n    import numpy", "numpy at once"),
        ("designer/commands/design.py", "import numpy", "numpy at once"),
        ("designer/commands/verify.py", "from designer.proof import certificate", "designer.proof.certificate at once"),
    ],
)
def test_a_planted_import_is_found(path: str, line: str, found: str) -> None:
    files = sources()
    files[path] += "\n" + line + "\n"
    assert violations(files) == [f"{path}: {found}"]


def test_imports_for_the_type_checker_are_not_made_at_once() -> None:
    source = "if TYPE_CHECKING:\n    from agent.contract.gains import Gains\n"
    assert violations({"agent/cli.py": source}) == []


# what processes load
def loaded(modules: str) -> set[str]:
    """Names of all modules of a fresh process that has imported `modules`."""
    program = f"import sys, json; import {modules}; print(json.dumps(sorted(sys.modules)))"
    run = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, check=True, text=True)
    return set(json.loads(run.stdout))


@pytest.mark.parametrize(
    ("modules", "never"),
    [
        # a node: no solver, no pictures, no recorder
        ("agent.cli, agent.network.bus, agent.roles.joining, agent.roles.node",
         "cvxpy clarabel scipy designer matplotlib rich mcap zstandard cryptography"),
        ("agent.cli, agent.network.bus, agent.roles.plant, agent.roles.coordinator",
         "cvxpy clarabel scipy designer matplotlib rich mcap zstandard"),
        ("agent.cli, agent.launch", "cvxpy clarabel scipy designer matplotlib rich mcap zenoh"),
        ("agent.cli, agent.network.bus, agent.roles.recorder", "cvxpy clarabel scipy designer matplotlib rich"),
        # the command line, before it knows what to do
        ("designer.cli", "numpy zenoh mcap cvxpy clarabel scipy flint matplotlib rich"),
        # replay: nothing of the nodes' arithmetic, no network
        ("designer.replay",
         "agent.filter agent.inbox agent.roles agent.network.bus zenoh cvxpy clarabel scipy flint matplotlib"),
        # a page of a report: no figures for papers
        ("designer.report.page", "agent.filter agent.network zenoh cvxpy clarabel scipy flint matplotlib"),
        # the library, and its plugin for pytest, before anything of them is used
        ("peakmesh", "agent designer pydantic numpy zenoh mcap cvxpy scipy matplotlib"),
        ("peakmesh.testing", "agent designer pydantic numpy zenoh mcap cvxpy scipy matplotlib"),
        # a worker, before its first job: what sets the number of its threads comes before numpy
        ("designer.workers", "numpy distributed"),
        # the certificate: no solver
        ("designer.proof.certificate", "cvxpy clarabel scipy.optimize agent.filter zenoh mcap matplotlib"),
    ],
)  # fmt: skip
def test_a_process_loads_only_what_it_needs(modules: str, never: str) -> None:
    assert loaded(modules) & set(never.split()) == set()


def test_the_solver_is_loaded_where_it_is_used() -> None:
    """So that the test above means something."""
    assert {"cvxpy", "designer"} <= loaded("designer.lmi.theorem2")
