"""Replay is a checker, so it is tested with mutants: one fault is planted at a time, and must be found and named."""

from __future__ import annotations

import json
import random
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from made_recordings import Sent, random_gains, random_problem, record, simulate
from mcap.writer import Writer
from places import ROOT

from agent.contract.errors import InputError
from agent.contract.gains import Gains
from designer.replay import replay, tolerance
from designer.replay.verdict import Verdict

STEPS = 60
GAINS = random_gains(random_problem(3))
TRUE = simulate(GAINS, steps=STEPS)
GOLDEN = ROOT / "recordings" / "golden" / "zhu2020-lossy.gains.json"

Mutate = Callable[[dict[str, Any]], None]


def verdict_of(folder: Path, sent: list[Sent], **facts: Any) -> Verdict:
    return replay(record(folder / "run.mcap", GAINS, sent, steps=STEPS, **facts))


def place(topic: str, step: int) -> int:
    """Where the message stands in TRUE."""
    return next(i for i, m in enumerate(TRUE) if m.topic == topic and m.document["step"] == step)


def changed(topic: str, step: int, mutate: Mutate, sent: list[Sent] = TRUE) -> list[Sent]:
    """TRUE with one payload changed."""
    at = place(topic, step)
    document = {key: list(value) if isinstance(value, list) else value for key, value in sent[at].document.items()}
    mutate(document)
    assert document != sent[at].document
    return [*sent[:at], sent[at]._replace(document=document), *sent[at + 1 :]]


def assert_found(verdict: Verdict, *, step: int, node: str | None, field: str) -> None:
    assert not verdict.agrees
    assert verdict.exit_code == 1
    first = verdict.first_divergence
    assert first is not None
    assert (first.step, first.node, first.field) == (step, node, field)
    assert first.gap > verdict.tolerance
    assert f"first divergence, step {step}: {field}" in verdict.text()


# what is true is believed
def test_a_true_recording_agrees(tmp_path: Path) -> None:
    verdict = verdict_of(tmp_path, TRUE)
    assert verdict.agrees
    assert verdict.finished
    assert verdict.exit_code == 0
    assert verdict.steps == STEPS
    assert verdict.first_divergence is None
    assert 0.0 < verdict.worst_gap < verdict.tolerance
    assert (verdict.missing.total, verdict.duplicates.total) == (0, 0)
    assert all(proof.holds and proof.compared for proof in verdict.proofs)
    assert "agrees" in verdict.text()


def test_peak_energy_and_gamma_are_those_of_the_run(tmp_path: Path) -> None:
    verdict = verdict_of(tmp_path, TRUE)
    states = [m.document for m in TRUE if m.topic == "plant/state"]
    errors = np.zeros((STEPS, GAINS.problem.n))
    for i, name in enumerate(GAINS.problem.node_names):
        for m in TRUE:
            if m.topic == f"node/{name}/estimate":
                errors[m.document["step"], i] = states[m.document["step"]]["z"][0] - m.document["z_hat"][0]
    norms = np.linalg.norm(errors, axis=1)
    assert verdict.peak is not None
    assert (verdict.peak.size, verdict.peak.step) == (pytest.approx(norms.max(), rel=1e-12), norms.argmax())
    assert verdict.energy == pytest.approx(sum(np.square(state["w"]).sum() for state in states), rel=1e-12)
    assert verdict.gamma.value == GAINS.certificate.gamma
    assert verdict.path_margin is not None
    assert 0.0 < verdict.path_margin < 1.0


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize(
    ("ny", "modes", "nx", "nw", "nz"),
    [
        ((1, 1, 1, 1), 4, 2, 1, 1),
        ((1,), 1, 1, 1, 1),
        ((2,), 3, 3, 2, 2),
        ((3, 1, 2), 1, 2, 3, 2),
        ((1,) * 8, 2, 4, 1, 3),
    ],
)
def test_random_networks_agree(
    tmp_path: Path, seed: int, ny: tuple[int, ...], modes: int, nx: int, nw: int, nz: int
) -> None:
    gains = random_gains(random_problem(seed, ny=ny, modes=modes, nx=nx, nw=nw, nz=nz), seed)
    path = record(tmp_path / "run.mcap", gains, simulate(gains, steps=40, seed=seed), steps=40, seed=seed)
    verdict = replay(path)
    assert verdict.exit_code == 0, verdict.text()


