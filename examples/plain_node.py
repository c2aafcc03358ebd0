"""A node without peakmesh: plain Python, zenoh and JSON; variables of the environment say which. See docs/protocol.md."""

import hashlib
import json
import os
import queue
import struct
import time
from functools import reduce
from pathlib import Path

import zenoh

RUN, NODE, ADDRESS, PATH = (os.environ[f"PEAKMESH_{name}"] for name in ("RUN", "NODE", "CONNECT", "GAINS"))
WHO, BASE, IDENTITY = f"node-{NODE}", f"peakmesh/{RUN}/", f"{time.time_ns():020d}-plain"
text = Path(PATH).read_bytes()
gains, digest, problem = json.loads(text), hashlib.sha256(text).hexdigest(), json.loads(text)["problem"]
links, unbiased, A, M = problem.get("link", []), problem.get("unbiased"), problem["plant"]["A"], problem["plant"]["M"]
nodes, topologies = {node["name"]: node for node in problem["node"]}, problem["topology"]
own, row = nodes[NODE], list(nodes).index(NODE)
weights = {mode["name"]: dict(zip(nodes, mode["adjacency"][row], strict=True)) for mode in topologies}
hears = {mode: [j for j in nodes if a[j] > 0] for mode, a in weights.items()}
near = {j for mode in hears for j in hears[mode]} - {NODE}
linked = {"coordinator", "recorder", *(f"node-{j}" for j in nodes)}
ESTIMATE, BLOCK = f"node/{NODE}/estimate", zenoh.CongestionControl.BLOCK


def times(matrix, vector):  # every row multiplied out, then summed from left to right: so everybody has these bits
    return [reduce(lambda a, b: a + b, (g * v for g, v in zip(row, vector, strict=True))) for row in matrix]


def innovation(y, x):  # equation (4); [] is y where nothing arrived
    share, expected = 1.0 if own.get("loss") == "seen" else own["arrival_probability"], times(own["C"], x)
    return [v - share * e for v, e in zip(y or expected, expected, strict=True)]


def step(mode, x, nu, heard):  # equation (5); for a pair that was not heard stands what the node knows itself
    rows, told = (A, x) if unbiased else ([[]] * len(x), [])
    for j in hears[mode]:
        a, K, H = weights[mode][j], gains["K"][mode][NODE][j], gains["H"][mode][NODE][j]
        x_j, nu_j = (x, nu) if j == NODE else heard.get(j, (x, [0.0] * len(H[0])))
        rows = [[*row, *(a * g for g in (*K_r, *H_r))] for row, K_r, H_r in zip(rows, K, H, strict=True)]
        told = [*told, *(v - w if unbiased else v for v, w in zip(x_j, x, strict=True)), *nu_j]
    return times(rows, told)


