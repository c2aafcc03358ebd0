"""Evidence: whether the messages of a recording are those that were sent, and which one is not.

Every sender states a digest of each message beside it (`digest_of`, in its Stamp). The recorder keeps the first four
bytes of each, 64 at a time, as messages on the topic `evidence`, and chains the whole digests: the head after a
message is BLAKE2b(head before it + its digest), 16 bytes, beginning with zeros. `end` holds the last head of every
sender. So a message that was flipped, dropped, exchanged or put in later is named by sender and number, whichever
tool did it, and each is judged by itself: what is left of a filtered, sorted, split or merged file still is.

What this cannot find: whoever changes a message *and* computes the evidence anew, as nothing is signed. Only
somebody who wrote down the heads of `end` elsewhere then sees that they have changed. Nor does it say anything about
times, or about messages whose sender gives no digests.

`chains` is the recorder's side; `examiner` judges a recording, sender by sender (`sender`).
"""

from __future__ import annotations

import hashlib

from agent.contract.messages import DIGEST_SIZE

BLOCK = 64  # digests in one message of evidence
SHORT = 4  # bytes of each that are kept
FIRST_HEAD = bytes(DIGEST_SIZE)
NO_DIGEST = "-" * (2 * SHORT)  # in the place of a digest that there is not


def next_head(head: bytes, digest: bytes) -> bytes:
    """The head of a chain after one more message."""
    return hashlib.blake2b(head + digest, digest_size=DIGEST_SIZE).digest()
