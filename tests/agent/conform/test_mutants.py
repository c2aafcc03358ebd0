"""Nodes that do one thing wrong, in plain Python: each is found, and for what is wrong with it."""

from __future__ import annotations

import re
import shutil
import sys
from pathlib import Path

import pytest
from places import ROOT
from runs import PATIENCE

from agent.conform.lockstep import deserted, interrupted, namesake, stopped, whole
from agent.conform.paced import joined_late, paced
from agent.conform.play import Play
from agent.conform.series import SEED, STEPS, Result, Try, tried
from agent.conform.trial import Setting
from designer.conformity import NETWORKS

SHORT = 2.0  # seconds, for what never comes
PLAIN, PACED = "plain_node.py", "paced_node.py"
WHOLE, STOP, SIGNAL, LOST, CLOCK, AGAIN = whole, stopped, interrupted, deserted, paced, joined_late


def changed(folder: Path, script: str, old: str, new: str) -> Path:
    """A copy of the example nodes with one place of one of them changed."""
    for name in (PLAIN, PACED):
        shutil.copy(ROOT / "examples" / name, folder / name)
    text = (folder / script).read_text()
    assert text.count(old) == 1, f"{text.count(old)} times {old}"
    (folder / script).write_text(text.replace(old, new))
    return folder / (PACED if script == PACED else PLAIN)


def judged(
    attempt: Try,
    network: str,
    script: Path,
    *,
    wait: float = PATIENCE,
    deadline: float = PATIENCE,
    end: float = PATIENCE,
    tolerance: float = 0.0,
) -> Result:
    gains, path = NETWORKS[network].gains, script.with_name("gains.json")
    gains.save(path, force=True)
    setting = Setting(
        [sys.executable, str(script)],
        path,
        Play(gains, steps=STEPS, seed=SEED),
        NETWORKS[network].node,
        wait=wait,
        deadline=deadline,
        end=end,
        tolerance=tolerance,
    )
    return tried("", "", attempt, setting)


ARITHMETIC = {  # (network, from, to, what must be said)
    "sums from right to left": (
        "sizes",
        "(g * v for g, v in zip(row, vector, strict=True)))",
        "[g * v for g, v in zip(row, vector, strict=True)][::-1])",
        "sums in another order",
    ),
    "ignores weights": ("sizes", "(a * g for", "(g for", "x_hat["),
    "ignores that losses are hidden": (
        "lossy",
        'else nodes[NODE]["arrival_probability"]',
        "else 1.0",
        "innovation[0] is",
    ),
    "does not see losses": ("seen", '.get("loss") == "seen"', '.get("loss") == "no"', "innovation[0] is"),
    "is not unbiased": ("unbiased", 'problem.get("unbiased")', "False", "sums in another order"),
    "hears those who hear it": (
        "lossy",
        'm["adjacency"][i], strict',
        '[a[i] for a in m["adjacency"]], strict',
        "heard is [",
    ),
    "uses what the model loses": ("links", 'if link["receiver"] == NODE]', 'if link["receiver"] == ""]', "heard is ["),
    "draws with another seed": ("links", "1, 0, 0, 0), seed, 4", "1, 0, 0, 0), seed + 1, 4", "heard is ["),
    "says that it used what was lost": (
        "links",
        "heard = [j for j in hears[mode] if j not in gone]\n",
        "heard = list(hears[mode])\n",
        "heard is [",
    ),
    "uses old estimates": (
        "lossy",
        "told.items()})\n        [there",
        "told.items()} if k % 7 else {})\n        [there",
        "x_hat[",
    ),
    "takes the mode of the step": ("lossy", "mode=mode, heard=heard)", "mode=str(k % 4 + 1), heard=heard)", "mode is"),
}

WORDS = {
    "has another field": (WHOLE, ", z_hat=times", ", zhat=times", r"is not a Estimate: .*z_hat"),
    "counts from 1": (WHOLE, "count(), count()\n", "count(), count(1)\n", r"stamp\.number is 1, must be 0"),
    "signs the payload alone": (WHOLE, 'f"{topic}\\0".encode() + payload, 16', "payload, 16", r"stamp\.digest is"),
    "signs for another session": (WHOLE, "(IDENTITY.encode(), 8)", "(WHO.encode(), 8)", r"stamp\.session is"),
    "has another name": (
        WHOLE,
        'f"{WHO}\\0".encode() + signed',
        'f"node-9\\0".encode() + signed',
        r"stamp\.sender is node-9",
    ),
    "has no stamp": (WHOLE, "payload, attachment=kept[-1][2], congestion", "payload, congestion", "has no stamp"),
    "has other gains": (WHOLE, 'say("ready", gains=digest)', 'say("ready", gains="0")', "its digest of the gains is"),
    "is of another session": (WHOLE, '"session": IDENTITY', '"session": "0"', "session of its word on joining is"),
    "is of another version": (WHOLE, 'version="0.1.0"', 'version="9.1.0"', r"is peakmesh 9\.1\.0"),
    "waits for nobody": (
        WHOLE,
        '    wait({"coordinator"}',
        '    say("ready", gains=digest)\n    wait({"coordinator"}',
        "ready before",
    ),
    "dies": (
        WHOLE,
        "mode, gone = wait",
        "assert k < 3\n        mode, gone = wait",
        r"ended with code 1 where its estimate of step 4 was due; it said: .*AssertionError",
    ),
    "answers nothing": (
        WHOLE,
        "if sent[0] >= int(",
        "if sent[0] < int(",
        "answered (nothing|another message) for number",
    ),
    "leaves at once": (
        WHOLE,
        "    inbox.put((str",
        "    if b'\"close\"' in sample.payload.to_bytes():\n        os._exit(0)\n    inbox.put((str",
        "ended with code 0 where an answer|answered nothing",
    ),
    "is content with a stop": (
        STOP,
        'raise SystemExit(word["reason"] or',
        "raise SystemExit(",
        "code 0 after a run that was",
    ),
}