@pytest.mark.parametrize("seed", range(3))
def test_the_order_of_the_file_does_not_matter(tmp_path: Path, seed: int) -> None:
    shuffled = changed("node/n1/estimate", 30, lambda d: d["x_hat"].__setitem__(0, d["x_hat"][0] + 1e-6))
    shuffled.append(TRUE[place("node/n2/estimate", 7)]._replace(number=1))
    straight = record(tmp_path / "straight.mcap", GAINS, shuffled, steps=STEPS)
    random.Random(seed).shuffle(shuffled)
    mixed = record(tmp_path / "mixed.mcap", GAINS, shuffled, steps=STEPS)
    verdicts = [replay(path).document() | {"recording": ""} for path in (straight, mixed)]
    assert verdicts[0] == verdicts[1]


def test_gains_and_magnitudes_may_have_any_size(tmp_path: Path) -> None:
    """The tolerance is relative to what enters: a run in other units agrees as well."""
    document = GAINS.problem.document()
    for scale in (1e-9, 1e9):
        document["disturbance"] = {"kind": "white", "deviation": scale}
        gains = random_gains(type(GAINS.problem).from_document(document), 5)
        path = record(tmp_path / f"{scale}.mcap", gains, simulate(gains, steps=STEPS), steps=STEPS)
        assert replay(path).exit_code == 0


def test_a_quiet_run_and_one_that_dies_away_agree(tmp_path: Path) -> None:
    for number, disturbance in enumerate(({"kind": "none"}, {"kind": "damped-sine", "decay": 9.0})):
        document = GAINS.problem.document() | {"disturbance": disturbance}
        gains = random_gains(type(GAINS.problem).from_document(document), 5)
        path = record(tmp_path / f"{number}.mcap", gains, simulate(gains, steps=900), steps=900)
        assert replay(path).exit_code == 0


# gamma
def golden_run(folder: Path, gains: Gains) -> Verdict:
    return replay(record(folder / "run.mcap", gains, simulate(gains, steps=STEPS), steps=STEPS))


def test_a_certificate_that_holds_is_said_to_hold(tmp_path: Path) -> None:
    gains = Gains.load(GOLDEN)
    verdict = golden_run(tmp_path, gains)
    assert (verdict.document()["certificate"], verdict.document()["certificate_failure"]) == (True, None)
    text = verdict.text()
    assert "certificate  holds" in text
    assert "in the mean over modes, losses and deliveries, from zero initial error; one run may exceed it" in text
    assert f"with gamma {gains.certificate.gamma:.5g}" in text


def test_an_edited_gain_is_not_proved_by_the_certificate_that_it_kept(tmp_path: Path) -> None:
    """The log is what these gains give: it agrees. What the file says of gamma is another matter."""
    document = Gains.load(GOLDEN).document()
    document["K"]["1"]["1"]["1"][0][0] += 0.5
    verdict = golden_run(tmp_path, Gains.model_validate(document))
    assert (verdict.agrees, verdict.exit_code) == (True, 0)
    assert verdict.document()["certificate"] is False
    assert verdict.document()["certificate_failure"].startswith('(17) fails in mode "1"')
    assert 'certificate  FAILS: (17) fails in mode "1"' in verdict.text()
    assert "gamma is not proved for these gains" in verdict.text()
    assert "gamma bounds" not in verdict.text()


