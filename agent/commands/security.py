"""Who may take part: with --keys whoever has a certificate, without it whoever is on this machine."""

from __future__ import annotations

import argparse
import ipaddress
import re
import socket
from pathlib import Path
from typing import TYPE_CHECKING

from agent.contract.errors import InputError

if TYPE_CHECKING:
    from agent.contract.problem import Problem
    from agent.network.credentials import Credentials


def add_keys_option(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--keys", type=Path, metavar="FOLDER", help="encrypt, and let nobody take part without a certificate from there"
    )


def add_security_options(parser: argparse.ArgumentParser) -> None:
    """Add --keys and --insecure; `secured` heeds them."""
    add_keys_option(parser)
    parser.add_argument(
        "--insecure", action="store_true", help="listen where other machines reach it without --keys: they can do all"
    )


def default_listen(options: argparse.Namespace) -> str:
    """On this machine alone, at a free port."""
    return "tcp/127.0.0.1:0" if options.keys is None else "tls/127.0.0.1:0"


def credentials_of(options: argparse.Namespace, who: str, problem: Problem | None) -> Credentials | None:
    """Those of `who` that --keys names. Raises InputError where they do not fit, as far as is known of the problem."""
    if options.keys is None:
        return None
    from agent.network.credentials import Credentials

    credentials = Credentials(options.keys, who)
    credentials.check(problem.name if problem is not None else None)
    return credentials


def refuse_insecure(option: str, address: str, *, keys: Path | None, insecure: bool) -> None:
    """Raise InputError where an address does not go with --keys, or others could listen in and take part there."""
    is_tls = address.startswith("tls/")
    if keys is not None and not is_tls:
        raise InputError(
            f"{option} {address}: with --keys everything is encrypted; an address looks like tls/127.0.0.1:7447"
        )
    if keys is None and is_tls:
        raise InputError(f"{option} {address}: there is no TLS without --keys FOLDER, which peakmesh keys init makes")
    if keys is None and option == "--listen" and not insecure and not is_local(address):
        raise InputError(
            f"--listen {address}: other machines could take part and forge everything; "
            "--keys FOLDER keeps them out, --insecure lets them in"
        )


def is_local(address: str) -> bool:
    """Whether only this machine reaches an address. Raises InputError for a host that is not known."""
    protocol, _, place = address.partition("/")
    if protocol.startswith("unix"):
        return True
    found = re.match(r"\[([^\]]*)\]|([^:#?]*)", place)
    assert found is not None
    return is_loopback(found[1] or found[2])


def is_loopback(host: str) -> bool:
    """Of all addresses that a host has. Raises InputError where it has none."""
    try:
        found = {str(entry[4][0]) for entry in socket.getaddrinfo(host, None)}
    except (OSError, UnicodeError):
        raise InputError(f'there is no host "{host}"') from None
    return all(ipaddress.ip_address(each.partition("%")[0]).is_loopback for each in found)
