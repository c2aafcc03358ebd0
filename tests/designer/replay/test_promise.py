"""What a replay says of gamma in a run that has faults, no known beginning, or modes that its chain does not have."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from made_recordings import random_gains, random_problem, record, simulate
from places import ROOT

from agent.contract.gains import Gains
from agent.contract.problem import Problem
from designer.ledger.deviation import Deviation
from designer.replay import replay
from designer.replay.gamma import Gamma
from designer.replay.log import Log, load
from designer.replay.promise import promise
from designer.report.account import Account
from designer.report.page.sections import proofs

GOLDEN = Gains.load(ROOT / "recordings" / "golden" / "zhu2020-lossy.gains.json")
TRUE = simulate(GOLDEN, steps=30)
PROVED = Gamma(GOLDEN.certificate.gamma, is_claimed=True, failure=None)


def log_of(folder: Path, **changes: object) -> Log:
    return replace(load(record(folder / "run.mcap", GOLDEN, TRUE, steps=30)), **changes)


def test_a_run_as_designed_keeps_the_whole_promise(tmp_path: Path) -> None:
    verdict = replay(record(tmp_path / "run.mcap", GOLDEN, TRUE, steps=30))
    assert verdict.ledger is not None
    assert verdict.ledger.is_plain
    assert "\nledger       valid\n" in verdict.text()
    assert verdict.document()["ledger"]["status"] == "valid"


def test_a_mode_that_the_chain_does_not_have_ends_the_promise(tmp_path: Path) -> None:
    sent = [
        message._replace(document=message.document | {"mode": "elsewhere"})
        if message.topic == "mode" and message.document["step"] == 17
        else message
        for message in TRUE
    ]
    path = record(tmp_path / "run.mcap", GOLDEN, sent, steps=30)
    assert '\nledger       void since step 17: mode "elsewhere" is none of the chain\n' in replay(path).text()
    assert 'void since step 17: mode "elsewhere" is none of the chain' in proofs(Account.of(path)).replace(
        "&quot;", '"'
    )


def test_a_transition_that_the_chain_does_not_make_ends_the_promise(tmp_path: Path) -> None:
    document = random_problem(5, ny=(1, 1), modes=3).document()
    document["markov"]["transition"] = [[0.5, 0.5, 0.0], [0.0, 0.5, 0.5], [0.5, 0.0, 0.5]]
    gains = random_gains(Problem.from_document(document))
    log = load(record(tmp_path / "run.mcap", gains, simulate(gains, steps=30), steps=30))
    mode = np.array(log.mode)
    assert promise(log, PROVED).text() == "valid"
    k = int(np.flatnonzero(mode[1:] != mode[:-1])[2]) + 1
    mode[k] = (mode[k - 1] + 2) % 3
    names = gains.problem.mode_names
    found = promise(replace(log, mode=mode), PROVED)
    assert found is not None
    assert (
        found.text()
        == f'void since step {k}: the chain never goes from mode "{names[mode[k - 1]]}" to "{names[mode[k]]}"'
    )
    mode[k] = -1  # a mode that is missing says nothing
    assert promise(replace(log, mode=mode), PROVED).text() == "valid"


def test_a_real_plant_begins_anywhere(tmp_path: Path) -> None:
    """The term counts for each unit of the initial error, and is there until it has faded."""
    names = ",".join(GOLDEN.problem.node_names)
    y = {name: [[0.1]] * 60 for name in GOLDEN.problem.node_names}
    for steps in (3, 60):
        sent = [message for message in simulate(GOLDEN, steps=steps, real_y=y) if message.topic != "plant/state"]
        path = record(tmp_path / f"{steps}.mcap", GOLDEN, sent, steps=steps, external=names)
        found = replay(path).ledger
        assert found is not None
        assert found.last.status == ("valid plus" if steps == 3 else "valid")
        assert steps == 60 or "times its length, for the initial error, which is not known" in found.text()


def test_faults_are_told_with_the_worst_step(tmp_path: Path) -> None:
    silent = Deviation(substituted=frozenset((i, 0) for i in (1, 2, 3)))
    found = promise(log_of(tmp_path), PROVED, dict.fromkeys(range(10, 15), silent))
    assert found is not None
    assert found.text().startswith("valid at the end; 5 steps with faults; at step 15, the worst of 1 looked at, 1.4")


def test_without_a_proved_gamma_nothing_is_promised(tmp_path: Path) -> None:
    log = log_of(tmp_path)
    assert promise(log, Gamma(0.3, is_claimed=False, failure="not claimed")) is None
    assert promise(log, Gamma(0.3, is_claimed=True, failure="(17) fails")) is None
