"""Who can be reached: whether two sessions of this process meet, whether it can listen, and whether a run is there."""

from __future__ import annotations

import re
import socket
import tempfile
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from queue import Empty, SimpleQueue

from agent.children import folder_of_sockets
from agent.contract.errors import PeakmeshError, RunBroken
from agent.contract.keys import VIEWER
from agent.doctor.findings import Finding, State
from agent.network.configuration import Network
from agent.network.links import Sockets
from agent.network.session import Session
from agent.roles.onlooker import find_run

RUN = "doctor"  # of the two sessions; nobody else is in it


def loopback(wait: float) -> Finding:
    """Over TCP, as whoever looks on."""
    try:
        with _session(Network("tcp/127.0.0.1:0")) as listens:
            (address, *_) = listens.locators()
            return _meet("zenoh", listens, Network("tcp/127.0.0.1:0", (address,)), f"over {address}", wait)
    except PeakmeshError as error:
        return Finding("zenoh", State.WRONG, str(error))


def sockets(wait: float) -> Finding:
    """Over Unix sockets, as the processes of `peakmesh run`."""
    try:
        with tempfile.TemporaryDirectory(prefix="peakmesh-", dir=folder_of_sockets()) as folder:
            here, there = (f"unixsock-stream/{Path(folder) / name}" for name in ("0", "1"))
            with _session(Network("", sockets=Sockets(here, ()))) as listens:
                to = Network("", sockets=Sockets(there, (here,)))
                return _meet("zenoh", listens, to, f"over Unix sockets in {folder}", wait)
    except (PeakmeshError, OSError) as error:
        return Finding("zenoh", State.WRONG, str(error))


def _meet(what: str, listens: Session, network: Network, how: str, wait: float) -> Finding:
    """Whether a second session is seen by the first."""
    seen: SimpleQueue[str] = SimpleQueue()
    listens.watch(lambda who, identity, present: seen.put(who))
    with _session(network) as connects:
        connects.appear(VIEWER)
        try:
            seen.get(timeout=wait)
        except Empty:
            return Finding(
                what, State.WRONG, f"two sessions did not meet {how} within {wait:g} s; is there a firewall?"
            )
    return Finding(what, State.GOOD, f"two sessions meet {how}")


def _session(network: Network) -> closing[Session]:
    return closing(Session(network, run=RUN, who=VIEWER, hand_over=lambda duty: None))


def listening(network: Network) -> Finding:
    """Whether this machine can be reached at `network.listen`."""
    try:
        with _session(network) as session:
            return Finding("listen", State.GOOD, f"can listen at {', '.join(session.locators())}")
    except PeakmeshError as error:
        return Finding("listen", State.WRONG, str(error))


def reached(network: Network) -> Iterator[Finding]:
    """For each address that `network` connects to: whether somebody listens there; then whether a run is there."""
    refused = [said for address in network.connect if (said := _refused(address, network.wait))]
    for said in refused:
        yield Finding("connect", State.WRONG, said)
    if refused:
        return
    where = ", ".join(network.connect)
    if network.credentials is not None and (why := network.refusal()):
        yield Finding("connect", State.WRONG, why)
        return
    try:
        yield Finding("connect", State.GOOD, f'run "{find_run(network)}" is at {where}')
    except RunBroken as error:
        yield Finding("connect", State.WRONG, f"{error}; whoever listens there is not, or not yet, in a run")
    except PeakmeshError as error:  # several runs
        yield Finding("connect", State.GOOD, str(error))


def _refused(address: str, wait: float) -> str:
    """Why nobody can be listening at an address, as far as TCP tells; ""."""
    found = re.fullmatch(r"(?:tcp|tls)/(.+):(\d+)", address)
    if found is None:
        return ""
    try:
        socket.create_connection((found[1].strip("[]"), int(found[2])), timeout=wait).close()
    except OSError as error:
        why = "no answer, as a firewall does" if isinstance(error, TimeoutError) else error.strerror or str(error)
        return f"nobody answers at {address}: {why}"
    return ""
