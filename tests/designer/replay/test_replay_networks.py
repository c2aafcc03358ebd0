"""Replay of what real networks have: seen losses, lossy links, unbiased gains, an unstable plant. With mutants."""

from __future__ import annotations

from collections.abc import Callable
from itertools import islice, product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from made_recordings import Sent, observer_gains, random_gains, random_problem, real_problem, record, simulate

from agent.contract import schedule
from agent.contract.problem import Problem
from designer.replay import free_run, inputs, replay, tolerance
from designer.replay.central import Central
from designer.replay.log import load
from designer.replay.verdict import Verdict

STEPS = 60
GAINS = observer_gains(real_problem(1, radius=1.02))
PROBLEM = GAINS.problem
TRUE = simulate(GAINS, steps=STEPS)
SEEN = {node.name for node in PROBLEM.nodes if node.seen}


def verdict_of(folder: Path, sent: list[Sent], **facts: Any) -> Verdict:
    return replay(record(folder / "run.mcap", GAINS, sent, steps=STEPS, **facts))


def changed(topic: str, step: int, mutate: Callable[[dict[str, Any]], None]) -> list[Sent]:
    """TRUE with one payload changed."""
    at = next(i for i, m in enumerate(TRUE) if m.topic == topic and m.document["step"] == step)
    document = {key: list(value) if isinstance(value, list) else value for key, value in TRUE[at].document.items()}
    mutate(document)
    assert document != TRUE[at].document
    return [*TRUE[:at], TRUE[at]._replace(document=document), *TRUE[at + 1 :]]


def assert_found(verdict: Verdict, *, step: int, node: str, field: str, proof: int) -> None:
    first = verdict.first_divergence
    assert verdict.exit_code == 1
    assert first is not None
    assert (first.step, first.node, first.field, first.proof) == (step, node, field, proof)
    assert first.gap > verdict.tolerance


def message(*, arrives: bool) -> tuple[int, str, str]:
    """Step, receiver and sender of a message of a lossy link in the present mode, from step 10 on."""
    deliveries, chain = schedule.Deliveries(PROBLEM, seed=1), schedule.modes(PROBLEM, seed=1)
    for k, s in enumerate(islice(chain, STEPS)):
        for link in PROBLEM.links or ():
            i, j = PROBLEM.node_index(link.receiver), PROBLEM.node_index(link.sender)
            if k >= 10 and j in PROBLEM.neighbours(s, i) and deliveries.at(k)[i, j] == arrives:
                return k, link.receiver, link.sender
    raise AssertionError("the run has no such message")


def measured(*, arrives: bool) -> tuple[int, str]:
    """Step and node of a measurement of a node that sees its losses, from step 10 on."""
    for sent in TRUE:
        name = sent.topic.split("/")[1] if sent.topic.endswith("/measurement") else ""
        if name in SEEN and sent.document["step"] >= 10 and bool(sent.document["y"]) == arrives:
            return sent.document["step"], name
    raise AssertionError("the run has no such measurement")


# what is true is believed
@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize(
    ("radius", "seen", "links", "unbiased"),
    [(0.85, *flags) for flags in product((False, True), repeat=3) if any(flags)]
    + [(1.02, True, False, True), (1.02, True, True, True)],
)
def test_every_combination_agrees(
    tmp_path: Path, seed: int, radius: float, seen: bool, links: bool, unbiased: bool
) -> None:
    problem = real_problem(seed, radius=radius, seen=seen, links=links, unbiased=unbiased)
    gains = observer_gains(problem) if unbiased else random_gains(problem, seed)
    verdict = replay(
        record(tmp_path / "run.mcap", gains, simulate(gains, steps=STEPS, seed=seed), steps=STEPS, seed=seed)
    )
    assert verdict.exit_code == 0, verdict.text()
    assert all(proof.holds and proof.compared for proof in verdict.proofs)


