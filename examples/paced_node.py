"""The node of plain_node.py in runs against the clock, too: deadlines, substitutions, new beginnings, an account."""

import math
import queue
import time
from collections import defaultdict
from contextlib import suppress
from itertools import count

import plain_node
from plain_node import ESTIMATE, MEASUREMENT, NODE, WHO, M, hears, heed, inbox, innovation, lost, publish, said, there
from plain_node import step as next_x

ZERO, NOTHING = [0.0] * len(plain_node.A), [0.0] * len(plain_node.C)


def wait_until(deadline, condition):
    while not condition() and (left := deadline() - time.monotonic()) > 0.0:
        with suppress(queue.Empty):
            heed(*inbox.get(timeout=min(left, 3600.0)))


class Clock:
    """The steps of one run, each as it is due."""

    def __init__(self, start):
        self.start, self.k, self.tick, self.made = start, start["step"], 0.0, 0
        self.x, self.made_by = None if start["step"] else ZERO, ("", [])
        self.asked, self.lacked, self.spent = defaultdict(int), defaultdict(int), defaultdict(list)

    def deadline(self, part):
        following = there.get(("mode", self.k + 1), (None, math.inf))[1]
        return min(self.tick + self.start[part] * self.start["period"], following)

    def in_time(self, kind, part, topics):
        """What was there by its deadline; of the rest is told that it was not."""
        wait_until(lambda: self.deadline(part), lambda: all((topic, self.k) in there for topic in topics))
        found = {topic: there.get((topic, self.k), (None, math.inf)) for topic in topics}
        good = {topic: word for topic, (word, at) in found.items() if at <= self.deadline(part)}
        self.asked[kind], self.lacked[kind] = self.asked[kind] + len(topics), self.lacked[kind] + len(found) - len(good)
        for topic in found.keys() - good.keys():
            why = "late" if (topic, self.k) in there else "silent"
            self.event(why, f"{topic} was {why} and was substituted", about=topic)
        return good

    def event(self, kind, detail, **rest):
        publish("event", f"event/{WHO}", step=self.k, kind=kind, who=WHO, detail=detail, steps=[self.k], **rest)

    def tell(self, x, nu, **rest):
        publish(ESTIMATE, ESTIMATE, step=self.k, x_hat=x, innovation=nu, z_hat=plain_node.times(M, x), **rest)

    def run(self):
        while self.k < self.start["steps"]:
            wait_until(lambda: math.inf, lambda: any(topic == "mode" and k >= self.k for topic, k in there))
            first = min(k for topic, k in there if topic == "mode" and k >= self.k)
            self.k, self.x = first, self.x if first == self.k else None  # a tick may have been missed
            word, self.tick = there["mode", self.k]
            self.x = self.advance(word["mode"])
            self.spent["step"].append(time.monotonic() - self.tick)
            self.made, self.k = self.made + 1, self.k + 1
            for old in [old for old in there if old[1] < self.k]:
                del there[old]
        self.account()

    def advance(self, mode):
        x, nu = self.x, NOTHING
        if x is not None:
            made_by, heard = self.made_by
            if y := self.in_time("measurements", "measure_by", [MEASUREMENT]):
                nu = innovation(y[MEASUREMENT]["y"], x)
            self.tell(x, nu, mode=made_by, heard=heard, measured=bool(y))
            self.spent["estimate"].append(time.monotonic() - self.tick)
        gone = lost(self.k, self.start["seed"])
        wanted = {f"node/{j}/estimate": j for j in hears[mode] if j != NODE and j not in gone}
        pairs = {wanted[topic]: word for topic, word in self.in_time("pairs", "hear_by", list(wanted)).items()}
        if x is None:  # begin again, with what a neighbour has, or with 0
            origin = min(pairs, key=list(pairs).index, default="the zero state")
            x = pairs[origin]["x_hat"] if pairs else ZERO
            self.tell(x, nu, mode="", heard=[], measured=False, origin=origin)
            self.event("began", f"begins again with {origin}")
        self.made_by = mode, [j for j in hears[mode] if j == NODE or j in pairs]
        return next_x(mode, x, nu, {j: (word["x_hat"], word["innovation"]) for j, word in pairs.items()})

    def account(self):
        times = {what: sorted(self.spent[what]) or [0.0] for what in ("estimate", "step")}
        parts = ("median", 0.5), ("p99", 0.99), ("max", 1.0)
        spread = {
            f"to_{what}_{name}": some[math.ceil(part * len(some)) - 1]
            for what, some in times.items()
            for name, part in parts
        }
        counts = {"pairs": self.asked["pairs"], "pairs_substituted": self.lacked["pairs"], "late": 0}
        counts |= {"measurements_substituted": self.lacked["measurements"], "steps": self.made}
        publish("account", f"account/{WHO}", step=self.start["steps"] - 1, who=WHO, **counts, **spread)


def begin(start):
    if not start["period"]:
        return plain_node.lock_step(start)
    while start["step"] and said["acknowledged"].get("greets") != WHO:  # the recorder knows which number is next
        plain_node.say("ready", gains="", asks=True)
        again = time.monotonic() + 0.15
        wait_until(lambda: again, lambda: said["acknowledged"].get("greets") == WHO)  # noqa: B023
    plain_node.numbers = count(said["acknowledged"]["received"].get(WHO, 0))
    return Clock(start).run()


if __name__ == "__main__":
    with plain_node.session:
        plain_node.run(begin)
