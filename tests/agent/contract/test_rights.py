"""Who may do what, as the table of keys says it, and as people ask for it."""

from __future__ import annotations

import re

from made_recordings import random_problem

from agent.contract import keys
from agent.contract.keys import key
from agent.contract.rights import rights

PROBLEM = random_problem(11, ny=(1, 2, 1), modes=2)
NODES = {f"node-{name}" for name in PROBLEM.node_names}
SENSORS = {f"sensor-{name}" for name in PROBLEM.node_names}
ALL = {"coordinator", "plant", "recorder", *NODES}  # but for sensors
RIGHTS = rights(PROBLEM, run="r")


def may(what: str, topic: str) -> set[str]:
    """Who may do it on this very key."""
    return {
        who for who, own in RIGHTS.items() if any(_includes(each, f"peakmesh/r/{topic}") for each in getattr(own, what))
    }


def _includes(expression: str, key: str) -> bool:
    pattern = re.escape(expression).replace(r"\*\*", ".*").replace(r"\*", "[^/]+")
    return re.fullmatch(pattern, key) is not None


def test_everybody_says_their_own_and_nothing_else() -> None:
    assert may("says", "mode") == may("says", "control") == {"coordinator"}
    assert may("says", "acknowledged") == {"recorder"}
    assert may("says", "plant/state") == {"plant"}
    for name in PROBLEM.node_names:
        assert may("says", f"node/{name}/estimate") == may("says", f"watch/node/{name}/estimate") == {f"node-{name}"}
        assert may("says", f"node/{name}/measurement") == {"plant", f"sensor-{name}"}
    for who in ALL:
        for topic in (f"event/{who}", f"ready/{who}", f"refused/{who}/1", f"watch/event/{who}"):
            assert may("says", topic) == {who}
        assert (
            may("shows", f"alive/{who}") == may("shows", f"session/{who}/1") == may("answers", f"replay/{who}") == {who}
        )
        assert may("asks", f"replay/{who}") == {"recorder"}
    assert {who for who, own in RIGHTS.items() if own.asks} == {"recorder", "viewer"}
    assert RIGHTS["viewer"].asks == ["peakmesh/r/facts"]


def test_what_is_heard_is_what_is_needed() -> None:
    """Measurements go to their node and the recorder alone, estimates to who hears them in some mode."""
    assert may("hears", "mode") == {*NODES, *SENSORS, "plant", "recorder"}
    assert may("hears", "plant/state") == {"recorder"}
    for j, name in enumerate(PROBLEM.node_names):
        assert may("hears", f"node/{name}/measurement") == {f"node-{name}", "recorder"}
        hearing = {f"node-{PROBLEM.node_names[i]}" for i in range(PROBLEM.n) if i != j and j in PROBLEM.ever_heard(i)}
        assert may("hears", f"node/{name}/estimate") == {*hearing, "recorder"}
        assert may("hears", f"watch/node/{name}/estimate") == {"viewer"}
    assert (RIGHTS["viewer"].says, RIGHTS["viewer"].hears) == ([], ["peakmesh/r/watch/**"])


def test_nobody_has_a_right_in_another_run() -> None:
    """But that a viewer finds runs by their coordinators."""
    for who, own in RIGHTS.items():
        elsewhere = [each for right in own for each in right if not each.startswith("peakmesh/r/")]
        assert elsewhere == (["peakmesh/*/alive/coordinator"] if who == "viewer" else [])


def test_the_table_of_keys_and_the_rights_agree() -> None:
    """Every row of it: who says it, in its words; so a topic that is added there needs rights here."""
    words = {
        "coordinator": {"coordinator"},
        "plant": {"plant"},
        "recorder": {"recorder"},
        "plant, or a sensor driver": {"plant", "sensor-n0"},
        "node n": {"node-n0"},
        "anyone": ALL | SENSORS,
        "nodes of a paced run": NODES,
        "everyone": ALL | SENSORS,
        "everyone but sensors": ALL,
        "publishers": ALL,
        "recorder, when asked": {"recorder"},
        "publishers, to viewers": {"coordinator"},
    }
    kinds = {"liveliness": "shows", "queryable": "answers", "Facts": "answers"}
    rows = [[cell.strip() for cell in row.split("|")[1:4]] for row in re.findall(r"^\|.*\|$", keys.__doc__ or "", re.M)]
    checked = 0
    for topic, model, sender in rows:
        if topic in ("topic", "evidence") or topic.startswith("--"):
            continue
        topic = topic.replace("<n>", "n0").replace("<id>", "1").replace("<data topic>", "mode")
        for who in words[sender]:
            said = topic.replace("<who>", who)
            said = key("r", said, who=who).removeprefix("peakmesh/r/")
            expected = {who} if "<who>" in topic or who in said else words[sender]
            assert may(kinds.get(model, "says"), said) == expected, (topic, who)
            checked += 1
    assert checked > 30