def test_an_unstable_plant_is_followed_for_as_long_as_it_runs(tmp_path: Path) -> None:
    """The state grows, the errors do not, and the gaps stay at the rounding of the state."""
    sent = simulate(GAINS, steps=300)
    path = record(tmp_path / "run.mcap", GAINS, sent, steps=300)
    verdict = replay(path)
    assert verdict.exit_code == 0, verdict.text()
    states = [np.abs(m.document["x"]).max() for m in sent if m.topic == "plant/state"]
    assert verdict.peak is not None
    assert states[-1] > 10.0 * max(states[:100])
    assert verdict.peak.size < 10.0 * replay(record(tmp_path / "begin.mcap", GAINS, TRUE, steps=STEPS)).peak.size  # type: ignore[union-attr]
    log = load(path)
    central = Central.of(log.gains)
    assert (central.model.plant_states, log.x.shape[1]) == (0, 2)  # the model has errors alone, the log has x


def test_the_tolerance_is_that_of_its_derivation() -> None:
    """Terms that cancel and the rounding of K_ii cost what they cost; the paper's problems pay for neither."""
    unit = 2.0**-53
    plain = random_problem(1)
    size = 2 * (4 + 1) + 5 + 2 + 4 + 4  # n_eta + sum ny + nw + n + 4
    for features, factor, rounded in (
        ({"seen": True, "links": False, "unbiased": False}, 5, 0),
        ({"seen": False, "links": False, "unbiased": True}, 5, 5 * 6),
        ({"seen": False, "links": True, "unbiased": False}, 9, 0),
        ({"seen": True, "links": True, "unbiased": True}, 9, 5 * 6),
    ):
        assert tolerance(real_problem(1, **features)) == (factor * size + rounded) * unit  # type: ignore[arg-type]
    assert tolerance(plain) == 5 * size * unit


@pytest.mark.parametrize(
    "part", ["mode", "plant/state", "node/n0/measurement", "node/n1/measurement", "node/n2/estimate"]
)
@pytest.mark.parametrize(("radius", "step"), [(0.85, 25), (1.02, 25), (1.02, STEPS - 1)])
def test_a_dropped_message_is_named_and_the_rest_agrees(tmp_path: Path, part: str, step: int, radius: float) -> None:
    """With x in the error state and without."""
    gains, sent = GAINS, TRUE
    if radius < 1.0:
        gains = observer_gains(real_problem(1, seen=False))
        sent = simulate(gains, steps=STEPS)
    sent = [m for m in sent if not (m.topic == part and m.document["step"] == step)]
    verdict = replay(record(tmp_path / "run.mcap", gains, sent, steps=STEPS))
    assert verdict.exit_code == 1
    assert verdict.first_divergence is None, verdict.text()
    assert (verdict.missing.total, verdict.missing.first) == (1, ((part, step),))


def test_the_path_gain_is_that_of_what_was_lost(tmp_path: Path) -> None:
    """gamma_path(k) is the norm of the map from w to the errors, column by column from runs that an impulse drives.

    Measurements that are lost take D w with them, so B of (10) is another in every step.
    """
    steps, document = 8, PROBLEM.document()
    columns = []
    for column in range(steps * PROBLEM.nw):
        w = np.zeros(steps * PROBLEM.nw)
        w[column] = 1.0
        document["disturbance"] = {"kind": "csv", "file": "w.csv", "values": w.reshape(steps, -1).tolist()}
        gains = observer_gains(Problem.from_document(document))
        sent = simulate(gains, steps=steps)
        z = {m.document["step"]: m.document["z"] for m in sent if m.topic == "plant/state"}
        columns.append(
            [
                [
                    m.document["z_hat"][0] - z[k][0]
                    for m in sent
                    if m.topic.endswith("estimate") and m.document["step"] == k
                ]
                for k in range(steps)
            ]
        )
    weights = PROBLEM.weights[:, None]
    responses = weights * np.array(columns).transpose(1, 2, 0)  # (steps, n, steps nw)
    expected = [np.linalg.norm(response, 2) for response in responses]
    log = load(record(tmp_path / "run.mcap", gains, sent, steps=steps))
    central = Central.of(log.gains)
    drawn = inputs.draw(log, central)
    complete = free_run.complete(inputs.logged_inputs(log, central, drawn), drawn, log, central)
    (block,) = free_run.free_run(log, central, complete, block=steps)
    np.testing.assert_allclose(block.path, expected, rtol=1e-9)