@pytest.mark.parametrize("change", [{"horizon": 0}, {"R": None}, {"R": [[1e308, 0.0], [0.0, 1e308]]}])
def test_a_certificate_that_cannot_be_checked_proves_nothing(tmp_path: Path, change: dict[str, Any]) -> None:
    document = Gains.load(GOLDEN).document()
    document["certificate"] |= change
    verdict = golden_run(tmp_path, Gains.model_validate(document))
    assert (verdict.exit_code, verdict.document()["certificate"]) == (0, False)
    assert "certificate  FAILS" in verdict.text()


def test_a_gamma_that_is_not_claimed_is_not_shown(tmp_path: Path) -> None:
    verdict = verdict_of(tmp_path, TRUE)
    assert verdict.document()["certificate"] is False
    assert "gamma is not claimed" in verdict.text()
    assert "sqrt(energy)" not in verdict.text()
    assert "gamma bounds" not in verdict.text()


def test_the_step_at_which_the_path_bound_is_an_equality_is_no_near_failure(tmp_path: Path) -> None:
    """With one disturbance |z_tilde(1)| = |M B w(0)| = gamma_path(1) |w(0)|, whatever the network."""
    gains = random_gains(random_problem(3, nw=1))
    verdict = replay(record(tmp_path / "run.mcap", gains, simulate(gains, steps=STEPS), steps=STEPS))
    assert verdict.path_margin is not None
    assert verdict.path_margin > 1e-3
    assert "at step 1 the bound is an equality, because w is one number" in verdict.text()
    (tmp_path / "run.mcap").unlink()
    gains = random_gains(random_problem(3, nw=1))
    verdict = replay(record(tmp_path / "run.mcap", gains, simulate(gains, steps=2), steps=2))
    assert verdict.path_margin is None
    assert "(2 steps; at step 1 the bound is an equality" in verdict.text()


# every message once
@pytest.mark.parametrize("topic", ["mode", "plant/state", "node/n0/measurement", "node/n2/estimate"])
@pytest.mark.parametrize("step", [0, 25, STEPS - 1])
def test_a_dropped_message_is_named(tmp_path: Path, topic: str, step: int) -> None:
    at = place(topic, step)
    verdict = verdict_of(tmp_path, [*TRUE[:at], *TRUE[at + 1 :]])
    assert verdict.exit_code == 1
    assert verdict.first_divergence is None, "what is there agrees"
    assert (verdict.missing.total, verdict.missing.first) == (1, ((topic, step),))
    assert f"missing: 1 ({topic} step {step})" in verdict.text()


def test_a_dropped_event_is_found_by_its_number(tmp_path: Path) -> None:
    verdict = verdict_of(tmp_path, TRUE[1:])
    assert verdict.exit_code == 1
    assert verdict.numbering == ("1 more messages of coordinator are missing, by its numbers 0",)


def test_an_event_of_another_sender_does_not_fill_a_gap_twice(tmp_path: Path) -> None:
    sent = [m for m in TRUE if m.topic != "node/n0/estimate"]
    sent += [m._replace(number=m.number + 1) for m in TRUE if m.topic == "node/n0/estimate"]
    verdict = verdict_of(tmp_path, sent)  # n0 and the coordinator lack a number 0, and there is one event 0
    assert len(verdict.numbering) == 1


def test_a_duplicated_message_is_named(tmp_path: Path) -> None:
    at = place("node/n1/estimate", 12)
    verdict = verdict_of(tmp_path, [*TRUE, TRUE[at]])
    assert verdict.exit_code == 1
    assert (verdict.duplicates.total, verdict.duplicates.first) == (1, (("node/n1/estimate", 12),))
    assert "double: 1 (node/n1/estimate step 12)" in verdict.text()


def test_a_repeated_number_is_found(tmp_path: Path) -> None:
    at = place("node/n1/estimate", 12)
    verdict = verdict_of(tmp_path, [*TRUE[:at], TRUE[at]._replace(number=11), *TRUE[at + 1 :]])
    assert verdict.exit_code == 1
    assert any("node/n1/estimate has number 11 after 11" in fault for fault in verdict.numbering)


