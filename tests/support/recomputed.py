"""A recording's numbers made again by the roles' own arithmetic, on this processor.

    python recomputed.py RECORDING [--blas]

Prints in how many steps a node or the plant comes out otherwise, and of how many; with --blas BLAS does the products.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

import agent.estimates
import agent.filter
import agent.roles.plant
from agent.contract.gains import Gains
from agent.contract.keys import MODE, PLANT_STATE, data_topics, decode, estimate, measurement
from agent.contract.messages import Message
from agent.contract.recording.reader import RecordingReader
from agent.contract.schedule import Deliveries
from agent.roles.plant import SimulatedPlant

Messages = dict[tuple[str, int], Message]


def recompute(gains: Gains, seed: int, messages: Messages) -> list[bool]:
    """Whether each number comes out as it was recorded: of every step, the plant's, then each node's."""
    problem, plant = gains.problem, SimulatedPlant(gains.problem, seed=seed, worst_case=gains.worst_case)
    deliveries, same = Deliveries(problem, seed=seed), []
    slices = {name: gains.for_node(name) for name in problem.node_names}
    for k in range(max(step for topic, step in messages if topic == MODE)):
        state, measured = plant.advance(k)
        same += [state == messages[PLANT_STATE, k]]
        same += [y == messages[measurement(name), k] for name, y in measured.items()]
        told = {name: messages[estimate(name), k] for name in slices}
        pairs = {name: agent.filter.Pair(np.array(one.x_hat), np.array(one.innovation)) for name, one in told.items()}
        mode, phi = messages[MODE, k].mode, deliveries.at(k)
        for i, (name, own) in enumerate(slices.items()):
            senders = [link.sender for link in own.links[mode]]
            heard = {j: pairs[j] for j in senders if phi[i, problem.node_index(j)]}
            x_hat = agent.filter.step(own, mode, heard)
            nu = agent.filter.innovation(own, np.array(messages[measurement(name), k + 1].y), x_hat)
            pair = agent.filter.Pair(x_hat, nu)
            same += [agent.estimates.told(own, k + 1, pair, mode=mode, heard=heard) == messages[estimate(name), k + 1]]
    return same


def main(recording: Path, *, by_blas: bool) -> None:
    if by_blas:
        for module in (agent.filter, agent.estimates, agent.roles.plant):
            module.product = np.matmul
    messages: Messages = {}
    with RecordingReader(recording) as reader:
        topics = data_topics(reader.gains.problem)
        for logged in reader.messages():
            if logged.topic in topics:
                message = decode(logged.topic, logged.payload)
                messages[logged.topic, message.step] = message
        same = recompute(reader.gains, int(reader.run["seed"]), messages)
    print(same.count(False), len(same))


if __name__ == "__main__":
    main(Path(sys.argv[1]), by_blas="--blas" in sys.argv)
