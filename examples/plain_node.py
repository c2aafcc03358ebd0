"""A node without peakmesh: Python, zenoh and JSON, told what to be by variables. docs/protocol.md says the rest."""

import hashlib
import json
import os
import queue
import struct
import time
from functools import reduce
from itertools import count
from pathlib import Path

import zenoh

RUN, NODE, ADDRESS, GAINS = (os.environ[f"PEAKMESH_{name}"] for name in ("RUN", "NODE", "CONNECT", "GAINS"))
WHO, BASE, IDENTITY = f"node-{NODE}", f"peakmesh/{RUN}/", f"{time.time_ns():020d}-plain"
ESTIMATE, MEASUREMENT, BLOCK = f"node/{NODE}/estimate", f"node/{NODE}/measurement", zenoh.CongestionControl.BLOCK
config = {"mode": "client", "connect": {"endpoints": [ADDRESS]}, "transport": {"link": {"tx": {"lease": 20000}}}}
session = zenoh.open(zenoh.Config.from_json5(json.dumps(config)))
gains, digest = json.loads(Path(GAINS).read_bytes()), hashlib.sha256(Path(GAINS).read_bytes()).hexdigest()
K, H, problem = gains["K"], gains["H"], gains["problem"]
links, unbiased, A, M = problem.get("link", []), problem.get("unbiased"), problem["plant"]["A"], problem["plant"]["M"]
nodes = {node["name"]: node for node in problem["node"]}
C, is_seen, i = nodes[NODE]["C"], nodes[NODE].get("loss") == "seen", list(nodes).index(NODE)
hears = {m["name"]: {j: a for j, a in zip(nodes, m["adjacency"][i], strict=True) if a > 0} for m in problem["topology"]}
inbox, there, present, kept, words, numbers = queue.SimpleQueue(), {}, set(), [], count(), count()
said = {"control": {"order": ""}, "acknowledged": {"received": {}, "closed": False}}  # the last words of those two
linked = {"coordinator", "recorder", *(f"node-{j}" for j in nodes)}


def times(matrix, vector):  # every row multiplied out, then summed from left to right: so everybody has these bits
    return [reduce(lambda a, b: a + b, (g * v for g, v in zip(row, vector, strict=True))) for row in matrix]


def innovation(y, x):  # equation (4); [] is y where nothing arrived
    expected, beta = times(C, x), 1.0 if is_seen else nodes[NODE]["arrival_probability"]
    return [v - beta * e for v, e in zip(y or expected, expected, strict=True)]


def step(mode, x, nu, heard):  # equation (5); for a pair that was not heard stands what the node knows itself
    rows, told = (A, x) if unbiased else ([[]] * len(x), [])
    for j, a in hears[mode].items():
        x_j, nu_j = (x, nu) if j == NODE else heard.get(j, (x, [0.0] * len(nodes[j]["C"])))
        both = zip(rows, K[mode][NODE][j], H[mode][NODE][j], strict=True)
        rows = [[*row, *(a * g for g in (*K_r, *H_r))] for row, K_r, H_r in both]
        told = [*told, *(v - w if unbiased else v for v, w in zip(x_j, x, strict=True)), *nu_j]
    return times(rows, told)


