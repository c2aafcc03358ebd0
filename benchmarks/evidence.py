"""What the evidence costs a message: processor time of sender and recorder, bytes in the file.

    python benchmarks/evidence.py [RECORDING]

The messages of a recording, the golden one by default, are stamped and recorded several times over, with digests and
without. Times are processor time, the least of several.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import NamedTuple

from agent.contract.gains import Gains
from agent.contract.keys import EVIDENCE, decode, sender_of
from agent.contract.messages import Stamp, digest_of
from agent.contract.recording import Logged
from agent.contract.recording.reader import RecordingReader
from agent.contract.recording.writer import Split
from agent.network.words import Sample
from agent.roles.record import Record

GOLDEN = Path(__file__).parents[1] / "recordings" / "golden" / "zhu2020-lossy.mcap"
AT_LEAST = 20_000  # messages


class Cost(NamedTuple):
    """Of a message: microseconds of the sender, of the recorder, bytes in the file."""

    sender: float
    recorder: float
    size: float


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("recording", nargs="?", type=Path, default=GOLDEN)
    parser.add_argument("--repeat", type=int, default=7)
    options = parser.parse_args()
    with RecordingReader(options.recording) as reader:
        gains, messages = reader.gains, [message for message in reader.messages() if message.topic != EVIDENCE]
    costs = {
        evidence: least([cost(messages, gains, evidence=evidence) for _ in range(options.repeat)])
        for evidence in (False, True)
    }
    print(f"{'of a message':14} {'sender us':>10} {'recorder us':>12} {'bytes':>8}")
    for evidence, of in costs.items():
        print(f"{'with evidence' if evidence else 'without':14} {of.sender:10.2f} {of.recorder:12.2f} {of.size:8.1f}")
    without, with_it = costs[False], costs[True]
    time_of_both = with_it.sender + with_it.recorder - without.sender - without.recorder
    print(f"evidence: {time_of_both:.2f} us, {100 * (with_it.size / without.size - 1):.1f} % of the file")


def least(costs: list[Cost]) -> Cost:
    return Cost(*map(min, zip(*costs, strict=True)))


def cost(messages: list[Logged], gains: Gains, *, evidence: bool) -> Cost:
    """Stamp and record the messages over and over."""
    numbers = Counter[str]()
    sent: list[tuple[str, Logged, int, int]] = []
    while len(sent) < AT_LEAST:
        for message in messages:
            who = sender_of(message.topic)
            sent.append((who, message, numbers[who], decode(message.topic, message.payload).step))
            numbers[who] += 1
    began = time.process_time()
    attachments = [
        Stamp(number, 0, who, digest_of(logged.topic, logged.payload) if evidence else b"").encode()
        for who, logged, number, _ in sent
    ]
    stamped = time.process_time()
    taken = [
        (Sample(logged.topic, logged.payload, Stamp.decode(attachment)), step)
        for (_, logged, _, step), attachment in zip(sent, attachments, strict=True)
    ]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "run.mcap"
        with Record(path, run={}, gains=gains, force=False, split=Split()) as record:
            begun = time.process_time()
            for sample, step in taken:
                record.take(sample, step)
            recorded = time.process_time()
            record.finish(status="finished", reason="")
        size = path.stat().st_size
    return Cost((stamped - began) / len(sent) * 1e6, (recorded - begun) / len(sent) * 1e6, size / len(sent))


if __name__ == "__main__":
    main()