HANGS = {
    "begins in another's place": (
        namesake,
        'word["cast"].get(WHO) == IDENTITY',
        'WHO in word["cast"]',
        "its end after another was cast did not come",
    ),
    "stays where everybody is lost": (
        LOST,
        'raise SystemExit("the coordinator was lost")',
        "pass",
        "its end after everybody",
    ),
    "heeds no signal": (
        SIGNAL,
        "inbox, there,",
        "__import__('signal').signal(15, 1)\ninbox, there,",
        "its end after SIGTERM did not",
    ),
}

CLOCKS = {
    "speaks under another's key": (CLOCK, 'f"event/{WHO}"', '"event/node-gyro"', "under the key of another"),
    "speaks for another": (
        CLOCK,
        "kind=kind, who=WHO",
        'kind=kind, who="node-gyro"',
        "refuse its message on event: .* forged",
    ),
    "measured what was not there": (CLOCK, "measured=bool(y))", "measured=True)", "measured is True, must be False"),
    "heard what was not there": (
        CLOCK,
        "if j == NODE or j in pairs]",
        "if j not in gone]",
        r"heard is \[.*must be .*nobody else was to be heard",
    ),
    "says nothing of it": (
        CLOCK,
        "            self.event(why, ",
        "            dict(why=why, said=",
        "no event of it says why",
    ),
    "goes on without a tick": (CLOCK, "self.x if first == self.k else None", "self.x", "origin is , must be"),
    "begins with its own": (CLOCK, 'pairs[origin]["x_hat"] if pairs', "ZERO if pairs", r"x_hat\[0\] is"),
    "miscounts": (CLOCK, "+ len(topics)", "+ 1", r"account\.pairs is"),
    "uses nothing": (
        CLOCK,
        "if at <= self.deadline(part)}",
        "if at <= 0.0}",
        "substituted .* of .* messages that were there",
    ),
    "counts from 0 again": (AGAIN, "(said[", "(0 and said[", r"stamp\.number is 0, must be 7"),
}


def held(result: Result, says: str) -> None:
    assert not result.passed
    assert re.search(says, result.says), result.says


@pytest.mark.parametrize("mutant", ARITHMETIC)
def test_a_wrong_number_is_found(mutant: str, tmp_path: Path) -> None:
    network, old, new, says = ARITHMETIC[mutant]
    result = judged(whole, network, changed(tmp_path, PLAIN, old, new))
    assert (result.passed, says in result.says) == (False, True), result.says
    assert result.step is not None
    assert result.field.split("[")[0] in ("x_hat", "innovation", "z_hat", "heard", "mode")


@pytest.mark.parametrize("mutant", WORDS)
def test_a_wrong_word_is_found(mutant: str, tmp_path: Path) -> None:
    attempt, old, new, says = WORDS[mutant]
    held(judged(attempt, "lossy", changed(tmp_path, PLAIN, old, new)), says)


@pytest.mark.parametrize("mutant", HANGS)
def test_what_does_not_come_is_found(mutant: str, tmp_path: Path) -> None:
    attempt, old, new, says = HANGS[mutant]
    held(judged(attempt, "lossy", changed(tmp_path, PLAIN, old, new), end=SHORT), says)


def test_who_waits_for_others_first_is_found(tmp_path: Path) -> None:
    """Where all do so nobody ever says anything."""
    waits = '        wait(there.get, ("node/1/estimate", k))\n'
    script = changed(tmp_path, PLAIN, "        nu = innovation", f"{waits}        nu = innovation")
    held(judged(whole, "lossy", script, deadline=SHORT), "its estimate of step 0 did not come")


def test_who_never_joins_is_found(tmp_path: Path) -> None:
    script = changed(tmp_path, PLAIN, "    declared = [", "    time.sleep(3600)\n    declared = [")
    held(judged(whole, "lossy", script, wait=0.5), "its token, .* did not come")


@pytest.mark.parametrize("mutant", CLOCKS)
def test_what_is_wrong_against_the_clock_is_found(mutant: str, tmp_path: Path) -> None:
    attempt, old, new, says = CLOCKS[mutant]
    held(judged(attempt, "all", changed(tmp_path, PACED, old, new)), says)