# mutants: messages between nodes
def test_a_lost_message_that_was_used_is_found(tmp_path: Path) -> None:
    """Whether the node says so or not."""
    k, receiver, _ = misdeed = message(arrives=False)
    honest = simulate(GAINS, steps=STEPS, uses={misdeed: True})
    assert_found(verdict_of(tmp_path, honest), step=k + 1, node=receiver, field="heard", proof=1)
    (tmp_path / "run.mcap").unlink()
    secret = simulate(GAINS, steps=STEPS, uses={misdeed: True}, says={misdeed: False})
    assert_found(verdict_of(tmp_path, secret), step=k + 1, node=receiver, field="x_hat[0]", proof=2)


def test_a_message_that_arrived_and_was_not_used_is_found(tmp_path: Path) -> None:
    k, receiver, _ = misdeed = message(arrives=True)
    honest = simulate(GAINS, steps=STEPS, uses={misdeed: False})
    verdict = verdict_of(tmp_path, honest)
    assert_found(verdict, step=k + 1, node=receiver, field="heard", proof=1)
    assert [proof.holds for proof in verdict.proofs] == [False, True, True, True, True]
    (tmp_path / "run.mcap").unlink()
    secret = simulate(GAINS, steps=STEPS, uses={misdeed: False}, says={misdeed: True})
    assert_found(verdict_of(tmp_path, secret), step=k + 1, node=receiver, field="x_hat[0]", proof=2)


@pytest.mark.parametrize("arrives", [False, True])
def test_a_wrong_word_about_a_message_is_found(tmp_path: Path, arrives: bool) -> None:
    """The node did right and says wrong: proofs 1 and 2 both fail there."""
    k, receiver, _ = misdeed = message(arrives=arrives)
    verdict = verdict_of(tmp_path, simulate(GAINS, steps=STEPS, says={misdeed: not arrives}))
    assert_found(verdict, step=k + 1, node=receiver, field="x_hat[0]", proof=2)
    assert [proof.holds for proof in verdict.proofs[:2]] == [False, False]


def test_a_run_with_the_deliveries_of_another_seed_is_found_though_it_is_consistent(tmp_path: Path) -> None:
    deliveries, names = schedule.Deliveries(PROBLEM, seed=2), PROBLEM.node_names
    uses = {
        (k, names[i], names[j]): bool(deliveries.at(k)[i, j])
        for k, i, j in product(range(STEPS), range(PROBLEM.n), range(PROBLEM.n))
    }
    verdict = verdict_of(tmp_path, simulate(GAINS, steps=STEPS, uses=uses))
    assert verdict.first_divergence is not None
    assert verdict.first_divergence.field == "heard"
    assert [proof.holds for proof in verdict.proofs] == [False, True, True, True, True]


# mutants: measurements
def test_a_lost_measurement_that_was_used_is_found(tmp_path: Path) -> None:
    k, node = measured(arrives=False)
    verdict = verdict_of(tmp_path, simulate(GAINS, steps=STEPS, peeks={(k, node)}))
    assert_found(verdict, step=k, node=node, field="innovation[0]", proof=1)


def test_an_innovation_after_a_loss_is_found(tmp_path: Path) -> None:
    k, node = measured(arrives=False)
    sent = changed(f"node/{node}/estimate", k, lambda d: d["innovation"].__setitem__(0, 1e-9))
    assert_found(verdict_of(tmp_path, sent), step=k, node=node, field="innovation[0]", proof=1)


def test_a_node_that_sees_its_losses_and_counts_with_beta_is_found(tmp_path: Path) -> None:
    k, node = measured(arrives=True)
    C = PROBLEM.nodes[PROBLEM.node_index(node)].C
    assert PROBLEM.beta[PROBLEM.node_index(node)] == 0.8

    def count_with_beta(document: dict[str, Any]) -> None:
        document["innovation"] = (np.array(document["innovation"]) + 0.2 * C @ document["x_hat"]).tolist()

    sent = changed(f"node/{node}/estimate", k, count_with_beta)
    assert_found(verdict_of(tmp_path, sent), step=k, node=node, field="innovation[0]", proof=1)