def drawn(k, m, seed):  # for link m at step k: a word of Philox 4x64-10 with key (seed, 4), four of them a count
    c, low, high, bits = (k * -(-len(links) // 4) + m // 4 + 1, 0, 0, 0), seed, 4, 2**64 - 1
    for _ in range(10):
        p, q = 0xD2E7470EE14C6C93 * c[0], 0xCA5A826395121157 * c[2]
        c = q >> 64 ^ c[1] ^ low, q & bits, p >> 64 ^ c[3] ^ high, p & bits
        low, high = low + 0x9E3779B97F4A7C15 & bits, high + 0xBB67AE8584CAA73B & bits
    return (c[m % 4] >> 11) * 2.0**-53


def lost(k, seed):  # whose message of step k the model loses
    mine = [(m, link) for m, link in enumerate(links) if link["receiver"] == NODE]
    return {link["sender"] for m, link in mine if drawn(k, m, seed) >= link["delivery_probability"]}


def say(topic, **word):  # what runs the run
    word |= {"who": WHO, "session": IDENTITY, "number": next(words)}
    session.put(f"{BASE}{topic}/{WHO}", json.dumps(word), congestion_control=BLOCK)


def publish(topic, place, **message):  # numbered, signed, and kept until the recorder has it
    payload, number = json.dumps(message, allow_nan=False).encode(), next(numbers)
    digests = (f"{topic}\0".encode() + payload, 16), (IDENTITY.encode(), 8)
    signed = b"".join(hashlib.blake2b(text, digest_size=size).digest() for text, size in digests)
    kept.append((number, payload, struct.pack("<QQ", number, time.time_ns()) + f"{WHO}\0".encode() + signed, place))
    session.put(BASE + place, payload, attachment=kept[-1][2], congestion_control=BLOCK)


def answer(query):  # the recorder lacks something
    with query:
        for _, payload, stamp, place in [sent for sent in kept if sent[0] >= int(query.parameters["from"])]:
            query.reply(BASE + place, payload, attachment=stamp)


def hear(sample):  # on threads of zenoh's
    word = sample.payload.to_bytes() or json.dumps(sample.kind == zenoh.SampleKind.PUT)  # tokens are empty
    inbox.put((str(sample.key_expr).removeprefix(BASE), word, time.monotonic()))


def heed(topic, payload, at):
    word, (kind, *who) = json.loads(payload), topic.split("/")
    if kind in ("mode", "node"):
        there.setdefault((topic, word["step"]), (word, at))
    elif kind == "session":
        (present.add if word else present.discard)(who[0])
        if who[0] == "coordinator" and not word and said["control"]["order"] != "close":
            raise SystemExit("the coordinator was lost")
    elif word.get("order") != "start" or word["cast"].get(WHO) == IDENTITY:
        said[kind] = word
        kept[:] = [sent for sent in kept if sent[0] >= said["acknowledged"]["received"].get(WHO, 0)]
        if kind == "control" and word["order"] in ("close", "stop"):
            wait(lambda: said["acknowledged"]["closed"] or "recorder" not in present)
            raise SystemExit(word["reason"] or not said["acknowledged"]["closed"] or bool(kept))
    elif WHO in word["cast"]:
        raise SystemExit("another process has this name in the run")


def wait(condition, *about):
    while not (found := condition(*about)):
        heed(*inbox.get())
    return found


def lock_step(start):
    if start["period"]:
        raise SystemExit("this run goes against the clock; paced_node.py can do that")
    x, mode, heard = [0.0] * len(A), "", []
    for k in range(start["steps"]):
        nu = innovation(wait(there.get, (MEASUREMENT, k))[0]["y"], x)
        publish(ESTIMATE, ESTIMATE, step=k, x_hat=x, innovation=nu, z_hat=times(M, x), mode=mode, heard=heard)
        mode, gone = wait(there.get, ("mode", k))[0]["mode"], lost(k, start["seed"])
        heard = [j for j in hears[mode] if j not in gone]
        told = {j: wait(there.get, (f"node/{j}/estimate", k))[0] for j in heard if j != NODE}
        x = step(mode, x, nu, {j: (word["x_hat"], word["innovation"]) for j, word in told.items()})
        [there.pop(old) for old in list(there) if old[1] <= k]


def run(steps):
    topics = ["mode", MEASUREMENT, *(f"node/{j}/estimate" for j in nodes if j != NODE), "control", "acknowledged"]
    tokens, ordered = session.liveliness(), zenoh.handlers.Callback(hear, indirect=False)  # among topics, too
    declared = [session.declare_subscriber(BASE + topic, ordered) for topic in topics]
    declared += [tokens.declare_subscriber(f"{BASE}session/*/*", ordered, history=True)]
    declared += [session.declare_queryable(f"{BASE}replay/{WHO}", answer)]
    declared += [tokens.declare_token(BASE + own) for own in (f"session/{WHO}/{IDENTITY}", f"alive/{WHO}")]
    wait({"coordinator"}.issubset, present)
    say("joining", version="0.1.0", listen="none", machine="", lease=20.0, lacks=sorted(linked - present))
    wait(lambda: linked <= present or said["control"]["order"] == "start")
    say("ready", gains=digest)
    wait(lambda: said["control"]["order"] == "start")
    steps(said["control"])
    wait(lambda: False)


if __name__ == "__main__":
    with session:
        run(lock_step)
