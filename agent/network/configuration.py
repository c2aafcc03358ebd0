"""Where a participant is on the network, and what Zenoh is told of it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

LEASE_MS = 10_000  # a peer that is silent for so long is lost; a killed one is seen in milliseconds
BUFFER = 16_384  # bytes, of each direction of each link; messages are small, links are many


@dataclass(frozen=True)
class Network:
    """Where to listen, whom to connect to (one peer of the run is enough), how long to wait for the others."""

    listen: str = "tcp/127.0.0.1:0"
    connect: tuple[str, ...] = ()
    wait: float = 30.0  # seconds


def zenoh_configuration(network: Network) -> dict[str, Any]:
    """Peer mode without multicast: one known address is enough, gossip makes the mesh.

    Connecting goes on in the background, so that a signal is heeded meanwhile; the barrier waits for everybody.
    """
    return {
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
