"""How large a message can be in a run of a problem: the network drops what is larger before anybody reads it. Pure."""

from __future__ import annotations

from agent.contract.keys import data_topics, participants, sensor_who
from agent.contract.problem import Problem

WORDS = 2**16  # bytes: an event about 1024 steps, with a long sentence, has 58 000
NUMBER = 25  # bytes: -2.2250738585072014e-308, and a comma
EACH = 64  # bytes said of each participant, beside its name: its session, or the last number and the last step


def largest(problem: Problem) -> int:
    """In bytes, with what is attached: no message of any kind is larger."""
    most = max(len(node.C) for node in problem.nodes)  # numbers in a measurement
    numbers = problem.nx + problem.nz + max(problem.nw, most) + problem.n
    everybody = [*participants(problem), *map(sensor_who, problem.node_names)]
    names = sum(3 * len(who) + EACH for who in everybody) + sum(len(topic) + 3 for topic in data_topics(problem))
    return WORDS + NUMBER * numbers + names
