"""A plugin for pytest, there wherever peakmesh is installed: the fixture `mesh`, which starts a whole network.

    def test_my_sensor(mesh):
        run = mesh("gains.json", sensors={"left": "python sensor.py {run} {node} {address}"}, steps=30)
        assert run.verdict().agrees

It loads nothing but pytest until a test asks for it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    from peakmesh.mesh import Mesh


@pytest.fixture
def mesh(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Callable[..., Mesh]]:
    """Starts a network for this test, on free ports: `mesh(gains, ...)` takes what `peakmesh.Mesh` does.

    Its `verdict()` waits for the end and fails the test where the replay does not agree; where the test has not waited
    for it, that is done at the end. Whatever happens, everything that was started is ended. The recording stays in the
    folder of the test.
    """
    from peakmesh import Mesh

    failed, meshes = request.session.testsfailed, list[Mesh]()
    with ExitStack() as stack:

        def start(gains: Any, recording: Any = None, **options: Any) -> Mesh:
            number = len(meshes) + 1
            path = tmp_path / ("run.mcap" if number == 1 else f"run-{number}.mcap") if recording is None else recording
            meshes.append(stack.enter_context(Mesh(gains, path, **options)))
            return meshes[-1]

        yield start
        if request.session.testsfailed == failed:
            for each in meshes:
                if not each.was_awaited:
                    each.verdict()
