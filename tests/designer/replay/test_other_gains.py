"""Other gains on a recorded run: what they would have done is what a run with them does, of the same seed."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from here import here
from made_recordings import (
    Sent,
    observer_gains,
    random_gains,
    random_problem,
    real_problem,
    record,
    simulate,
)
from places import GOLDEN

from agent.contract.arrays import Array
from agent.contract.gains import Gains
from designer.replay.log import load
from designer.replay.other_gains import OtherGains, Sizes, run_other

STEPS = 40
PROBLEMS = {
    "paper": random_problem(5, nz=2),
    "seen, links": real_problem(6, unbiased=False),
    "unbiased": real_problem(7, seen=False, links=False),
    "unbiased, seen, links, unstable": real_problem(8, radius=1.02),
}


def gains_of(name: str, seed: int) -> Gains:
    problem = PROBLEMS[name]
    return observer_gains(problem) if problem.unbiased else random_gains(problem, seed)


def errors(sent: list[Sent], gains: Gains) -> Array:
    """z - z_hat_i of every step and node, (steps, n, nz), from the messages alone."""
    found = np.full((STEPS, gains.problem.n, gains.problem.nz), np.nan)
    z = {m.document["step"]: np.asarray(m.document["z"]) for m in sent if m.topic == "plant/state"}
    for message in sent:
        if message.topic.endswith("estimate"):
            step = message.document["step"]
            node = gains.problem.node_index(message.topic.split("/")[1])
            found[step, node] = z[step] - message.document["z_hat"]
    return found


def agree(found: Sizes, errors: Array) -> None:
    norms = np.sqrt((errors**2).sum(axis=(1, 2)))
    assert found.step == norms.argmax()
    assert found.peak == pytest.approx(norms.max(), rel=1e-9)
    assert found.energy == pytest.approx((errors**2).sum(), rel=1e-9)
    assert found.rms == pytest.approx(np.sqrt((errors**2).sum(axis=2).mean(axis=0)), rel=1e-9)


def ran(path: Path, gains: Gains, other: Gains, **facts: str) -> tuple[OtherGains, list[Sent], list[Sent]]:
    one, two = simulate(gains, steps=STEPS), simulate(other, steps=STEPS)
    log = load(record(path, gains, one, steps=STEPS, **facts))
    return run_other(log, other.K, other.H, source="other"), one, two


@pytest.mark.parametrize("name", [name for name in PROBLEMS if not name.startswith("unbiased")])
def test_it_is_what_a_run_with_them_does(name: str, tmp_path: Path) -> None:
    """Node by node and link by link, of the same seed."""
    gains, other = gains_of(name, 0), gains_of(name, 1)
    found, one, two = ran(tmp_path / "run.mcap", gains, other)
    assert found.recorded is not None
    assert found.other is not None
    agree(found.recorded, errors(one, gains))
    agree(found.other, errors(two, other))
    assert found.recorded.peak != pytest.approx(found.other.peak, rel=0.01)
    agree(found.apart, errors(two, other) - errors(one, gains))


@pytest.mark.parametrize("name", PROBLEMS)
def test_the_recorded_gains_do_what_they_did(name: str, tmp_path: Path) -> None:
    gains = gains_of(name, 0)
    found, one, _ = ran(tmp_path / "run.mcap", gains, gains)
    assert found.recorded is not None
    assert found.other is not None
    agree(found.other, errors(one, gains))
    assert found.apart.peak < 1e-11


def test_recorded_losses_and_deliveries_count_not_those_of_the_seed(tmp_path: Path) -> None:
    """A receiver that had a message which the seed lost had it, and the other gains have it too."""
    gains, other = gains_of("seen, links", 0), gains_of("seen, links", 1)
    link = gains.problem.links[0]  # type: ignore[index]
    used = {(k, link.receiver, link.sender): True for k in range(STEPS)}
    one, two = simulate(gains, steps=STEPS, uses=used), simulate(other, steps=STEPS, uses=used)
    log = load(record(tmp_path / "run.mcap", gains, one, steps=STEPS))
    found = run_other(log, other.K, other.H, source="other").other
    assert found is not None
    agree(found, errors(two, other))
    with pytest.raises(AssertionError):
        agree(found, errors(simulate(other, steps=STEPS), other))


@pytest.mark.parametrize("name", ["paper", "seen, links"])
def test_sensors_of_their_own_drive_the_other_gains(name: str, tmp_path: Path) -> None:
    """What they measured was recorded; nothing else is known of it."""
    gains, other = gains_of(name, 0), gains_of(name, 1)
    node = gains.problem.nodes[1]
    y = np.random.default_rng(0).normal(size=(STEPS, len(node.C)))
    one, two = (simulate(g, steps=STEPS, real_y={node.name: y}) for g in (gains, other))
    log = load(record(tmp_path / "run.mcap", gains, one, steps=STEPS, external=node.name))
    found = run_other(log, other.K, other.H, source="other")
    assert found.energy is None
    assert found.other is not None
    agree(found.other, errors(two, other))


def test_without_a_plant_the_estimates_are_compared(tmp_path: Path) -> None:
    gains, other = gains_of("paper", 0), gains_of("paper", 1)
    names = gains.problem.node_names
    rng = np.random.default_rng(0)
    y = {node.name: rng.normal(size=(STEPS, len(node.C))) for node in gains.problem.nodes}
    one, two = (simulate(g, steps=STEPS, real_y=y) for g in (gains, other))
    without = [message for message in one if message.topic != "plant/state"]
    log = load(record(tmp_path / "run.mcap", gains, without, steps=STEPS, external=",".join(names)))
    found = run_other(log, other.K, other.H, source="other")
    assert (found.recorded, found.other) == (None, None)
    agree(found.apart, errors(two, other) - errors(one, gains))
    assert "nothing is known of the error" in found.text()


def test_where_a_message_is_missing_the_step_counts_for_neither(tmp_path: Path) -> None:
    gains, other = gains_of("paper", 0), gains_of("paper", 1)
    one, two = simulate(gains, steps=STEPS), simulate(other, steps=STEPS)
    fewer = [m for m in one if (m.topic, m.document["step"]) not in {("node/n1/estimate", 20), ("plant/state", 30)}]
    log = load(record(tmp_path / "run.mcap", gains, fewer, steps=STEPS))
    found = run_other(log, other.K, other.H, source="other").other
    assert found is not None
    known = errors(two, other)
    known[20, 1] = known[30] = 0.0
    assert found.rms[1] == pytest.approx(np.sqrt((known[:, 1] ** 2).sum() / (STEPS - 2)), rel=1e-9)
    assert found.rms[0] == pytest.approx(np.sqrt((known[:, 0] ** 2).sum() / (STEPS - 1)), rel=1e-9)


def test_gains_that_let_the_errors_grow_are_said_to(tmp_path: Path) -> None:
    """Beyond float64, and in JSON still."""
    gains = gains_of("paper", 0)
    K = {
        m: {i: {j: 1e30 * np.ones_like(b) for j, b in row.items()} for i, row in r.items()} for m, r in gains.K.items()
    }
    log = load(record(tmp_path / "run.mcap", gains, simulate(gains, steps=STEPS), steps=STEPS))
    found = run_other(log, K, gains.H, source="wild")
    assert found.other is not None
    assert not np.isfinite(found.other.peak)
    assert json.loads(json.dumps(found.document(), allow_nan=False))["other"]["peak"] is None
    assert "inf" in found.text() or "nan" in found.text()


def test_an_empty_run_has_no_sizes(tmp_path: Path) -> None:
    gains = gains_of("paper", 0)
    log = load(record(tmp_path / "run.mcap", gains, [], steps=STEPS, whole=False))
    found = run_other(log, gains.K, gains.H, source="other")
    json.dumps(found.document(), allow_nan=False)
    found.text()


# the command
def test_the_command_prints_both(tmp_path: Path) -> None:
    plain = tmp_path / "halved.json"
    document = Gains.load(GOLDEN / "zhu2020-lossy.gains.json").document()
    halved = {
        m: {i: {j: (0.5 * np.asarray(b)).tolist() for j, b in row.items()} for i, row in receivers.items()}
        for m, receivers in document["H"].items()
    }
    plain.write_text(json.dumps({"K": document["K"], "H": halved}))
    done = here("replay", GOLDEN / "zhu2020-lossy.mcap", "--with", plain)
    assert done.returncode == 0
    verdict, _, other = done.stdout.partition("\n\n")
    assert ": agrees\n" in verdict
    assert other.startswith(f"what if {plain} had run")
    for row in ("peak |z~|", "sum of |z~|^2", "sum of |w|^2", *(f'rms of z~ of node "{name}"' for name in "1234")):
        assert f"\n{row}" in other
    facts = json.loads(here("replay", GOLDEN / "zhu2020-lossy.mcap", "--with", plain, "--json").stdout)
    assert facts["agrees"] is True
    assert facts["what_if"]["recorded"]["peak"] == pytest.approx(facts["peak"])
    assert facts["what_if"]["energy"] == pytest.approx(facts["energy"])
    assert len(facts["what_if"]["other"]["rms"]) == 4


def test_gains_of_another_shape_are_refused(tmp_path: Path) -> None:
    other = random_gains(random_problem(1, ny=(1, 1)))
    other.save(tmp_path / "other.json")
    done = here("replay", GOLDEN / "zhu2020-lossy.mcap", "--with", tmp_path / "other.json")
    assert (done.returncode, done.stdout) == (2, "")
    assert "does not fit zhu2020-lossy" in done.stderr
    assert done.stderr.count("\n") == 1
    done = here("replay", GOLDEN / "zhu2020-lossy.mcap", "--with", tmp_path / "none.json")
    assert (done.returncode, done.stdout) == (2, "")


def test_gains_of_another_problem_are_named_as_such() -> None:
    done = here("replay", GOLDEN / "zhu2020-lossy.mcap", "--with", GOLDEN / "zhu2020-ideal.gains.json")
    assert done.returncode == 0
    assert "(designed for another problem) had run" in done.stdout
