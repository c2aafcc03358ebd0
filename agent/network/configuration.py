"""Where a participant is on the network, and what Zenoh is told of it."""

from __future__ import annotations

import secrets
from dataclasses import dataclass
from typing import Any

from agent.network.links import Sockets

LEASE_MS = 10_000  # a peer that is silent for so long is lost; a killed one is seen in milliseconds
BUFFER = 16_384  # bytes, of each direction of each link; messages are small, links are many
MANY = 1000  # more than anybody has links


@dataclass(frozen=True)
class Network:
    """Where to listen, whom to connect to (one peer of the run is enough), how long to wait for the others.

    In a run on one machine everybody has `sockets`, and links with those alone to whom they lead.
    """

    listen: str = "tcp/127.0.0.1:0"
    connect: tuple[str, ...] = ()
    wait: float = 30.0  # seconds
    sockets: Sockets | None = None


def zenoh_configuration(network: Network) -> dict[str, Any]:
    """Peer mode without multicast: one known address is enough, gossip makes the mesh.

    Connecting goes on in the background, so that a signal is heeded meanwhile; the barrier waits for everybody.
    """
    configuration: dict[str, Any] = {
        "mode": "peer",
        "listen": {"endpoints": [network.listen]},
        "connect": {
            "endpoints": list(network.connect),
            "timeout_ms": -1,
            "exit_on_failure": False,
            "retry": {"period_init_ms": 20, "period_max_ms": 200, "period_increase_factor": 1.5},
        },
        "open": {"return_conditions": {"connect_scouted": False, "declares": False}},
        "scouting": {
            "multicast": {"enabled": False},
            "gossip": {
                "enabled": True,
                "autoconnect_strategy": {"peer": {"to_router": "always", "to_peer": "greater-zid"}},
            },
        },
        "adminspace": {"enabled": True},  # tells the port that 0 became
        "transport": {
            "shared_memory": {"enabled": False},
            "link": {"tx": {"lease": LEASE_MS, "batch_size": BUFFER}, "rx": {"buffer_size": BUFFER}},
        },
    }
    if network.sockets is not None:
        _keep_to(network.sockets, configuration, listen=[network.listen] if network.listen else [])
    return configuration


def _keep_to(sockets: Sockets, configuration: dict[str, Any], *, listen: list[str]) -> None:
    """Links over these sockets alone; but strangers (sensors, viewers) may connect to us.

    They find us by gossip, as ever. Of two that could connect the one with the greater id does, its least significant
    byte first: with zeros there, ours is less than any that zenoh draws.
    """
    configuration["id"] = f"{(secrets.randbits(63) or 1) << 64:x}"
    configuration["listen"]["endpoints"] = [*listen, sockets.listen]
    configuration["connect"]["endpoints"] = list(sockets.connect)
    configuration["scouting"]["gossip"]["autoconnect"] = {"peer": []}
    configuration["transport"]["unicast"] = {"accept_pending": MANY}  # all come at once
