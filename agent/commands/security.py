"""Who may take part: with --keys whoever has a certificate, without it whoever is on this machine."""

from __future__ import annotations

import argparse
from collections.abc import Iterable
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


def add_insecure_option(parser: argparse.ArgumentParser) -> None:
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


def refuse_insecure(listen: str, connect: Iterable[str], *, keys: Path | None, insecure: bool) -> None:
    """Raise InputError where addresses do not go with --keys, or others could take part there without."""
    from agent.network.addresses import MULTICAST, NONE, reaches_other_machines

    if keys is not None and listen == NONE:
        raise InputError(
            "--listen none: with --keys everybody must listen, for whoever passed on what others say could say anything"
        )
    for option, address in (("--listen", listen), *(("--connect", address) for address in connect)):
        is_tls = address.startswith("tls/")
        if keys is not None and not is_tls and address != MULTICAST:
            raise InputError(
                f"{option} {address}: with --keys everything is encrypted; an address looks like tls/127.0.0.1:7447"
            )
        if is_tls and "[" in address:
            raise InputError(f"{option} {address}: Zenoh's TLS has no IPv6 addresses; give one of IPv4")
        if keys is None and is_tls:
            raise InputError(f"{option} {address}: there is no TLS without --keys FOLDER; peakmesh keys init makes it")
    if keys is None and not insecure and reaches_other_machines(listen):
        raise InputError(
            f"--listen {listen}: other machines could take part and forge everything; "
            "--keys FOLDER keeps them out, --insecure lets them in"
        )