# what is in the messages
def test_swapped_estimates_of_neighbouring_steps_are_found(tmp_path: Path) -> None:
    one, two = place("node/n1/estimate", 20), place("node/n1/estimate", 21)
    sent = list(TRUE)
    for at, other, step in ((one, two, 20), (two, one, 21)):
        sent[at] = TRUE[at]._replace(document=TRUE[other].document | {"step": step})
    assert_found(verdict_of(tmp_path, sent), step=20, node="n1", field="x_hat[0]")


def test_swapped_payloads_with_their_steps_are_found_by_their_numbers(tmp_path: Path) -> None:
    one, two = place("node/n1/estimate", 20), place("node/n1/estimate", 21)
    sent = list(TRUE)
    sent[one], sent[two] = (
        TRUE[one]._replace(document=TRUE[two].document),
        TRUE[two]._replace(document=TRUE[one].document),
    )
    verdict = verdict_of(tmp_path, sent)
    assert verdict.exit_code == 1
    assert verdict.numbering == ("node/n1/estimate has number 20 after 21, against the order of its steps",)


def test_swapped_estimates_of_two_nodes_are_found(tmp_path: Path) -> None:
    one, two = place("node/n0/estimate", 20), place("node/n2/estimate", 20)
    sent = list(TRUE)
    sent[one], sent[two] = (
        TRUE[one]._replace(document=TRUE[two].document),
        TRUE[two]._replace(document=TRUE[one].document),
    )
    assert_found(verdict_of(tmp_path, sent), step=20, node="n0", field="x_hat[0]")


def test_one_unit_in_the_last_place_lies_within_the_tolerance_and_is_shown(tmp_path: Path) -> None:
    def nudge(document: dict[str, Any]) -> None:
        document["x_hat"][1] = float(np.nextafter(document["x_hat"][1], np.inf))

    verdict = verdict_of(tmp_path, changed("node/n2/estimate", 33, nudge))
    assert verdict.exit_code == 0
    assert 0.0 < verdict.worst_gap < verdict.tolerance
    worst = verdict.worst
    assert worst is not None
    assert worst.node is not None
    place = f'largest gap {verdict.worst_gap:.1e}, at step {worst.step} in {worst.field} of node "{worst.node}"; '
    assert f"{place}tolerance {verdict.tolerance:.1e} (" in verdict.text()
    assert "expected" not in verdict.text(), "so that it does not look like a failure"


def test_the_smallest_change_that_is_found_is_near_the_tolerance(tmp_path: Path) -> None:
    """The worst gap is what was planted, so that a change inside the tolerance is explained by its size."""

    def grow(document: dict[str, Any]) -> None:
        document["x_hat"][1] += 100 * tolerance(GAINS.problem) * max(1.0, abs(document["x_hat"][1]))

    verdict = verdict_of(tmp_path, changed("node/n2/estimate", 33, grow))
    assert_found(verdict, step=33, node="n2", field="x_hat[1]")


@pytest.mark.parametrize(("node", "step", "entry"), [("n0", 1, 0), ("n1", 17, 1), ("n3", STEPS - 1, 0)])
def test_a_millionth_in_an_estimate_is_found(tmp_path: Path, node: str, step: int, entry: int) -> None:
    def shift(document: dict[str, Any]) -> None:
        document["x_hat"][entry] += 1e-6

    verdict = verdict_of(tmp_path, changed(f"node/{node}/estimate", step, shift))
    assert_found(verdict, step=step, node=node, field=f"x_hat[{entry}]")
    first = verdict.first_divergence
    assert first is not None
    assert isinstance(first.logged, float)
    assert first.logged - float(first.expected) == pytest.approx(1e-6, rel=1e-3)


def test_an_estimate_that_does_not_begin_at_zero_is_found(tmp_path: Path) -> None:
    verdict = verdict_of(tmp_path, changed("node/n1/estimate", 0, lambda d: d.update(x_hat=[1e-9, 0.0])))
    assert_found(verdict, step=0, node="n1", field="x_hat[0]")


