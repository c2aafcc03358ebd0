"""How large messages can be in a run of a problem: what is larger is dropped. Pure.

The network drops what is larger than any, before anybody reads it; the guard knows the topic, and its longest.
"""

from __future__ import annotations

from agent.contract.keys import ACCOUNT, EVENT, data_topics, participants, sensor_who
from agent.contract.messages import DIGEST_SIZE, TAG_SIZE, Stamp
from agent.contract.problem import Problem

NUMBER = 26  # bytes: -2.2250738585072014e-308, a comma, and one to spare
REST = 512  # bytes of a data message that are neither numbers of a vector nor names
EVENTS = 2**16  # bytes: an event about 1024 steps, with a long sentence, has 58 000
WORDS = 2**16  # bytes of a word, but for what it says of each participant and topic
EACH = 64  # bytes said of each participant, beside its name: its session, or the last number and the last step
_OF_AN_ACCOUNT = 16  # numbers


def vectors(problem: Problem, topic: str) -> dict[str, int]:
    """What vectors the messages of a data topic have, and of how many numbers."""
    match topic.split("/"):
        case ["plant", "state"]:
            return {"x": problem.nx, "z": problem.nz, "w": problem.nw, "arrived": problem.n}
        case ["node", name, "measurement"]:
            return {"y": len(problem.nodes[problem.node_index(name)].C)}
        case ["node", name, "estimate"]:
            ny = len(problem.nodes[problem.node_index(name)].C)
            return {"x_hat": problem.nx, "innovation": ny, "z_hat": problem.nz}
    return {}


def longest(problem: Problem) -> dict[str, int]:
    """By topic, how many bytes a data message can have, without what is attached."""
    names = sum(len(name.encode()) + 3 for name in (*problem.node_names, *problem.mode_names))
    by_topic = {topic: REST + names + NUMBER * sum(vectors(problem, topic).values()) for topic in data_topics(problem)}
    return by_topic | {EVENT: EVENTS, ACCOUNT: REST + _OF_AN_ACCOUNT * NUMBER}


def largest(problem: Problem) -> int:
    """In bytes, with what is attached: no message of any kind is larger."""
    everybody = [*participants(problem), *map(sensor_who, problem.node_names)]
    attached = len(Stamp(0, 0, max(everybody, key=len), bytes(DIGEST_SIZE), bytes(TAG_SIZE)).encode())
    names = sum(3 * len(who) + EACH for who in everybody) + sum(len(topic) + 3 for topic in data_topics(problem))
    return max(max(longest(problem).values()) + attached, WORDS + names)
