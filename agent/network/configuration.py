"""Where a participant is on the network, and what Zenoh is told of it."""

from __future__ import annotations

import math
import secrets
from dataclasses import dataclass
from typing import Any, Literal

from agent.contract.problem import Problem
from agent.network.access import access_control
from agent.network.addresses import MULTICAST, NONE
from agent.network.credentials import Credentials
from agent.network.links import Sockets

ATTEMPT_MS = 500  # that a client tries to connect before it looks up
ENVELOPE = 4096  # bytes of Zenoh's own around the largest message: its key, its time, its encoding
BUFFER = 16_384  # bytes, of each direction of each link; messages are small, links are many
MANY = 1000  # more than anybody has links


@dataclass(frozen=True)
class Network:
    """Where to listen, whom to connect to (one peer of the run is enough), how long to wait for the others.

    Who listens nowhere, `NONE`, is a client: everything goes through the one that it is connected to. `MULTICAST` finds
    whom to connect to by asking the local network. In a run on one machine everybody has `sockets`, and links with
    those alone to whom they lead. A peer that is silent for `lease` seconds is lost; a killed one is seen at once.
    """

    listen: str = "tcp/127.0.0.1:0"
    connect: tuple[str, ...] = ()
    wait: float = 30.0  # seconds
    lease: float = 20.0  # seconds
    keep: float = 64e6  # bytes: in a paced run, of what the recorder has not acknowledged
    routes: bool = False  # takes no part, but passes on what others say
    hosts: bool = False  # clients may be there though it has sockets
    sockets: Sockets | None = None
    largest: float = math.inf  # bytes: nothing comes in that is larger
    credentials: Credentials | None = None  # with them, everybody must show some
    problem: Problem | None = None  # says what whose credentials allow; without it, whoever has some is believed

    @property
    def kind(self) -> Literal["peer", "client", "router"]:
        """What this is to Zenoh."""
        return "router" if self.routes else "client" if self.listen == NONE else "peer"

    def refusal(self) -> str:
        """Why nobody to whom it connects is reached, where certificates are the reason; otherwise ""."""
        own = self.credentials
        return next(filter(None, map(own.why_not, self.connect)), "") if own is not None else ""


def zenoh_configuration(network: Network, *, run: str) -> dict[str, Any]:
    """One known address is enough: gossip makes the mesh of the peers.

    Peers connect in the background, so that a signal is heeded meanwhile; the barrier waits for everybody.
    """
    configuration: dict[str, Any] = {
        "mode": network.kind,
        "listen": {"endpoints": [network.listen] if network.listen != NONE else []},
        "connect": {
            "endpoints": [address for address in network.connect if address != MULTICAST],
            "timeout_ms": ATTEMPT_MS if network.kind == "client" else -1,
            "exit_on_failure": network.kind == "client",
            "retry": {"period_init_ms": 20, "period_max_ms": 200, "period_increase_factor": 1.5},
        },
        "open": {"return_conditions": {"connect_scouted": False, "declares": False}},
        "scouting": {
            "multicast": {"enabled": MULTICAST in network.connect, "autoconnect": {"client": ["router", "peer"]}},
            "gossip": {
                "enabled": True,
                "autoconnect_strategy": {"peer": {"to_router": "always", "to_peer": "greater-zid"}},
            },
        },
        "adminspace": {"enabled": True},  # tells the port that 0 became
        "transport": {
            "shared_memory": {"enabled": False},
            "link": {"tx": {"lease": round(1000 * network.lease), "batch_size": BUFFER}, "rx": {"buffer_size": BUFFER}},
        },
    }
    if network.sockets is not None:
        _keep_to(network.sockets, configuration, listen=[network.listen] if network.listen else [])
    if network.largest < math.inf:
        _let_in_no_larger(int(network.largest), configuration)
    if network.credentials is not None:
        configuration["transport"]["link"] |= {"protocols": ["tls"], "tls": _tls(network.credentials)}
        if network.problem is not None and run:
            configuration["access_control"] = access_control(network.problem, run=run)
    return configuration


def _let_in_no_larger(size: int, configuration: dict[str, Any]) -> None:
    """Nor gather the parts of what is larger."""
    configuration["transport"]["link"]["rx"]["max_message_size"] = size + ENVELOPE
    configuration["low_pass_filter"] = [
        {
            "id": "largest",
            "flows": ["ingress"],
            "messages": ["put", "delete", "query", "reply"],
            "key_exprs": ["**"],
            "size_limit": size,
        }
    ]


def _tls(credentials: Credentials) -> dict[str, Any]:
    """Mutual: both ends show a certificate. Its name is a role, not an address, and decides what its owner may do."""
    own = {"private_key": str(credentials.private), "certificate": str(credentials.certificate)}
    return {
        "root_ca_certificate": str(credentials.authority),
        "enable_mtls": True,
        "verify_name_on_connect": False,
        "close_link_on_expiration": True,
        **{f"{side}_{what}": path for side in ("listen", "connect") for what, path in own.items()},
    }


def _keep_to(sockets: Sockets, configuration: dict[str, Any], *, listen: list[str]) -> None:
    """Links over these sockets alone; but strangers (sensors, viewers) may connect to us.

    They find us by gossip, as ever. Of two that could connect the one with the greater id does. Zenoh draws ids of 128
    bits, and compares them from the last byte on; ours are less from either end.
    """
    configuration["id"] = f"{(secrets.randbits(64) or 1) << 32:x}"
    configuration["listen"]["endpoints"] = [*listen, sockets.listen]
    configuration["connect"]["endpoints"] = list(sockets.connect)
    configuration["scouting"]["gossip"]["autoconnect"] = {"peer": []}
    configuration["transport"]["unicast"] = {"accept_pending": MANY}  # all come at once