def test_a_wrong_innovation_and_a_wrong_output_are_found(tmp_path: Path) -> None:
    verdict = verdict_of(tmp_path, changed("node/n1/estimate", 9, lambda d: d["innovation"].__setitem__(1, 0.0)))
    assert_found(verdict, step=9, node="n1", field="innovation[1]")
    (tmp_path / "run.mcap").unlink()
    verdict = verdict_of(tmp_path, changed("node/n2/estimate", 9, lambda d: d["z_hat"].__setitem__(0, 0.0)))
    assert_found(verdict, step=9, node="n2", field="z_hat[0]")


def _other_mode(document: dict[str, Any]) -> None:
    document["mode"] = "mode-0" if document["mode"] != "mode-0" else "mode-1"


def test_a_wrong_mode_is_found(tmp_path: Path) -> None:
    verdict = verdict_of(tmp_path, changed("mode", 14, _other_mode))
    assert_found(verdict, step=14, node=None, field="mode")
    assert "mode of the coordinator" in verdict.text()


def test_a_mode_that_does_not_exist_is_found(tmp_path: Path) -> None:
    verdict = verdict_of(tmp_path, changed("mode", 14, lambda d: d.update(mode="nowhere")))
    assert_found(verdict, step=14, node=None, field="mode")


def test_a_wrong_word_of_a_node_about_its_mode_or_its_neighbours_is_found(tmp_path: Path) -> None:
    verdict = verdict_of(tmp_path, changed("node/n3/estimate", 14, _other_mode))
    assert_found(verdict, step=14, node="n3", field="mode")
    (tmp_path / "run.mcap").unlink()
    verdict = verdict_of(tmp_path, changed("node/n3/estimate", 14, lambda d: d.update(heard=["n9"])))
    assert_found(verdict, step=14, node="n3", field="heard")


def test_a_run_in_other_modes_than_the_seed_draws_is_found_though_it_is_consistent(tmp_path: Path) -> None:
    sent = simulate(GAINS, steps=STEPS, seed=2)
    verdict = verdict_of(tmp_path, sent, seed=1)
    assert not verdict.agrees
    assert [proof.holds for proof in verdict.proofs] == [False, True, True, True, True]


def test_a_wrong_theta_is_found(tmp_path: Path) -> None:
    step = next(m.document["step"] for m in TRUE if m.topic == "plant/state" and m.document["arrived"][1] == 0)
    verdict = verdict_of(tmp_path, changed("plant/state", step, lambda d: d["arrived"].__setitem__(1, 1)))
    assert_found(verdict, step=step, node="n1", field="arrived")


def test_a_wrong_measurement_is_found(tmp_path: Path) -> None:
    verdict = verdict_of(tmp_path, changed("node/n1/measurement", 8, lambda d: d["y"].__setitem__(1, d["y"][1] + 1e-6)))
    assert_found(verdict, step=8, node="n1", field="y[1]")


@pytest.mark.parametrize("field", ["x", "z", "w"])
def test_an_altered_plant_state_is_found(tmp_path: Path, field: str) -> None:
    verdict = verdict_of(tmp_path, changed("plant/state", 8, lambda d: d[field].__setitem__(0, d[field][0] + 1e-6)))
    assert_found(verdict, step=8, node=None, field=f"{field}[0]")


def test_a_jump_hidden_behind_missing_messages_is_found_by_the_free_run(tmp_path: Path) -> None:
    """The estimates of one step are gone, and all goes on consistently from others: only proof 3 can tell."""
    jumped = simulate(GAINS, steps=STEPS, nudge=(20, "n1", 1e-6))
    sent = [m for m in jumped if not (m.topic.endswith("estimate") and m.document["step"] == 20)]
    verdict = verdict_of(tmp_path, sent)
    assert [proof.holds for proof in verdict.proofs] == [True, True, False, False, True]
    first = verdict.first_divergence
    assert first is not None
    assert (first.step, first.proof) == (21, 3)