@pytest.mark.parametrize("arrives", [False, True])
def test_a_measurement_that_is_there_where_it_should_not_or_not_where_it_should_is_found(
    tmp_path: Path, arrives: bool
) -> None:
    k, node = measured(arrives=arrives)
    ny = len(PROBLEM.nodes[PROBLEM.node_index(node)].C)
    sent = changed(f"node/{node}/measurement", k, lambda d: d.update(y=[] if arrives else [0.5] * ny))
    verdict = verdict_of(tmp_path, sent)
    assert_found(verdict, step=k, node=node, field="y", proof=1)
    logged, expected = ("[]", "numbers") if arrives else ("numbers", "[]")
    assert f'step {k}: y of node "{node}" is "{logged}", expected "{expected}"' in verdict.text()


def test_a_wrong_measurement_of_a_node_that_sees_its_losses_is_found(tmp_path: Path) -> None:
    k, node = measured(arrives=True)
    sent = changed(f"node/{node}/measurement", k, lambda d: d["y"].__setitem__(0, d["y"][0] + 1e-6))
    assert_found(verdict_of(tmp_path, sent), step=k, node=node, field="y[0]", proof=1)


def test_an_empty_measurement_of_a_node_that_does_not_see_its_losses_is_strange(tmp_path: Path) -> None:
    (node,) = {"n0"} - SEEN
    verdict = verdict_of(tmp_path, changed(f"node/{node}/measurement", 12, lambda d: d.update(y=[])))
    assert verdict.exit_code == 1
    assert verdict.strange == (f"node/{node}/measurement, step 12: y has 0 numbers where the problem has 1",)


# mutants: the step
def test_a_node_that_does_not_imply_its_own_gain_is_found(tmp_path: Path) -> None:
    """x_hat_j in place of x_hat_j - x_hat_i; and a K_ii other than A less the others, by a billionth."""
    verdict = verdict_of(tmp_path, simulate(GAINS, steps=STEPS, forgets_itself=True))
    assert verdict.first_divergence is not None
    assert (verdict.first_divergence.field, verdict.first_divergence.proof) == ("x_hat[0]", 2)
    (tmp_path / "run.mcap").unlink()
    verdict = verdict_of(tmp_path, simulate(GAINS, steps=STEPS, misjudges_itself={"n2": 1e-9}))
    assert verdict.first_divergence is not None
    assert (verdict.first_divergence.node, verdict.first_divergence.proof) == ("n2", 2)


@pytest.mark.parametrize(("node", "step"), [("n0", 1), ("n1", 17), ("n3", STEPS - 1)])
def test_a_millionth_in_an_estimate_is_found(tmp_path: Path, node: str, step: int) -> None:
    def shift(document: dict[str, Any]) -> None:
        document["x_hat"][1] += 1e-6

    assert_found(
        verdict_of(tmp_path, changed(f"node/{node}/estimate", step, shift)),
        step=step,
        node=node,
        field="x_hat[1]",
        proof=2,
    )


def test_the_smallest_change_that_is_found_is_near_the_tolerance(tmp_path: Path) -> None:
    def grow(document: dict[str, Any]) -> None:
        document["x_hat"][1] += 100 * tolerance(PROBLEM) * max(1.0, abs(document["x_hat"][1]))

    verdict = verdict_of(tmp_path, changed("node/n2/estimate", 33, grow))
    assert_found(verdict, step=33, node="n2", field="x_hat[1]", proof=2)


@pytest.mark.parametrize("cut", [1, 100, 333, 507])
def test_a_cut_file_agrees_as_far_as_it_goes(tmp_path: Path, cut: int) -> None:
    """What the last estimates heard is not in it: the seed decides there."""
    verdict = verdict_of(tmp_path, TRUE[:cut], whole=False)
    assert (verdict.agrees, verdict.finished, verdict.exit_code) == (True, False, 3), verdict.text()


