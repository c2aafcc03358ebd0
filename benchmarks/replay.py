"""How fast replay, show and recover are, and in how much memory, beside the least that any reader must do.

    python benchmarks/replay.py [--nodes 4] [--steps 10000] [--folder FOLDER]

Writes its own recording into a temporary folder: one process plays all the roles, with the runtime's own step. Each
measurement is a fresh process, so that its peak memory is its own; seconds are of processor time. The references are
mcap's StreamReader, checking checksums, doing nothing with the messages or decoding their JSON. --steps 200000 gives
2 million messages.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

from agent import filter as node
from agent.contract import keys, messages, schedule
from agent.contract.gains import Certificate, Gains, Solver
from agent.contract.problem import Problem
from agent.contract.recording import Logged
from agent.contract.recording.evidence.chains import Chains
from agent.contract.recording.writer import RecordingWriter
from agent.roles.plant import SimulatedPlant

CHILD = """
import json, resource, sys, time
from pathlib import Path
{imports}
started = time.process_time()
facts = {call}
seconds = time.process_time() - started
peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
print(json.dumps(dict(facts, seconds=seconds, megabytes=peak)))
"""
_STREAM = "from mcap.records import Message\nfrom mcap.stream_reader import StreamReader"
_RECORDS = "StreamReader(open(sys.argv[1], 'rb'), validate_crcs=True).records"
REFERENCE = "StreamReader and json"
PROGRAMS = {
    "StreamReader alone": CHILD.format(
        imports=_STREAM, call=f"dict(messages=sum(isinstance(record, Message) for record in {_RECORDS}))"
    ),
    REFERENCE: CHILD.format(
        imports=_STREAM,
        call=f"dict(messages=sum(bool(json.loads(r.data)) for r in {_RECORDS} if isinstance(r, Message)))",
    ),
    "replay": CHILD.format(
        imports="from designer.replay import replay",
        call="(lambda v: dict(good=v.outcome == 'agrees', messages=v.messages))(replay(Path(sys.argv[1])))",
    ),
    "show": CHILD.format(
        imports="from designer.show import describe",
        call="dict(messages=sum(describe(sys.argv[1])['messages'].values()))",
    ),
    "recover": CHILD.format(
        imports="from agent.contract.recording.recover import recover",
        call="dict(messages=recover([Path(sys.argv[1])], Path(sys.argv[1] + '.new'), force=True).messages)",
    ),
}


def ring(n: int) -> Gains:
    """n nodes that each hear the next one, or the one after it, with gains that keep the error bounded."""
    names = [str(i + 1) for i in range(n)]
    modes = [
        {"name": mode, "hears": {names[i]: [names[(i + far) % n]] for i in range(n)}}
        for mode, far in (("near", 1), ("far", 2))
    ]
    problem = Problem.from_document(
        {
            "name": f"ring-{n}",
            "plant": {"A": [[0.9, 0.2], [-0.2, 0.9]], "B": [[0.5], [1.0]], "M": [[1.0, 0.0]]},
            "node": [{"name": name, "C": [[1.0, 0.5]], "D": [[1.0]], "arrival_probability": 0.9} for name in names],
            "topology": modes,
            "markov": {"transition": [[0.7, 0.3], [0.4, 0.6]], "initial": "near"},
            "disturbance": {"kind": "white", "deviation": 0.1},
        }
    )
    heard = {
        mode: {name: [names[j] for j in problem.neighbours(s, i)] for i, name in enumerate(problem.node_names)}
        for s, mode in enumerate(problem.mode_names)
    }
    blocks = {
        letter: {
            mode: {i: {j: block / len(senders) for j in senders} for i, senders in receivers.items()}
            for mode, receivers in heard.items()
        }
        for letter, block in (("K", 0.9 * problem.plant.A), ("H", np.array([[0.1], [0.1]])))
    }
    return Gains(
        problem=problem,
        problem_digest=problem.digest(),
        method="benchmark",
        certificate=Certificate(gamma=1.0, kind="lyapunov", form="full", holds=False, verified="nothing", margins={}),
        solver=Solver(name="none", version="0", status="none", iterations=0, seconds=0.0),
        seconds={"total": 0.0},
        **blocks,
    )


def write(path: Path, gains: Gains, *, steps: int, seed: int) -> None:
    """The recording of a lock-step run."""
    problem = gains.problem
    run = {"run": "benchmark", "seed": str(seed), "steps": str(steps), "gains": gains.digest(), "external": ""}
    slices = {name: gains.for_node(name) for name in problem.node_names}
    hears = {
        name: {mode: [link.sender for link in links] for mode, links in part.links.items()}
        for name, part in slices.items()
    }
    plant, chain = SimulatedPlant(problem, seed=seed), schedule.modes(problem, seed=seed)
    x_hat, mode, sent = (
        {name: np.zeros(problem.nx) for name in problem.node_names},
        "",
        dict.fromkeys([keys.COORDINATOR, keys.PLANT, *map(keys.node_who, problem.node_names)], 0),
    )
    chains = Chains()
    with RecordingWriter(path, run=run, gains=gains) as writer:

        def put(topic: str, who: str, message: messages.Message) -> None:
            time, payload = (message.step + 1) * 1_000_000, message.encode()
            writer.add(Logged(topic, payload, sent[who], time, time))
            stamp = messages.Stamp(sent[who], time, who, messages.digest_of(topic, payload))
            evidence = chains.add(stamp, message.step)
            if evidence is not None:
                writer.add(Logged(keys.EVIDENCE, evidence.encode(), 0, time, time))
            sent[who] += 1

        for k in range(steps):
            state, measurements = plant.advance(k)
            pairs = {}
            for name, y in measurements.items():
                put(keys.measurement(name), keys.PLANT, y)
                innovation = node.innovation(slices[name], np.array(y.y), x_hat[name])
                pairs[name] = node.Pair(x_hat[name], innovation)
                estimate = messages.Estimate(
                    step=k,
                    x_hat=x_hat[name].tolist(),
                    innovation=innovation.tolist(),
                    z_hat=(problem.plant.M @ x_hat[name]).tolist(),
                    mode=mode,
                    heard=hears[name][mode] if k else [],
                )
                put(keys.estimate(name), keys.node_who(name), estimate)
            put(keys.PLANT_STATE, keys.PLANT, state)
            index = next(chain)
            mode = problem.mode_names[index]
            put(keys.MODE, keys.COORDINATOR, messages.Mode(step=k, mode=mode, index=index))
            x_hat = {name: node.step(part, mode, pairs) for name, part in slices.items()}
        for evidence in chains.rest(last=True):
            writer.add(Logged(keys.EVIDENCE, evidence.encode(), 0, steps * 1_000_000, steps * 1_000_000))
        writer.finish({"status": "finished", "reason": "", "steps": str(steps)})


def measure(program: str, path: Path) -> dict[str, float]:
    done = subprocess.run([sys.executable, "-c", program, str(path)], capture_output=True, text=True, check=True)
    return dict(json.loads(done.stdout))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--nodes", type=int, default=4)
    parser.add_argument("--steps", type=int, default=10_000)
    parser.add_argument("--repeat", type=int, default=3, help="the fastest of so many counts")
    parser.add_argument("--folder", type=Path, help="for the recording, which is kept there and used again")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        path = (options.folder or Path(temporary)) / f"ring-{options.nodes}-{options.steps}.mcap"
        if not path.exists():
            write(path, ring(options.nodes), steps=options.steps, seed=1)
        runs = [{name: measure(program, path) for name, program in PROGRAMS.items()} for _ in range(options.repeat)]
        size = path.stat().st_size
        path.with_name(path.name + ".new").unlink()
    best = {name: min((run[name] for run in runs), key=lambda facts: facts["seconds"]) for name in PROGRAMS}
    assert best["replay"]["good"]
    assert best["replay"]["messages"] == best["show"]["messages"]
    print(f"{options.nodes} nodes, {options.steps} steps, {best['show']['messages']} messages, {size / 1e6:.1f} MB")
    for name, facts in best.items():
        print(
            f"{name:22} {facts['seconds']:7.2f} s  {1e6 * facts['seconds'] / facts['messages']:5.1f} us/message  "
            f"{best[REFERENCE]['seconds'] / facts['seconds']:5.2f} of {REFERENCE}  peak {facts['megabytes']:4.0f} MB"
        )


if __name__ == "__main__":
    main()