def test_wrong_gains_are_found_by_their_digest_and_by_their_numbers(tmp_path: Path) -> None:
    other = random_gains(GAINS.problem, 9)
    path = record(tmp_path / "digest.mcap", other, TRUE, steps=STEPS, gains=GAINS.digest())
    assert any("digests differ" in strange for strange in replay(path).strange)
    path = record(tmp_path / "numbers.mcap", other, TRUE, steps=STEPS)
    verdict = replay(path)
    assert verdict.strange == ()
    assert_found(verdict, step=1, node="n0", field="x_hat[0]")
    assert [proof.holds for proof in verdict.proofs[:4]] == [True, False, False, True]


def test_a_slightly_wrong_gain_is_found(tmp_path: Path) -> None:
    document = GAINS.document()
    mode = GAINS.problem.mode_names[-1]
    document["K"][mode]["n2"]["n2"][0][1] += 1e-9
    path = record(tmp_path / "run.mcap", Gains.model_validate(document), TRUE, steps=STEPS)
    verdict = replay(path)
    assert verdict.first_divergence is not None
    assert (verdict.first_divergence.node, verdict.first_divergence.field) == ("n2", "x_hat[0]")


def test_foreign_messages_are_named(tmp_path: Path) -> None:
    topic = "node/n1/estimate"
    for number, (mutate, words) in enumerate(
        (
            (lambda d: d.update(x_hat=[1.0, 2.0, 3.0]), "x_hat has 3 numbers where the problem has 2"),
            (lambda d: d.update(step=STEPS), f"the run has only {STEPS} steps"),
            (lambda d: d.update(innovation=[1e300, 0.0]), "innovation holds 1e+300, beyond 1e+140"),
            (lambda d: d.pop("heard"), "field required"),
        )
    ):
        path = record(tmp_path / f"{number}.mcap", GAINS, changed(topic, 5, mutate), steps=STEPS)
        verdict = replay(path)
        assert verdict.exit_code == 1
        assert words in verdict.strange[0]
        assert verdict.missing.first == ((topic, 5),)
    path = record(
        tmp_path / "topic.mcap", GAINS, [TRUE[0], *TRUE, TRUE[1]._replace(topic="node/x/estimate")], steps=STEPS
    )
    assert "this problem has no such topic" in replay(path).strange[0]


# the file
def test_a_cut_file_is_read_as_far_as_it_goes(tmp_path: Path) -> None:
    cut = place("node/n2/estimate", 40)
    verdict = verdict_of(tmp_path, TRUE[:cut], whole=False)
    assert (verdict.agrees, verdict.finished, verdict.exit_code) == (True, False, 3)
    assert verdict.status == "cut"
    assert verdict.steps == 41
    assert ("node/n2/estimate", 40) in verdict.missing.first
    assert f"41 of {STEPS} steps" in verdict.text()
    assert verdict.proofs[3].holds is None
    assert f"4 cut    every message is there once ({cut} messages; " in verdict.text()
    assert f"{verdict.missing.total} lacking from step 40 on)" in verdict.text()
    assert "is not whole" in verdict.text()


def test_a_cut_file_that_diverges_before_the_cut_diverges(tmp_path: Path) -> None:
    sent = changed("node/n1/estimate", 20, lambda d: d["x_hat"].__setitem__(0, d["x_hat"][0] + 1e-6))
    verdict = verdict_of(tmp_path, sent[: place("mode", 40)], whole=False)
    assert_found(verdict, step=20, node="n1", field="x_hat[0]")


@pytest.mark.parametrize("share", [0.7, 0.9, 0.99])
def test_a_truncated_file_is_no_whole_run(tmp_path: Path, share: float) -> None:
    path = record(tmp_path / "run.mcap", GAINS, TRUE, steps=STEPS)
    path.write_bytes(path.read_bytes()[: int(share * path.stat().st_size)])
    verdict = replay(path)
    assert verdict.exit_code == 3
    assert "cut or damaged" in verdict.damage
    assert "cut or damaged" in verdict.text()


