"""Hosts on one switch, each a network namespace: real stacks, real cables, and no root where users may have namespaces.

Nothing can be left behind: a namespace is there as long as its holder, a `cat` that ends with the pipe to it.
"""

from __future__ import annotations

import contextlib
import os
import subprocess
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType
from typing import Self

import pytest
from runs import PATIENCE, program

SHIFTED = Path(__file__).with_name("shifted_clock")  # a folder: its sitecustomize moves the clock of a process


class Hosts:
    """Hosts 1, 2, ...; host i has 10.77.0.i and fd77::i. Use them with `with`; it skips a test where they cannot be."""

    def __init__(self, count: int) -> None:
        self._count = count
        self._holders: list[subprocess.Popen[bytes]] = []  # the switch, then the hosts

    def __enter__(self) -> Self:
        try:
            self._hold(["unshare", "--user", "--map-root-user", "--net", "cat"])
            self._on(0, "ip", "link", "add", "switch", "type", "bridge", "mcast_snooping", "0")
            self._on(0, "ip", "link", "set", "switch", "up")
            for host in range(1, self._count + 1):
                self._plug_in(host)
        except (OSError, subprocess.SubprocessError) as error:  # no such program, or no such right
            self.__exit__(None, None, None)
            said = error.stderr.decode().strip() if isinstance(error, subprocess.CalledProcessError) else str(error)
            pytest.skip(f"network namespaces are not permitted here: {said}")
        return self

    def _plug_in(self, host: int) -> None:
        self._hold([*self._entering(0), "unshare", "--net", "cat"])
        holder = str(self._holders[host].pid)
        self._on(0, "ip", "link", "add", f"port{host}", "type", "veth", "peer", "name", "eth0", "netns", holder)
        self.plug(host)
        self._on(host, "ip", "address", "add", f"10.77.0.{host}/24", "dev", "eth0")
        self._on(host, "ip", "address", "add", f"fd77::{host}/64", "dev", "eth0", "nodad")
        for device in ("lo", "eth0"):
            self._on(host, "ip", "link", "set", device, "up")

    def _hold(self, command: list[str]) -> None:
        holder = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
        self._holders.append(holder)
        assert holder.stdin is not None
        assert holder.stdout is not None
        assert holder.stderr is not None
        with contextlib.suppress(BrokenPipeError):
            holder.stdin.write(b"there\n")
            holder.stdin.flush()
        if not holder.stdout.readline():  # where it comes back, `cat` runs, in the namespaces
            raise OSError(holder.stderr.read().decode().strip())

    def _entering(self, host: int) -> list[str]:
        target = str(self._holders[host].pid)
        return ["nsenter", "--user", "--preserve-credentials", "--net", "--target", target, "--"]

    def _on(self, host: int, *command: str) -> None:
        subprocess.run([*self._entering(host), *command], check=True, capture_output=True, timeout=PATIENCE)

    def plug(self, host: int) -> None:
        """Put a host's cable into the switch."""
        self._on(0, "ip", "link", "set", f"port{host}", "master", "switch", "up")

    def pull(self, host: int) -> None:
        """Pull it out there; the host itself does not notice."""
        self._on(0, "ip", "link", "set", f"port{host}", "nomaster")

    @contextlib.contextmanager
    def parted(self, one: int, other: int) -> Iterator[None]:
        """Two hosts that cannot reach each other, as behind two firewalls."""
        for change in ("add", "del"):
            for here, there in ((one, other), (other, one)):
                self._on(here, "ip", "route", change, "blackhole", f"10.77.0.{there}/32")
                self._on(here, "ip", "-6", "route", change, "blackhole", f"fd77::{there}/128")
            if change == "add":
                yield

    @contextlib.contextmanager
    def started(self, host: int, *arguments: object, clock: float = 0.0) -> Iterator[subprocess.Popen[str]]:
        """A command of peakmesh on a host, whose clock is `clock` seconds ahead; killed at the end of the block."""
        environment = {**os.environ, "PYTHONPATH": str(SHIFTED), "SHIFT_CLOCK": str(clock)}
        process = subprocess.Popen(
            [*self._entering(host), *program(*arguments)],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env=environment,
        )
        try:
            yield process
        finally:
            with contextlib.suppress(ProcessLookupError):
                process.kill()
            process.communicate()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for holder in reversed(self._holders):
            holder.communicate()
