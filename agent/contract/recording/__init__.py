"""One run in one MCAP file: everything that was on the wire, and everything needed to check it.

Metadata `run` comes first and `end` last; problem.json, gains.json and a Foxglove layout are attached. A file
without `end` was cut. Messages are the wire's own bytes; log_time is the recorder's clock, publish_time the
sender's, sequence the sender's own numbering. Order by step and sender, never by time.

`writer` writes a run, whole or in `parts`, `reader` reads one; `evidence` tells whether its messages are those that
were sent. Only this folder imports mcap.
"""

from __future__ import annotations

from typing import NamedTuple

FORMAT = "peakmesh-recording"
VERSION = "1"


class Logged(NamedTuple):
    """One recorded message. Times are in ns since the epoch."""

    topic: str
    payload: bytes
    number: int
    log_time: int
    publish_time: int