def test_a_file_cut_before_its_first_message_is_refused(tmp_path: Path) -> None:
    path = record(tmp_path / "run.mcap", GAINS, TRUE, steps=STEPS)
    path.write_bytes(path.read_bytes()[:2000])
    with pytest.raises(InputError, match="cut or damaged before its first message"):
        replay(path)


def test_a_stopped_run_is_not_finished(tmp_path: Path) -> None:
    verdict = verdict_of(tmp_path, TRUE[: place("mode", 40)], status="stopped")
    assert (verdict.agrees, verdict.finished, verdict.exit_code) == (True, False, 3)
    assert verdict.status == "stopped"


def test_flipped_bits_never_pass_for_a_good_run_with_other_numbers(tmp_path: Path) -> None:
    path = record(tmp_path / "run.mcap", GAINS, TRUE, steps=STEPS)
    data, good = path.read_bytes(), replay(path).document()
    rng = np.random.default_rng(0)
    refused = 0
    for position in rng.integers(len(data), size=60):
        broken = bytearray(data)
        broken[position] ^= 1 << int(rng.integers(8))
        path.write_bytes(broken)
        try:
            verdict = replay(path)
        except InputError:
            refused += 1
        else:
            refused += verdict.exit_code != 0
            assert verdict.exit_code != 0 or verdict.document() == good
    assert refused > 40


def test_joined_files_are_not_one_run(tmp_path: Path) -> None:
    one = record(tmp_path / "one.mcap", GAINS, TRUE, steps=STEPS)
    two = record(tmp_path / "two.mcap", GAINS, simulate(GAINS, steps=STEPS, seed=2), steps=STEPS, seed=2)
    one.write_bytes(one.read_bytes() + two.read_bytes())
    verdict = replay(one)
    assert verdict.exit_code == 3
    assert "as if files had been joined" in verdict.damage
    assert "as if files had been joined" in verdict.text()


def test_a_second_run_in_one_file_is_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    finish = Writer.finish

    def begin_again(writer: Writer) -> None:
        writer.add_metadata("run", {"format": "peakmesh-recording", "version": "1", "run": "second"})
        finish(writer)

    monkeypatch.setattr(Writer, "finish", begin_again)
    verdict = verdict_of(tmp_path, TRUE)
    assert verdict.exit_code == 3
    assert verdict.damage == "it holds the beginning of a second run"


def test_messages_of_another_run_are_found(tmp_path: Path) -> None:
    other = simulate(GAINS, steps=STEPS, seed=2)
    verdict = verdict_of(tmp_path, [*TRUE, *other[200:230]])
    assert verdict.exit_code == 1
    assert verdict.duplicates.total == 30


def test_a_run_shortened_afterwards_is_found(tmp_path: Path) -> None:
    sent = [m for m in TRUE if m.document["step"] < 50 or m.topic == "event"]
    verdict = verdict_of(tmp_path, sent, end_steps=50)
    assert verdict.exit_code == 1
    assert "finished after 50 of 60 steps" in verdict.text()
    (tmp_path / "run.mcap").unlink()
    verdict = verdict_of(tmp_path, TRUE, end_steps=50)
    assert "the run ended after 50 steps" in verdict.text()


@pytest.mark.parametrize("sent", [[], TRUE[:1]])
def test_a_run_of_which_nothing_is_there_is_no_good_run(tmp_path: Path, sent: list[Sent]) -> None:
    verdict = verdict_of(tmp_path, sent)
    assert verdict.exit_code == 1
    assert verdict.missing.total == 10 * STEPS
    (tmp_path / "run.mcap").unlink()
    assert verdict_of(tmp_path, sent, whole=False).exit_code == 3


def test_a_run_whose_facts_make_no_sense_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r'gives "1.5" for seed'):
        verdict_of(tmp_path, TRUE, seed="1.5")
    (tmp_path / "run.mcap").unlink()
    with pytest.raises(InputError, match='node "n9" does not exist'):
        verdict_of(tmp_path, TRUE, external="n9")


