"""Tells systemd that a role is up: a datagram to NOTIFY_SOCKET, where there is one (sd_notify)."""

from __future__ import annotations

import os
import socket
from contextlib import suppress


def tell_supervisor(status: str) -> None:
    """Up, and what it does; where nobody asked, nothing."""
    address = os.environ.get("NOTIFY_SOCKET", "")
    if not address:
        return
    with suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as channel:
        channel.connect("\0" + address[1:] if address.startswith("@") else address)
        channel.sendall(f"READY=1\nSTATUS={status}\n".encode())
