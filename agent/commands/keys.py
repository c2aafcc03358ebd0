"""`peakmesh keys`: certificates for everybody who takes part in a network."""

from __future__ import annotations

import argparse
import json
import shutil
import tempfile
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING

from agent.commands.options import Subcommands, add_command, count
from agent.contract.errors import EXIT_GOOD, EXIT_NO, InputError, listed

if TYPE_CHECKING:
    from agent.authority import Certificate
    from agent.contract.problem import Problem

DAYS, AUTHORITY_DAYS = 365, 3650
LONGEST_DAYS = 36_500


def _load(path: str) -> Problem:
    from agent.contract.problem import Problem

    return Problem.load(Path(path))


def add_keys(commands: Subcommands, *, find: Callable[[str], Problem] = _load, about: str = "problem file") -> None:
    """Describe `keys` to the parser; `find` reads what the option --problem takes, which `about` says."""
    keys = commands.add_parser(
        "keys", help="certificates, so that nobody else can take part or say anything", allow_abbrev=False
    )
    actions = keys.add_subparsers(dest="action", required=True, metavar="ACTION")
    init = add_command(actions, "init", init_command, "make an authority, and a certificate for everybody")
    init.add_argument("--problem", required=True, metavar="PROBLEM", help=about)
    init.add_argument("-o", "--output", type=Path, default=Path("keys"), metavar="FOLDER", help="a new one (keys)")
    init.add_argument(
        "--external", action="append", default=[], metavar="NODE", help="one for its sensor, too; may be repeated"
    )
    init.add_argument(
        "--authority-days", type=_days, default=AUTHORITY_DAYS, metavar="N", help="of the authority (3650)"
    )
    init.set_defaults(find=find)
    renew = add_command(actions, "renew", renew_command, "replace certificates and their private keys by new ones")
    renew.add_argument("folder", type=Path, metavar="FOLDER", help="from keys init, with the authority's private key")
    renew.add_argument(
        "who", nargs="*", metavar="WHO", help="such as node-2, or the sensor of a node (all that are there)"
    )
    show = add_command(actions, "show", show_command, "say whose certificates are there, and until when")
    show.add_argument("folder", type=Path, metavar="FOLDER", help="of anybody")
    for parser in (init, renew):
        parser.add_argument("--days", type=_days, default=DAYS, metavar="N", help="that certificates are valid (365)")
    for parser in (init, renew, show):
        parser.add_argument("--json", action="store_true", help="print one JSON object")


def _days(text: str) -> int:
    days = count(text)
    if days > LONGEST_DAYS:
        raise argparse.ArgumentTypeError(f"{text} is more than {LONGEST_DAYS} days")
    return days


def init_command(options: argparse.Namespace) -> int:
    """`peakmesh keys init --problem PROBLEM`: the folder is there whole, or not at all."""
    from agent.authority import Authority
    from agent.contract.keys import VIEWER, participants, sensor_who

    problem, folder = options.find(options.problem), options.output
    for node in options.external:
        problem.node_index(node)
    if folder.exists():
        raise InputError(f"{folder} exists already; give another name, or let peakmesh keys renew make new ones in it")
    if not folder.parent.is_dir():
        raise InputError(f"the folder {folder.parent} does not exist; create it first")
    whos = [*participants(problem), *dict.fromkeys(map(sensor_who, options.external)), VIEWER]
    part = Path(tempfile.mkdtemp(prefix=f".{folder.name}.", dir=folder.parent))  # nobody else may read there
    try:
        Authority.create(part, problem.name, days=options.authority_days).issue(whos, days=options.days)
        part.rename(folder)
    finally:
        shutil.rmtree(part, ignore_errors=True)
    return _tell(options, folder)


def renew_command(options: argparse.Namespace) -> int:
    """`peakmesh keys renew FOLDER [WHO...]`."""
    from agent.authority import Authority
    from agent.contract.keys import node_who, sensor_who

    authority = Authority.load(options.folder)
    there = sorted(path.stem for path in options.folder.glob("*.pem") if path.with_suffix(".key").exists())
    there.remove("ca")
    sensors = [who.replace(node_who(""), sensor_who(""), 1) for who in there if who.startswith(node_who(""))]
    for who in options.who:
        if who not in there and who not in sensors:
            raise InputError(
                f'{options.folder} has nothing of "{who}"; there are {listed(there)}, and nodes may have sensors'
            )
    authority.issue(dict.fromkeys(options.who) or there, days=options.days)
    return _tell(options, options.folder, only=options.who)


def show_command(options: argparse.Namespace) -> int:
    """`peakmesh keys show FOLDER`: exit 1 where something is wrong with one of them."""
    return _tell(options, options.folder)


def _tell(options: argparse.Namespace, folder: Path, *, only: Iterable[str] = ()) -> int:
    from agent.authority import certificates

    found = [certificate for certificate in certificates(folder) if not only or certificate.who in only]
    if options.json:
        print(json.dumps({"folder": str(folder), "certificates": [_document(each) for each in found]}))
    else:
        print("\n".join(_line(each) for each in found))
    return EXIT_NO if any(each.faults for each in found) else EXIT_GOOD


def _document(certificate: Certificate) -> dict[str, object]:
    return certificate._asdict() | {"begins": certificate.begins.isoformat(), "ends": certificate.ends.isoformat()}


def _line(certificate: Certificate) -> str:
    faults = "".join(f"  {fault.upper()}" for fault in certificate.faults)
    return f"{certificate.who:16} until {certificate.ends:%Y-%m-%d}  sha256 {certificate.fingerprint[:16]}{faults}"