def test_json_has_the_promised_keys_and_only_plain_values(tmp_path: Path) -> None:
    promised = "agrees finished steps worst_gap tolerance first_divergence missing duplicates peak energy gamma"
    for number, sent in enumerate((TRUE, changed("mode", 14, _other_mode), TRUE[:100], [])):
        path = record(tmp_path / f"{number}.mcap", GAINS, sent, steps=STEPS)
        document = json.loads(json.dumps(replay(path).document(), allow_nan=False))
        assert set(promised.split()) <= set(document)


# real sensors
def test_estimates_are_compared_where_a_sensor_is_real(tmp_path: Path) -> None:
    real = {"n1": np.random.default_rng(4).normal(size=(STEPS, 2))}
    sent = simulate(GAINS, steps=STEPS, real_y=real)
    verdict = verdict_of(tmp_path, sent, external="n1")
    assert verdict.exit_code == 0, verdict.text()
    assert (verdict.energy, verdict.path_margin) == (None, None)
    assert all(proof.compared for proof in verdict.proofs[:4])
    assert verdict.proofs[4].holds is None
    assert 'sensors of their own: "n1"' in verdict.text()
    assert "it does not apply" in verdict.text()
    assert "no simulated plant" not in verdict.text()
    assert verdict.peak is not None
    assert f"peak |z~| {verdict.peak.size:.4g} against the simulated plant" in verdict.text()
    assert verdict.document()["external"] == ["n1"]
    (tmp_path / "run.mcap").unlink()
    assert verdict_of(tmp_path, sent).first_divergence.field == "y[0]"  # type: ignore[union-attr]


def test_nothing_but_sensors_and_nodes_can_be_replayed(tmp_path: Path) -> None:
    rng = np.random.default_rng(4)
    real = {node.name: rng.normal(size=(STEPS, len(node.C))) for node in GAINS.problem.nodes}
    sent = [m for m in simulate(GAINS, steps=STEPS, real_y=real) if m.topic != "plant/state"]
    verdict = verdict_of(tmp_path, sent, external=",".join(real))
    assert verdict.exit_code == 0, verdict.text()
    assert verdict.peak is None
    assert "no simulated plant: nothing is known of the error" in verdict.text()
    (tmp_path / "run.mcap").unlink()
    at = next(i for i, m in enumerate(sent) if m.topic == "node/n3/estimate" and m.document["step"] == 30)
    x_hat = [value + 1e-6 for value in sent[at].document["x_hat"]]
    sent[at] = sent[at]._replace(document=sent[at].document | {"x_hat": x_hat})
    verdict = verdict_of(tmp_path, sent, external=",".join(real))
    assert_found(verdict, step=30, node="n3", field="x_hat[0]")


# honesty
def test_replay_shares_no_step_arithmetic_with_the_nodes() -> None:
    program = (
        "import sys, designer.replay; print([m for m in sys.modules if m.startswith(('agent', 'zenoh', 'cvxpy'))])"
    )
    loaded = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True).stdout
    assert all(name.strip("[]' \n").startswith("agent.contract") for name in loaded.split(", ") if "agent." in name)
    assert "zenoh" not in loaded
    assert "cvxpy" not in loaded


def test_the_path_inequality_can_fail(tmp_path: Path) -> None:
    """Without disturbance there is no error to be had: any one breaks it."""
    document = GAINS.problem.document() | {"disturbance": {"kind": "none"}}
    gains = random_gains(type(GAINS.problem).from_document(document), 5)
    sent = simulate(gains, steps=STEPS)
    at = next(i for i, m in enumerate(sent) if m.topic == "plant/state" and m.document["step"] == 3)
    sent[at] = sent[at]._replace(document=sent[at].document | {"z": [0.1]})
    verdict = replay(record(tmp_path / "run.mcap", gains, sent, steps=STEPS))
    assert not verdict.proofs[4].holds
