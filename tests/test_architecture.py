"""Who may import whom, held against the code, and against what processes really load."""

from __future__ import annotations

import ast
import json
import subprocess
import sys
from collections.abc import Iterator

import pytest
from places import ROOT

# What is imported -> the files and folders that may. The longest name that fits decides; what is not here is free.
WHO_MAY_IMPORT = {
    # one arrow between the packages, designer -> agent.contract; the program adds the runtime's commands to its own
    "designer": ["designer/"],
    "agent": ["agent/"],
    "agent.contract": ["agent/", "designer/"],
    "agent.cli": ["agent/__main__.py", "designer/cli.py", "designer/commands/"],
    # replay shares no step arithmetic with the nodes
    "agent.filter": ["agent/inbox.py", "agent/roles/node.py"],
    # each outside thing behind one door
    "zenoh": ["agent/network/bus.py"],
    "mcap": ["agent/contract/recording/"],
    "zstandard": ["agent/contract/recording/"],
    "cvxpy": ["designer/lmi/"],
    "clarabel": ["designer/lmi/"],
    "scipy": ["designer/lmi/", "designer/gain/exact.py"],
    "flint": [
        "designer/proof/balls.py",
        "designer/proof/ball_model.py",
        "designer/proof/theorem1.py",
        "designer/proof/recursion.py",
    ],
    "matplotlib": ["designer/report/figures.py"],
    "rich": ["agent/cli.py", "designer/commands/"],
    "distributed": ["designer/workers.py"],
}

# The contract is made of leaf modules: of peakmesh they import each other alone.
LEAVES = "agent/contract/"

# These know no clock, no chance, no network, no other thread.
PURE = ["agent/filter.py", "agent/inbox.py", "agent/receipts.py"]
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
    "agent.network.bus",
]

# Command lines answer at once: before a command is called they import the standard library and these alone.
LAZY = ["agent/cli.py", "designer/cli.py", "designer/commands/", "agent/__main__.py", "designer/__main__.py"]
LIGHT = [
    "agent.cli", "agent.plan", "agent.contract.errors", "agent.contract.files", "designer.cli", "designer.commands",
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


def violations(files: dict[str, str]) -> list[str]:
    """Every import that the table forbids, as "file: module"."""
    found = []
    for path, source in files.items():
        tree = ast.parse(source)
        for name in imported(tree):
            rule = max((rule for rule in WHO_MAY_IMPORT if begins(name, rule)), key=len, default=None)
            forbidden = name.startswith(".") or (rule is not None and not within(path, WHO_MAY_IMPORT[rule]))
            ours = begins(name, "agent") or begins(name, "designer")
            forbidden |= path.startswith(LEAVES) and ours and not begins(name, "agent.contract")
            forbidden |= path in PURE and any(begins(name, impure) for impure in IMPURE)
            if forbidden:
                found.append(f"{path}: {name}")
        if within(path, LAZY):
            for name in imported_at_once(tree):
                standard = name.split(".")[0] in sys.stdlib_module_names
                if not standard and not any(begins(name, light) for light in LIGHT):
                    found.append(f"{path}: {name} at once")
    return found


def test_the_code_keeps_to_the_table() -> None:
    assert violations(sources()) == []


def test_every_place_of_the_table_exists_and_the_walk_finds_it() -> None:
    files = sources()
    assert len(files) > 30
    places = {place for places in WHO_MAY_IMPORT.values() for place in places} - {"designer/report.py"}
    for place in [*places, *PURE, *LAZY, LEAVES]:
        assert any(within(path, [place]) for path in files), place


@pytest.mark.parametrize(
    ("path", "line", "found"),
    [
        ("agent/roles/node.py", "import designer.model.error_model", "designer.model.error_model"),
        ("agent/launch.py", "from designer import synthesis", "designer.synthesis"),
        ("agent/roles/plant.py", "import zenoh", "zenoh"),
        ("agent/roles/plant.py", "def f():\n    import zenoh", "zenoh"),
        ("agent/roles/recorder.py", "from mcap.writer import Writer", "mcap.writer.Writer"),
        ("agent/contract/recording/reader.py", "from scipy import linalg", "scipy.linalg"),
        ("agent/contract/gains.py", "from agent.filter import Pair", "agent.filter.Pair"),
        ("agent/contract/gains.py", "from agent import plan", "agent.plan"),
        ("agent/contract/gains.py", "from ..filter import Pair", "..filter.Pair"),
        ("agent/filter.py", "import random", "random"),
        ("agent/inbox.py", "from time import monotonic", "time.monotonic"),
        ("agent/receipts.py", "import threading", "threading"),
        ("designer/proof/theorem1.py", "import cvxpy as cp", "cvxpy"),
        ("designer/synthesis.py", "try:\n    import clarabel\nexcept ImportError:\n    pass", "clarabel"),
        ("designer/replay/proofs.py", "from agent.filter import step", "agent.filter.step"),
        ("designer/replay/__init__.py", "from agent import filter", "agent.filter"),
        ("designer/replay/__init__.py", "import agent.inbox", "agent.inbox"),
        ("designer/show.py", "import agent.cli", "agent.cli"),
        ("designer/proof/theorem1.py", "import matplotlib.pyplot", "matplotlib.pyplot"),
        ("agent/cli.py", "import numpy", "numpy at once"),
        ("agent/cli.py", "from agent.contract.gains import Gains", "agent.contract.gains.Gains at once"),
        ("designer/cli.py", "if True:\n    import designer.synthesis", "designer.synthesis at once"),
        ("designer/commands/design.py", "import numpy", "numpy at once"),
        ("designer/commands/verify.py", "from designer import certificate", "designer.proof.theorem1 at once"),
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
         "cvxpy clarabel scipy designer matplotlib rich mcap zstandard"),
        ("agent.cli, agent.network.bus, agent.roles.plant, agent.roles.coordinator",
         "cvxpy clarabel scipy designer matplotlib rich mcap zstandard"),
        ("agent.cli, agent.launch", "cvxpy clarabel scipy designer matplotlib rich mcap zenoh"),
        ("agent.cli, agent.network.bus, agent.roles.recorder", "cvxpy clarabel scipy designer matplotlib rich"),
        # the command line, before it knows what to do
        ("designer.cli", "numpy zenoh mcap cvxpy clarabel scipy flint matplotlib rich"),
        # replay: nothing of the nodes' arithmetic, no network
        ("designer.replay",
         "agent.filter agent.inbox agent.roles agent.network.bus zenoh cvxpy clarabel scipy flint matplotlib"),
        # a worker, before its first job: what sets the number of its threads comes before numpy
        ("designer.workers", "numpy distributed"),
        # the certificate: no solver
        ("designer.proof.theorem1, designer.proof.recursion", "cvxpy clarabel scipy agent.filter zenoh mcap matplotlib"),
    ],
)  # fmt: skip
def test_a_process_loads_only_what_it_needs(modules: str, never: str) -> None:
    assert loaded(modules) & set(never.split()) == set()


def test_the_solver_is_loaded_where_it_is_used() -> None:
    """So that the test above means something."""
    assert {"cvxpy", "designer"} <= loaded("designer.lmi.theorem2")
