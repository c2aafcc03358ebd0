"""The soak finds what it is for, and a short form of it, with a fault of every kind, loses nothing."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise
from typing import Any

import pytest

from agent.contract.gains import Gains
from agent.faults import parse
from benchmarks import soak
from benchmarks.soak import Sample
from designer.ledger.promise import Promise
from designer.replay import replay
from designer.replay.verdict import Verdict

STEPS = 120
FAULTS = (  # who is killed is back before the next one is, or nobody has what they were to tell each other
    "kill:coordinator,step=8",
    "kill:node=2,step=18",
    "kill:plant,step=28",
    "kill:recorder,step=45",
    "freeze:node=3,step=60,for=300ms",
    "mute-link:plant>1,steps=65-75",
    "delay:node=4,by=100ms,steps=70-80",
    "drop:probability=0.1,steps=80-100",
)


@pytest.fixture(scope="module")
def soaked(tmp_path_factory: pytest.TempPathFactory) -> tuple[dict[str, Any], dict[str, list[Sample]], Verdict]:
    folder = tmp_path_factory.mktemp("soak")
    gains = soak.with_noise(Gains.load(soak.GOLDEN))
    gains.save(folder / "gains.json")
    plan = ["--period", "100ms", "--steps", str(STEPS), "--wait", "300"]
    facts, lives = soak.run(folder / "gains.json", folder / "run.mcap", plan, FAULTS)
    return facts, lives, replay(folder / "run.mcap")


def test_a_short_soak_loses_nothing(soaked: tuple[dict[str, Any], dict[str, list[Sample]], Verdict]) -> None:
    """A fault of every kind; the replay agrees, the ledger is valid, the errors stay within the bound of their path."""
    facts, _, verdict = soaked
    assert {fault.partition(":")[0] for fault in FAULTS} == {kind.split()[0] for kind in soak.KINDS}
    assert soak.about_the_run(facts, verdict) == []
    assert verdict.pacing is not None
    assert verdict.pacing.faults == FAULTS
    assert verdict.steps == STEPS
    assert verdict.ledger is not None
    assert math.isfinite(verdict.ledger.last.factor)


def test_every_process_is_looked_at(soaked: tuple[dict[str, Any], dict[str, list[Sample]], Verdict]) -> None:
    """Those that were killed, and those after them."""
    _, lives, _ = soaked
    names = [name.partition(" (")[0] for name in lives]
    assert set(names) == {"coordinator", "recorder", "plant", "node 1", "node 2", "node 3", "node 4"}
    assert len(lives) > len(set(names))
    assert all(sample.memory > 1000 for samples in lives.values() for sample in samples)


def test_numbers_of_processes_begin_anew() -> None:
    """Who is started later may have a lower one."""
    assert soak.ancestors(7, {7: 30_000, 30_000: 29_000, 29_000: 1, 5: 4}) == {30_000, 29_000, 1}
    assert soak.ancestors(5, {5: 4}) == {4}


def life(memory: float = 0.0, descriptors: float = 0.0) -> dict[str, list[Sample]]:
    """Of 200 s, with so much growth in all, and some noise."""
    return {
        "node 1 (7)": [
            Sample(
                float(k), round(60_000 * (1.0 + memory * k / 200) + 300 * (k % 3)), round(30 + descriptors * k / 200)
            )
            for k in range(200)
        ]
    }


def test_what_grows_is_found() -> None:
    assert soak.about_processes(life()) == []
    (found,) = soak.about_processes(life(memory=0.15))
    assert found.startswith("node 1 (7): memory grew by ")
    (found,) = soak.about_processes(life(descriptors=4.0))
    assert found.startswith("node 1 (7): descriptors grew by ")
    assert soak.about_processes(life(memory=0.15), settled=300.0) == []


def test_what_went_wrong_is_found(soaked: tuple[dict[str, Any], dict[str, list[Sample]], Verdict]) -> None:
    facts, _, verdict = soaked
    assert soak.about_the_run(facts | {"missing": 3}, verdict) == ["3 messages are missing"]
    assert verdict.ledger is not None
    void = Promise("void", None, math.inf, None, (), "a mode outside the chain", 7)
    (found,) = soak.about_the_run(facts, replace(verdict, ledger=verdict.ledger._replace(last=void)))
    assert "a mode outside the chain" in found
    broken = [proof if proof.number != 5 else replace(proof, holds=False) for proof in verdict.proofs]
    assert len(soak.about_the_run(facts, replace(verdict, proofs=tuple(broken)))) == 2  # by itself, and as a verdict


def test_faults_of_every_kind_are_drawn() -> None:
    """Possible ones, the same for a seed every time, and far enough apart."""
    gains = Gains.load(soak.GOLDEN)
    drawn = soak.drawn(1, gains.problem, steps=12_000, every=400)
    assert drawn == soak.drawn(1, gains.problem, steps=12_000, every=400)
    assert drawn != soak.drawn(2, gains.problem, steps=12_000, every=400)
    faults = [parse(text, gains.problem, steps=12_000) for text in drawn]
    assert {fault.kind for fault in faults} == {kind.split()[0] for kind in soak.KINDS}
    assert {"coordinator", "recorder", "plant"} <= {fault.who for fault in faults if fault.kind == "kill"}
    firsts = [fault.first for fault in faults]
    assert all(b - a == 400 for a, b in pairwise(firsts))
