"""Writers that are killed: python killed_writers.py FOLDER HOW_MANY.

Each writes a recording in parts to FOLDER until it is killed -9, at a moment drawn from a seed. Prints, for each, how
many messages it had flushed at least.
"""

from __future__ import annotations

import os
import random
import signal
import struct
import sys
from pathlib import Path

from made_recordings import random_gains, random_problem

from agent.contract.recording import Logged, writer
from agent.contract.recording.writer import RecordingWriter, Split

GAINS = random_gains(random_problem(1, ny=(1,), modes=1))
COUNT = struct.Struct("<I")


def write(path: Path, pipe: int) -> None:
    """Write for ever; how many messages are flushed goes to `pipe`."""
    writer.FLUSH_SECONDS = 0.0
    with RecordingWriter(path, run={"run": path.stem}, gains=GAINS, split=Split(size=5000)) as recording:
        for number in range(1_000_000):
            recording.add(Logged("event", b'{"step":%d}' % number, number, number, number))
            if number % 5 == 0:
                recording.flush_when_due()
                os.write(pipe, COUNT.pack(number + 1))
            if recording.part_is_full:
                recording.next_part({})


def main() -> None:
    folder, chance = Path(sys.argv[1]), random.Random(1)
    for number in range(int(sys.argv[2])):
        ours, its = os.pipe()
        child = os.fork()
        if child == 0:
            write(folder / f"run-{number}.mcap", its)
        os.close(its)
        flushed = 0
        for _ in range(chance.randrange(1, 200)):
            (flushed,) = COUNT.unpack(os.read(ours, COUNT.size))
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
        os.close(ours)
        print(flushed)


if __name__ == "__main__":
    main()
