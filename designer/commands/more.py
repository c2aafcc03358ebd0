"""`peakmesh replay --with` and `--write`: what other gains would have done, and the verdict as a layer of the log."""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from agent.contract.errors import InputError
from agent.contract.files import refuse_overwrite

if TYPE_CHECKING:
    from designer.replay.log import Log
    from designer.replay.other_gains import OtherGains
    from designer.replay.part import Part


def add_more(replay: argparse.ArgumentParser) -> None:
    """Add the options of replay that ask for more than a verdict; they take one run."""
    replay.add_argument(
        "--with", dest="other", type=Path, metavar="GAINS", help="what other gains would have done in this run"
    )
    replay.add_argument(
        "--write",
        type=Path,
        metavar="FILE",
        help="write what was found at every step as an MCAP, to open with the run's",
    )
    replay.add_argument("--force", action="store_true", help="replace that file if it exists")


def replay_more(
    groups: Sequence[Sequence[Path]],
    options: argparse.Namespace,
    *,
    part: Part,
    report: Callable[[str, int, int], None],
) -> int:
    """Replay one run, in one file or in parts, and do what else was asked for."""
    from agent.contract.recording.reader import RecordingReader
    from designer.replay import judge
    from designer.replay.audit import Audit, write_audit
    from designer.replay.log import load
    from designer.replay.times import Times

    if len(groups) > 1:
        raise InputError(f"--with and --write take one run; these are {len(groups)}")
    if options.write is not None:
        refuse_overwrite(options.write, force=options.force)
    paths, choice = groups[0], {"run": options.run, "gains": options.gains}
    log = load(paths, part=part, report=lambda done, of: report("reading", done, of), **choice)
    other = _other_gains(log, options.other) if options.other is not None else None
    audit = Audit(log) if options.write is not None else None
    verdict = judge(log, audit, part=part, report=report)
    facts, texts = verdict.document(), [verdict.text()]
    if audit is not None:
        with RecordingReader(*paths, **choice) as reader:
            times = Times(reader.messages(), log.steps)
        write_audit(log, verdict, audit, times, options.write, force=options.force)
        facts["written"] = str(options.write)
        texts.append(f"layer      {options.write}, to be opened with the recording or merged with it")
    if other is not None:
        facts["what_if"] = other.document()
        texts.append(other.text())
    print(json.dumps(facts) if options.json else "\n\n".join(texts))
    return verdict.exit_code


def _other_gains(log: Log, path: Path) -> OtherGains:
    """The run with other gains; refuses what does not fit its problem."""
    from designer.analysis import load_given
    from designer.replay.other_gains import run_other

    problem = log.gains.problem
    given = load_given(path, problem)
    foreign = given.file is not None and given.file.problem_digest != problem.digest()
    source = f"{given.source} (designed for another problem)" if foreign else given.source
    return run_other(log, given.K, given.H, source=source)
