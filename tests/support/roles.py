"""Every role as a command of its own, as on separate machines."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path
from subprocess import Popen

from runs import PATIENCE, line_with, started

from agent.contract.gains import Gains


class Roles:
    """A coordinator that waits, at `address`; `start` starts everybody else, all of them until the end of the test."""

    def __init__(
        self,
        stack: ExitStack,
        gains: Path,
        recording: Path,
        *plan: object,
        run: str = "zhu2020-lossy",
        keys: Path | None = None,
    ) -> None:
        """`plan` are options of the coordinator, `run` is the name; with `keys` nobody else can take part."""
        self._stack, self.gains, self.recording, self.run = stack, gains, recording, run
        self.keys = () if keys is None else ("--keys", keys)
        listen = "--listen", f"{'tcp' if keys is None else 'tls'}/127.0.0.1:0", *self.keys
        words = ["coordinator", gains, *listen, "--run", run, "--wait", PATIENCE, *plan]
        self.coordinator = stack.enter_context(started(*words))
        self.address = line_with(self.coordinator, "listening at").split()[-1]

    def start(self) -> None:
        self.nodes = [self.node(name) for name in Gains.load(self.gains).problem.node_names]
        self._role("plant")
        self.recorder = self._role("recorder", "-o", self.recording)

    def node(self, name: str) -> Popen[str]:
        """Start a node."""
        return self._role("node", "--node", name)

    def _role(self, role: str, *words: object) -> Popen[str]:
        common = "--run", self.run, "--connect", self.address, "--wait", PATIENCE, *self.keys
        return self._stack.enter_context(started(role, self.gains, *words, *common))