def test_a_jump_hidden_behind_missing_messages_is_found_by_the_free_run(tmp_path: Path) -> None:
    jumped = simulate(GAINS, steps=STEPS, nudge=(20, "n1", 1e-6))
    verdict = verdict_of(
        tmp_path, [m for m in jumped if not (m.topic.endswith("estimate") and m.document["step"] == 20)]
    )
    assert [proof.holds for proof in verdict.proofs] == [True, True, False, False, True]
    assert verdict.first_divergence is not None
    assert (verdict.first_divergence.step, verdict.first_divergence.proof) == (21, 3)


# sensors of one's own
def real_readings(seed: int = 4) -> dict[str, list[list[float]]]:
    """Noise for every node; every third reading of those that see their losses is none."""
    rng = np.random.default_rng(seed)
    return {
        node.name: [[] if node.seen and k % 3 == 0 else rng.normal(size=len(node.C)).tolist() for k in range(STEPS)]
        for node in PROBLEM.nodes
    }


@pytest.mark.parametrize("nodes", [["n1"], ["n0", "n3"], ["n0", "n1", "n2", "n3"]])
def test_estimates_are_compared_where_sensors_are_real(tmp_path: Path, nodes: list[str]) -> None:
    real = {name: readings for name, readings in real_readings().items() if name in nodes}
    sent = simulate(GAINS, steps=STEPS, real_y=real)
    if len(nodes) == PROBLEM.n:
        sent = [m for m in sent if m.topic != "plant/state"]
    verdict = verdict_of(tmp_path, sent, external=",".join(nodes))
    assert verdict.exit_code == 0, verdict.text()
    assert all(proof.compared for proof in verdict.proofs[:4])
    assert verdict.proofs[4].holds is None


def test_mutants_among_real_sensors_are_found(tmp_path: Path) -> None:
    real = real_readings()
    sent = [m for m in simulate(GAINS, steps=STEPS, real_y=real) if m.topic != "plant/state"]
    at = next(i for i, m in enumerate(sent) if m.topic == "node/n1/estimate" and m.document["step"] == 30)
    for number, (field, name) in enumerate((("x_hat", "x_hat[0]"), ("innovation", "innovation[0]"))):
        values = [value + 1e-6 for value in sent[at].document[field]]
        mutant = [*sent[:at], sent[at]._replace(document=sent[at].document | {field: values}), *sent[at + 1 :]]
        path = record(tmp_path / f"{number}.mcap", GAINS, mutant, steps=STEPS, external=",".join(real))
        assert_found(replay(path), step=30, node="n1", field=name, proof=2 if field == "x_hat" else 1)
    k, receiver, _ = misdeed = message(arrives=False)
    secret = simulate(GAINS, steps=STEPS, real_y=real, uses={misdeed: True}, says={misdeed: False})
    secret = [m for m in secret if m.topic != "plant/state"]
    path = record(tmp_path / "secret.mcap", GAINS, secret, steps=STEPS, external=",".join(real))
    assert_found(replay(path), step=k + 1, node=receiver, field="x_hat[0]", proof=2)


@pytest.mark.parametrize("step", [12, 13])
def test_a_reading_that_is_missing_is_made_up_for_by_the_innovation(tmp_path: Path, step: int) -> None:
    """Whether the sensor had one or none: proof 3 goes on behind it."""
    real = real_readings()
    sent = [m for m in simulate(GAINS, steps=STEPS, real_y=real) if m.topic != "plant/state"]
    assert bool(real["n1"][step]) == (step == 13)
    sent = [m for m in sent if not (m.topic == "node/n1/measurement" and m.document["step"] == step)]
    verdict = verdict_of(tmp_path, sent, external=",".join(real))
    assert verdict.first_divergence is None, verdict.text()
    assert verdict.missing.first == (("node/n1/measurement", step),)
    assert verdict.proofs[2].compared == STEPS * PROBLEM.n * PROBLEM.nx
