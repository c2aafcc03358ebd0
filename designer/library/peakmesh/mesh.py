"""`Mesh`: a run that goes on in the background, with nodes, sensors or a plant of the user's."""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from agent.contract.closing import Closing
from agent.contract.errors import EXIT_GOOD, EXIT_INPUT, InputError, RunBroken
from agent.contract.gains import Gains
from peakmesh.answers import Name, replay
from peakmesh.functions import Cast, Command, Dynamics, Filter
from peakmesh.running import file_of, new_name
from peakmesh.sensors import Measure

if TYPE_CHECKING:
    from designer.replay.verdict import Verdict

GLANCE = 0.1  # seconds between looks at the functions while the run is waited for
GRACE = 5.0  # seconds for a run to end well after a function has failed: it may have failed at what ends last
FAREWELL = 60.0  # seconds for a run to end in order, before it is killed


class Mesh(Closing):
    """A whole network on this machine, from its start to the end of a `with` block; no process or thread is left.

    `run` is its name and `address` where its coordinator listens: what a sensor, `peakmesh watch` or `live` is told.
    """

    def __init__(
        self,
        gains: Gains | Name,
        recording: Name,
        *,
        nodes: Mapping[str, Filter | Command] | None = None,
        sensors: Mapping[str, Measure | Command] | None = None,
        plant: Dynamics | Command | None = None,
        external: Sequence[str] = (),
        steps: int = 50,
        **options: Any,
    ) -> None:
        """Start it, and return once the coordinator listens. `options` are those of `run`.

        Functions among `nodes`, `sensors` and `plant` are called in threads of this process. Raises InputError and
        RunBroken as `run` does.
        """
        self.gains = gains if isinstance(gains, Gains) else Gains.load(gains)
        self.recording = Path(recording)
        self.run = options.setdefault("name", new_name(self.gains))
        self._cast = Cast(self.gains, nodes=nodes or {}, sensors=sensors or {}, plant=plant)
        self.was_awaited = False  # whether somebody has asked how it ends
        self._verdict: Verdict | None = None
        with ExitStack() as stack:
            path = stack.enter_context(file_of(gains))
            arguments = options | {"gains": str(path), "recording": str(self.recording), "steps": steps}
            arguments |= {"external": external, **self._cast.commands}
            self._said = stack.enter_context(tempfile.TemporaryFile())
            self._process = stack.enter_context(self._started(arguments))
            stack.callback(self._end)
            self.address = self._listening()
            patience = {what: float(options.get(what, least)) for what, least in (("wait", 60.0), ("deadline", 10.0))}
            self._cast.start(run=self.run, address=self.address, **patience)
            self._stack = stack.pop_all()

    def wait(self) -> None:
        """Until the run is over. Raises RunBroken where it has not come to its end, or a function has failed before."""
        self.was_awaited, failures = True, ""
        while self._process.poll() is None and not failures:
            with suppress(subprocess.TimeoutExpired):
                self._process.wait(GLANCE)
            failures = self._cast.failures()
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(GRACE)
        if self._process.returncode == EXIT_GOOD:
            return
        error, failures = self._error(), self._cast.failures()
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

    def _error(self) -> InputError | RunBroken:
        """What the process has ended with."""
        code = self._process.returncode
        self._said.seek(0)
        lines = self._said.read().decode(errors="replace").strip().splitlines()
        words = lines[-1] if lines else f"the run ended with code {code}"
        return InputError(words) if code == EXIT_INPUT else RunBroken(words)

    def _end(self) -> None:
        """Of the run and of the functions: it first, so that nobody waits for them."""
        assert self._process.stdin is not None
        self._process.stdin.close()
        try:
            self._process.wait(FAREWELL)
        except subprocess.TimeoutExpired:
            self._process.kill()
        self._cast.close()
