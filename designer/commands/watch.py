"""`peakmesh watch`: a run, live in the terminal."""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from importlib.util import find_spec
from typing import TYPE_CHECKING

from agent.commands.looking import add_looker, look_on
from agent.commands.options import Subcommands, load_gains
from agent.commands.variables import heed_variables
from agent.contract.errors import EXIT_GOOD, InputError, RunBroken

if TYPE_CHECKING:
    from agent.commands.looking import Onlooker
    from designer.watch.scene import Scene, Seen

FRAME_SECONDS = 0.25  # a terminal is drawn anew
LINE_SECONDS = 1.0  # something else gets a line
LEDGER_SECONDS = 0.1  # of a frame for the ledger; the rest waits
ONCE_SECONDS = 10.0  # after which --once tells what it knows
NICE = 10  # on the machine of a run it is the one to wait

Show = Callable[["Seen", bool], None]  # the second: whether it is the last


def add_watch(commands: Subcommands, environment: Mapping[str, str] = os.environ) -> None:
    """Describe `watch` to the parser; what its options are by default may stand in the environment."""
    watch = add_looker(commands, "watch", watch_command, "show a running network in the terminal; it takes no part")
    watch.add_argument("--once", action="store_true", help="print one state, and leave")
    watch.add_argument("--json", action="store_true", help="print a JSON object each second, or one with --once")
    heed_variables(watch, environment)


def watch_command(options: argparse.Namespace) -> int:
    """`peakmesh watch --connect ADDRESS`: it may come late, and leave at any time."""
    from designer.watch.scene import Scene

    gains = load_gains(options.gains) if options.gains is not None else None
    with look_on(options) as onlooker:
        os.nice(NICE)
        scene = Scene(onlooker.run)
        with _showing(options) as show:
            _watch(onlooker, scene, show, once=options.once, wait=options.wait, digest=gains.digest() if gains else "")
    return EXIT_GOOD


def _watch(onlooker: Onlooker, scene: Scene, show: Show, *, once: bool, wait: float, digest: str) -> None:
    """Until the run has ended, or one state is shown. RunBroken where the coordinator does not come back in `wait`."""
    from agent.contract.keys import COORDINATOR

    began = seen_last = time.monotonic()
    while True:
        _take_in(onlooker, scene, time.monotonic() + FRAME_SECONDS, digest)
        now = time.monotonic()
        scene.settle(now, _after(LEDGER_SECONDS))
        over = scene.is_over()
        is_all = over or (once and (scene.is_complete or now >= began + ONCE_SECONDS))
        if is_all or not once:
            show(scene.seen(), is_all)
        if is_all:
            return
        seen_last = now if COORDINATOR in onlooker.present else seen_last
        if now >= seen_last + wait:
            raise RunBroken(f"the coordinator was lost, and did not come back within {wait:g} s")


def _after(seconds: float) -> Callable[[], bool]:
    """Whether so long has passed from now on."""
    until = time.monotonic() + seconds
    return lambda: time.monotonic() >= until


def _take_in(onlooker: Onlooker, scene: Scene, deadline: float, digest: str) -> None:
    """What is published until the deadline, and who has come and gone."""
    from agent.contract.keys import decode

    for sample, at in onlooker.until(deadline):
        try:
            message = decode(sample.topic, sample.payload)
        except RunBroken:  # somebody says what is no message
            scene.unreadable += 1
        else:
            scene.hear(sample.topic, message, at)
    onlooker.heed()
    scene.present(onlooker.present)
    if scene.gains is None and onlooker.facts is not None:
        _learn(onlooker, scene, digest)


def _learn(onlooker: Onlooker, scene: Scene, digest: str) -> None:
    """The facts of the run, and its gains, of which the gamma is proved here."""
    from agent.contract.gains import Gains
    from designer.replay.gamma import checked_gamma

    facts = onlooker.facts
    assert facts is not None
    gains = Gains.from_bytes(facts.gains.encode(), source=f'what run "{onlooker.run}" says')
    if digest and gains.digest() != digest:
        raise InputError(
            f'run "{onlooker.run}" has other gains ({gains.digest()[:12]}...) than the file ({digest[:12]}...)'
        )
    scene.learn(facts.start, gains, unproved=checked_gamma(gains).failure)


@contextmanager
def _showing(options: argparse.Namespace) -> Iterator[Show]:
    """What takes a state and shows it: a terminal's screen, lines, or JSON."""
    to_look_at = not options.json and (options.once or sys.stdout.isatty())
    if to_look_at and not find_spec("rich"):
        print("lines, for a table needs rich: pip install 'peakmesh[design]'", file=sys.stderr)
        to_look_at = False
    if not to_look_at:
        yield _print_json() if options.json else _print_lines()
    elif options.once:
        yield _print_table
    else:
        from rich.console import Console
        from rich.live import Live

        from designer.watch.table import table

        with Live(console=Console(), auto_refresh=False, vertical_overflow="crop") as live:
            yield lambda seen, is_all: live.update(table(seen), refresh=True)


def _print_json() -> Show:
    """One object, or one a second, each with the events since the one before."""
    last, due = -1, 0.0

    def show(seen: Seen, is_all: bool) -> None:
        nonlocal last, due
        if is_all or time.monotonic() >= due:
            due = time.monotonic() + LINE_SECONDS
            document = seen.document()
            document["events"] = [told for told in document["events"] if told["number"] > last]
            last = max([last, *(told.number for told in seen.events)])
            print(json.dumps(document), flush=True)

    return show


def _print_table(seen: Seen, is_all: bool) -> None:
    """As it is, once."""
    from rich.console import Console

    from designer.watch.table import table

    Console(width=None if sys.stdout.isatty() else 120).print(table(seen))


def _print_lines() -> Show:
    """A line a second."""
    from designer.watch.lines import lines

    last, due = -1, 0.0

    def show(seen: Seen, is_all: bool) -> None:
        nonlocal last, due
        if is_all or time.monotonic() >= due:
            due = time.monotonic() + LINE_SECONDS
            print("\n".join(lines(seen, after=last)), flush=True)
            last = max([last, *(told.number for told in seen.events)])

    return show