def lost(k, seed):  # whose message of step k the model loses: Philox 4x64-10, key (seed, 4), four draws a count
    drawn, counts, bits = [], -(-len(links) // 4), 2**64 - 1
    for count in range(k * counts + 1, (k + 1) * counts + 1):
        c, low, high = (count, 0, 0, 0), seed, 4
        for _ in range(10):
            p, q = 0xD2E7470EE14C6C93 * c[0], 0xCA5A826395121157 * c[2]
            c = q >> 64 ^ c[1] ^ low, q & bits, p >> 64 ^ c[3] ^ high, p & bits
            low, high = low + 0x9E3779B97F4A7C15 & bits, high + 0xBB67AE8584CAA73B & bits
        drawn += [(word >> 11) * 2.0**-53 for word in c]
    mine = [(link, u) for link, u in zip(links, drawn, strict=False) if link["receiver"] == NODE]
    return {link["sender"] for link, u in mine if u >= link["delivery_probability"]}


class Node:
    def __init__(self, session):
        self.session, self.inbox, self.present, self.start = session, queue.SimpleQueue(), set(), None
        self.there, self.last, self.kept = {}, {}, []
        self.k = self.number = self.words = 0
        topics = ["mode", f"node/{NODE}/measurement", *(f"node/{j}/estimate" for j in near), "control", "acknowledged"]
        tokens, declare = self.session.liveliness(), self.session.declare_subscriber
        self.declared = [declare(BASE + topic, self.hear) for topic in topics]
        self.declared += [tokens.declare_subscriber(f"{BASE}session/*/*", self.hear, history=True)]
        self.declared += [self.session.declare_queryable(f"{BASE}replay/{WHO}", self.answer)]
        self.declared += [tokens.declare_token(BASE + own) for own in (f"session/{WHO}/{IDENTITY}", f"alive/{WHO}")]

    def hear(self, sample):  # on a thread of zenoh's
        is_put, topic = sample.kind == zenoh.SampleKind.PUT, str(sample.key_expr).removeprefix(BASE)
        self.inbox.put((topic, sample.payload.to_bytes(), is_put, time.monotonic()))

    def say(self, topic, **word):  # what runs the run
        word |= {"who": WHO, "session": IDENTITY, "number": self.words}
        self.words += 1
        self.session.put(f"{BASE}{topic}/{WHO}", json.dumps(word), congestion_control=BLOCK)

    def publish(self, topic, place, **message):  # numbered, signed, and kept until the recorder has it
        payload = json.dumps({"step": self.k, **message}, allow_nan=False).encode()
        marks = (f"{topic}\0".encode() + payload, 16), (IDENTITY.encode(), 8)
        stamp = struct.pack("<QQ", self.number, time.time_ns()) + f"{WHO}\0".encode()
        stamp += b"".join(hashlib.blake2b(mark, digest_size=size).digest() for mark, size in marks)
        self.kept.append((self.number, BASE + place, payload, stamp))
        self.number += 1
        self.session.put(BASE + place, payload, attachment=stamp, congestion_control=BLOCK)

    def answer(self, query):  # the recorder lacks something
        with query:
            for _, place, payload, stamp in [sent for sent in self.kept if sent[0] >= int(query.parameters["from"])]:
                query.reply(place, payload, attachment=stamp)

    def wait(self, condition):
        while not condition():
            self.heed(*self.inbox.get())

    def heed(self, topic, payload, is_put, at):
        word, who = json.loads(payload or "{}"), topic.split("/")[-2:][0]
        if topic.startswith("session/"):
            (self.present.add if is_put else self.present.discard)(who)
            if who == "coordinator" and is_put:
                self.say("joining", version="0.1.0", listen="none", machine="", lease=20.0, lacks=[])
            elif who == "coordinator":
                raise SystemExit("the coordinator was lost")
        elif topic == "acknowledged":
            self.last, self.kept = word, [sent for sent in self.kept if sent[0] >= word["received"].get(WHO, 0)]
        elif topic != "control":
            self.there[topic, word["step"]] = word, at
        elif word["order"] == "start":
            self.start = word
        elif word["order"] != "tell":
            self.wait(lambda: self.last.get("closed") or "recorder" not in self.present)
            raise SystemExit(word["reason"] or (0 if self.last.get("closed") and not self.kept else 3))

    def next(self, topic):
        self.wait(lambda: (topic, self.k) in self.there)
        return self.there.pop((topic, self.k))[0]

    def run(self):
        self.wait(lambda: linked <= self.present)
        self.say("ready", gains=digest)
        self.wait(lambda: self.start)
        x, mode, heard = [0.0] * len(A), "", []
        for self.k in range(self.start["steps"]):
            nu = innovation(self.next(f"node/{NODE}/measurement")["y"], x)
            self.publish(ESTIMATE, ESTIMATE, x_hat=x, innovation=nu, z_hat=times(M, x), mode=mode, heard=heard)
            mode, gone = self.next("mode")["mode"], lost(self.k, self.start["seed"])
            told = {j: self.next(f"node/{j}/estimate") for j in hears[mode] if j != NODE}
            heard = [j for j in hears[mode] if j not in gone]
            x = step(mode, x, nu, {j: (told[j]["x_hat"], told[j]["innovation"]) for j in told if j in heard})
        self.wait(lambda: False)


if __name__ == "__main__":
    where = {"mode": "client", "connect": {"endpoints": [ADDRESS]}, "scouting": {"multicast": {"enabled": False}}}
    with zenoh.open(zenoh.Config.from_json5(json.dumps(where))) as session:
        Node(session).run()
