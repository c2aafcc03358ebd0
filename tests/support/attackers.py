"""Zenoh sessions of nobody: plain zenoh, with certificates or without, that say and ask what they like."""

from __future__ import annotations

import json
import time
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from threading import Thread
from typing import Any

import zenoh

PATIENCE = 120.0  # seconds after which a wait of a test has failed, on a busy machine too
SECONDS = 1.0  # that those try to get in who cannot


def configuration(address: str, keys: Path | None, who: str = "", *, seconds: float = PATIENCE) -> zenoh.Config:
    """A peer that connects to `address`, with the certificate of `who` in `keys`; opening it fails after `seconds`.

    Without `who` it shows no certificate.
    """
    link: dict[str, Any] = {}
    if keys is not None:
        link["tls"] = {"root_ca_certificate": str(keys / "ca.pem"), "verify_name_on_connect": False}
        if who:
            pair = {"private_key": str(keys / f"{who}.key"), "certificate": str(keys / f"{who}.pem")}
            link["tls"] |= {f"{side}_{what}": path for side in ("listen", "connect") for what, path in pair.items()}
            link["tls"]["enable_mtls"] = True
    document = {
        "mode": "peer",
        "listen": {"endpoints": []},
        "connect": {"endpoints": [address], "timeout_ms": round(1000 * seconds), "exit_on_failure": True},
        "scouting": {"multicast": {"enabled": False}},
        "transport": {"link": link},
    }
    return zenoh.Config.from_json5(json.dumps(document))


def let_in(configurations: dict[str, zenoh.Config]) -> set[str]:
    """The names of those that get a session, of all that try at once."""
    found = set()

    def attempt(name: str, config: zenoh.Config) -> None:
        with suppress(zenoh.ZError), zenoh.open(config):
            found.add(name)

    threads = [Thread(target=attempt, args=each) for each in configurations.items()]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    return found


def wait_for_listeners(session: zenoh.Session, keys: Iterable[str]) -> None:
    """Until somebody listens to each of these keys, as far as `session` knows."""
    deadline = time.monotonic() + PATIENCE
    for key in keys:
        publisher = session.declare_publisher(key)
        while not publisher.matching_status.matching:
            assert time.monotonic() < deadline, f"nobody listens to {key}"
            time.sleep(0.01)
        publisher.undeclare()  # type: ignore[no-untyped-call]


def wait_for_peers(session: zenoh.Session, count: int) -> None:
    """Until it has links to so many."""
    deadline = time.monotonic() + PATIENCE
    while len(session.info.peers_zid()) < count:
        assert time.monotonic() < deadline, session.info.peers_zid()
        time.sleep(0.01)
