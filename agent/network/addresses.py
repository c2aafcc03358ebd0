"""Addresses, as Zenoh writes them: tcp/192.168.0.7:7447. What cannot work is refused before anybody waits for it."""

from __future__ import annotations

import ipaddress
import os
import re
import socket
from collections.abc import Iterable
from pathlib import Path

from agent.contract.errors import InputError

NONE = "none"  # as --listen: nobody can connect to us, we take part through the one to whom we connect
MULTICAST = "multicast"  # as --connect: whoever answers on the local network
WITH_PORT = ("tcp", "udp", "tls", "quic", "ws")
PROTOCOLS = (*WITH_PORT, "unixsock-stream")


def refuse_addresses(*, listen: str, connect: Iterable[str]) -> None:
    """Raise InputError, in one sentence, for what is no address, or one that nobody can have."""
    if listen != NONE:
        _refuse("--listen", listen, "listen on", least_port=0)
    for address in connect:
        if address != MULTICAST:
            _refuse("--connect", address, "connect to", least_port=1)


def reaches_other_machines(address: str) -> bool:
    """Whether somebody on another machine can connect to this address; a name counts as one that can be reached."""
    return _protocol(address) in WITH_PORT and not _is_loopback(_host(address))


def _refuse(option: str, address: str, what: str, *, least_port: int) -> None:
    found = re.fullmatch(r"([a-z0-9-]+)/(\S+)", address)
    if "," in address:
        raise InputError(f"{option} {address}: one address has no comma; give {option} once for each")
    if found is None:
        raise InputError(f"{option} {address!r}: an address looks like tcp/127.0.0.1:7447")
    protocol, place = found[1], re.split("[?#]", found[2])[0]
    if protocol not in PROTOCOLS:
        known = f"{', '.join(PROTOCOLS[:-1])} and {PROTOCOLS[-1]}"
        raise InputError(f"cannot {what} {address}: there is no such protocol as {protocol}; there are {known}")
    if protocol in WITH_PORT:
        _refuse_place(f"{option} {address}", place, least_port=least_port)


def _refuse_place(said: str, place: str, *, least_port: int) -> None:
    found = re.fullmatch(r"(\[[0-9a-fA-F:.%\w]+\]|[^:\[\]]*)(?::([^:]*))?", place)
    if found is None:
        raise InputError(f"{said}: an IPv6 address stands in brackets, and a port after it: [::1]:7447")
    host, port = found[1], found[2]
    if not host or not port:
        what = "port" if host else "host"
        raise InputError(f"{said}: the {what} is missing; an address looks like tcp/127.0.0.1:7447")
    if not (port.isascii() and port.isdecimal() and least_port <= int(port[:9]) <= 65535):
        raise InputError(f"{said}: {port} is not a port; ports are {least_port} to 65535")
    try:
        socket.getaddrinfo(host.strip("[]"), int(port), type=socket.SOCK_STREAM)
    except (OSError, UnicodeError) as error:
        why = error.strerror if isinstance(error, OSError) else "it is no name"
        raise InputError(f"{said}: the host {host} is not known here: {why}") from None


def _is_loopback(host: str) -> bool:
    try:
        return host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False  # a name


def _protocol(address: str) -> str:
    return address.partition("/")[0]


def _host(address: str) -> str:
    return address.partition("/")[2].rpartition(":")[0].strip("[]")


def machine() -> str:
    """Whose network this process is on: the same text for two of which each can reach what listens on 127.0.0.1.

    "" where the system does not say.
    """
    try:
        return f"{Path('/proc/sys/kernel/random/boot_id').read_text().strip()} {os.readlink('/proc/self/ns/net')}"
    except OSError:
        return ""
