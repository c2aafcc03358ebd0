"""`Mesh`: a run that goes on in the background, with sensors of the user's."""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

from agent.contract.errors import EXIT_GOOD, EXIT_INPUT, InputError, RunBroken
from agent.contract.gains import Gains
from peakmesh import sensors as sensing
from peakmesh.answers import Name, replay
from peakmesh.running import file_of, new_name

if TYPE_CHECKING:
    from designer.replay.verdict import Verdict

GLANCE = 0.1  # seconds between looks at the sensors while the run is waited for
GRACE = 5.0  # seconds for a run to end well after a sensor has failed: it may have failed at what ends last
LAST_LOOK = 1.0  # seconds for each sensor to end, after a run that did not end well
FAREWELL = 60.0  # seconds for a run to end in order, before it is killed


class Mesh:
    """A whole network on this machine, from its start to the end of a `with` block; no process or thread is left.

    `run` is its name and `address` where its coordinator listens: what a sensor, `peakmesh watch` or `live` is told.
    """

    def __init__(
        self,
        gains: Gains | Name,
        recording: Name,
        *,
        sensors: Mapping[str, sensing.Source] | None = None,
        external: Sequence[str] = (),
        steps: int = 50,
        **options: Any,
    ) -> None:
        """Start it, and return once the coordinator listens. `options` are those of `run`.

        `sensors` has for a node what measures it: a function of the step that returns y, or a command in which {run},
        {node} and {address} are put in. `external` names nodes with sensors that somebody else starts. Raises
        InputError and RunBroken as `run` does.
        """
        self.gains = gains if isinstance(gains, Gains) else Gains.load(gains)
        self.recording = Path(recording)
        self.run = options.setdefault("name", new_name(self.gains))
        sensors = sensors or {}
        for node in sensors:
            self.gains.problem.node_index(node)
        self.was_awaited = False  # whether somebody has asked how it ends
        self._verdict: Verdict | None = None
        self._sensors: dict[str, sensing.Sensor] = {}
        with ExitStack() as stack:
            path = stack.enter_context(file_of(gains))
            measured = [*external, *(node for node in sensors if node not in external)]
            arguments = options | {"gains": str(path), "recording": str(self.recording), "steps": steps}
            self._said = stack.enter_context(tempfile.TemporaryFile())
            self._process = stack.enter_context(self._started(arguments | {"external": measured}))
            stack.callback(self._end)
            self.address = self._listening()
            for node, source in sensors.items():
                self._sensors[node] = sensing.start(source, run=self.run, node=node, address=self.address)
            self._stack = stack.pop_all()

    def wait(self) -> None:
        """Until the run is over. Raises RunBroken where it has not come to its end, or a sensor has failed before."""
        self.was_awaited, failures = True, ""
        while self._process.poll() is None and not failures:
            with suppress(subprocess.TimeoutExpired):
                self._process.wait(GLANCE)
            failures = self._failures()
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(GRACE)
        if self._process.returncode == EXIT_GOOD:
            return
        error, failures = self._error(), self._failures(LAST_LOOK)
        self._end()
        raise RunBroken(failures) if failures else error

    def verdict(self) -> Verdict:
        """Wait, and replay. Raises AssertionError with the verdict's text where it is not that the recording agrees."""
        __tracebackhide__ = True
        if self._verdict is None:
            self.wait()
            self._verdict = replay(self.recording)
        if self._verdict.exit_code != EXIT_GOOD:
            raise AssertionError(self._verdict.text())
        return self._verdict

    def close(self) -> None:
        """End what has not ended."""
        self._stack.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _started(self, arguments: dict[str, Any]) -> subprocess.Popen[bytes]:
        """In a session of its own, so that Ctrl-C reaches it through us alone."""
        return subprocess.Popen(
            [sys.executable, "-P", "-m", "peakmesh.background", json.dumps(arguments)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._said,
            start_new_session=True,
        )

    def _listening(self) -> str:
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        if not line:
            self._process.wait()
            raise self._error()
        return str(json.loads(line)["listening"][0])

    def _failures(self, seconds: float = 0.0) -> str:
        failures = {node: sensor.failure(seconds) for node, sensor in self._sensors.items()}
        return "; ".join(f'the sensor of node "{node}" failed: {why}' for node, why in failures.items() if why)

    def _error(self) -> InputError | RunBroken:
        """What the process has ended with."""
        code = self._process.returncode
        self._said.seek(0)
        lines = self._said.read().decode(errors="replace").strip().splitlines()
        words = lines[-1] if lines else f"the run ended with code {code}"
        return InputError(words) if code == EXIT_INPUT else RunBroken(words)

    def _end(self) -> None:
        """Of the run and of the sensors: it first, so that nobody waits for them."""
        assert self._process.stdin is not None
        self._process.stdin.close()
        try:
            self._process.wait(FAREWELL)
        except subprocess.TimeoutExpired:
            self._process.kill()
        for sensor in self._sensors.values():
            sensor.close()
        self._sensors.clear()
