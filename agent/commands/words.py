"""What a run says while it goes on, and when it has ended."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from importlib.util import find_spec
from typing import Any


def say_to_launcher(word: dict[str, Any]) -> None:
    """A word of the coordinator, as a line of JSON."""
    print(json.dumps(word), flush=True)


def say_to_person(word: dict[str, Any]) -> None:
    """A word of the coordinator, as a sentence."""
    from agent.contract.keys import in_words

    match word:
        case {"listening": addresses}:
            print(f"listening at {', '.join(addresses)}", file=sys.stderr)
        case {"joined": who}:
            print(f"{in_words(who)} is there", file=sys.stderr)
        case {"started": _}:
            print("everybody is there: the run starts", file=sys.stderr)
        case {"broken_off": sentence}:
            say_broken_off(sentence)
        case {"warning": sentence}:
            say_warning(sentence)
        case {"summary": summary}:
            print(f"{summary['steps']} steps, {summary['messages']} messages recorded")
            for line in refused_text(summary.get("refused", {})):
                print(line)
            if off := summary["broken_off"] or summary["not_whole"]:
                print(f"NOT RECORDED TO THE END: {off}")


def say_broken_off(sentence: object) -> None:
    """That there is no recording any more, while the run may go on."""
    print(f"peakmesh: the recording broke off: {sentence}", file=sys.stderr, flush=True)


def say_warning(sentence: object) -> None:
    """What is not as it should be, though the run goes on."""
    print(f"peakmesh: warning: {sentence}", file=sys.stderr, flush=True)


@contextmanager
def progress(
    steps: int, *, live: str, run: str, external: Sequence[str] = ()
) -> Iterator[Callable[[dict[str, Any]], None]]:
    """A bar on stderr, where that is a terminal; the function takes the coordinator's words.

    `live` is the command that looks on, but for the address; who starts sensors of `external` nodes is told both.
    """

    def warn(word: dict[str, Any]) -> None:
        if "broken_off" in word:
            say_broken_off(word["broken_off"])
        if "warning" in word:
            say_warning(word["warning"])
        if "listening" in word:
            for node in external:
                print(
                    f'node "{node}" waits for its sensor: run {run}, address {word["listening"][0]}',
                    file=sys.stderr,
                    flush=True,
                )

    if not (sys.stderr.isatty() and find_spec("rich")):
        yield warn
        return
    from rich.console import Console
    from rich.progress import Progress

    with Progress(console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("waiting for everybody", total=steps)

        def show(word: dict[str, Any]) -> None:
            warn(word)
            if "listening" in word:
                address = f"--connect {word['listening'][0]}"
                for what, command in (("look on with", "peakmesh watch"), ("in Foxglove", live)):
                    bar.console.print(f"{what}: {command} {address}", highlight=False, soft_wrap=True)
            elif "started" in word:
                bar.update(task, description="steps")
            elif "complete" in word:
                bar.update(task, completed=word["complete"])

        yield show


def run_text(result: dict[str, Any]) -> str:
    """The facts of a run, for people."""
    from agent.contract.recording.parts import in_words

    files = result["parts"] or [result["recording"]]
    lines = [
        f"{result['steps']} steps, seed {result['seed']}: {result['messages']} messages recorded, "
        f"{result['missing']} missing",
        f"step 0 after {result['start_seconds']:.2f} s, then {result['rounds_per_second']:.0f} steps/s",
        f"recording  {in_words(files)}",
        f"next       peakmesh replay {files[0]}",  # it finds the other parts beside it
    ]
    if off := result["broken_off"] or result["not_whole"]:
        lines.insert(1, f"NOT RECORDED TO THE END: {off}")
    if "pacing" in result:
        lines[1:1] = pacing_text(result["pacing"])
    if "refused" in result:
        lines[1:1] = refused_text(result["refused"])
    return "\n".join(lines)


def refused_text(refused: dict[str, dict[str, dict[str, int]]]) -> list[str]:
    """What did not fit, for people: by whom it was refused, on which topic, and why."""
    from agent.contract.errors import counted
    from agent.contract.keys import in_words
    from agent.guard import in_words as kinds_in_words

    return [
        f"refused    {counted(sum(kinds.values()), 'message')} on {topic} by {in_words(who)}: {kinds_in_words(kinds)}"
        for who, counts in refused.items()
        for topic, kinds in counts.items()
    ]


def pacing_text(pacing: dict[str, Any]) -> list[str]:
    """How a paced run kept time, for people."""
    asked = pacing["pairs"]
    part = f" ({pacing['pairs_substituted'] / asked:.2%})" if asked else ""
    lines = [
        f"period {1e3 * pacing['period']:g} ms: {pacing['pairs_substituted']} of {asked} pairs substituted{part}, "
        f"{pacing['measurements_substituted']} measurements, {pacing['late']} messages late"
    ]
    for what, words in (("estimate", "measurement to estimate"), ("step", "tick to step")):
        if pacing["accounts"]:
            times = (f"{1e3 * pacing[f'to_{what}_{which}']:.2f}" for which in ("median", "p99", "max"))
            lines.append("{}: median {} ms, 99 % {} ms, most {} ms".format(words, *times))
    return lines
