"""The numbers of a report are those of the recording, and its bounds are proved."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from made_recordings import observer_gains, random_gains, random_problem, real_problem, record, simulate
from places import GOLDEN
from reports import account_of, recorded

from agent.contract import schedule
from agent.contract.errors import RunBroken
from agent.contract.gains import Gains
from designer.chance import Chance
from designer.problems import find
from designer.proof.certificate import prover_of
from designer.proof.prover import Prover
from designer.report.account import Account, over_nodes
from designer.single_run import least_of_P, single_run
from designer.synthesis import design
from designer.undercut import undercut

GOLDEN_RUN = GOLDEN / "zhu2020-lossy.mcap"


def test_errors_are_those_of_the_recording(tmp_path: Path) -> None:
    account = account_of(tmp_path, nz=2)
    log = account.log
    for i in range(4):
        np.testing.assert_array_equal(account.errors[:, i], log.z - log.z_hat[:, 2 * i : 2 * i + 2])
    np.testing.assert_allclose(np.linalg.norm(account.sizes, axis=1), log.error_norms(), rtol=1e-14)
    assert account.ranking[0] == np.argmax((account.sizes**2).sum(axis=0))
    assert (np.diff(account.rms[account.ranking]) <= 0.0).all()


def test_every_step_has_its_gaps_and_the_largest_are_the_verdicts(tmp_path: Path) -> None:
    """Also where a node was moved: its step is the first one above the tolerance."""
    account = Account.of(recorded(tmp_path, nudge=(17, "n1", 1e-3)))
    for proof in account.verdict.proofs[:3]:
        assert np.nanmax(account.trace.gaps[proof.number]) == proof.worst_gap
    beyond = {step for gap in account.trace.gaps.values() for step in np.flatnonzero(gap > account.verdict.tolerance)}
    assert account.verdict.first_divergence is not None
    assert min(beyond) == account.verdict.first_divergence.step == 17


def test_the_path_bound_of_every_step_is_the_one_that_replay_checks(tmp_path: Path) -> None:
    """Its smallest margin is the verdict's; the error is below it at every step."""
    account = Account.of(GOLDEN_RUN)
    errors, bound = account.log.error_norms(), account.trace.path_bound
    assert (errors <= bound * (1.0 + 1e-12) + 1e-15).all()
    margins = 1.0 - errors[2:] / bound[2:]  # at step 1 it is an equality, w is one number
    assert margins.min() == pytest.approx(account.verdict.path_margin, rel=1e-9)
    energies = (account.log.w**2).sum(axis=1)
    np.testing.assert_allclose(account.trace.energy_before[1:], np.cumsum(energies)[:-1], rtol=1e-14)


def test_losses_and_messages_that_were_not_used_are_the_seeds(tmp_path: Path) -> None:
    gains = observer_gains(real_problem(5, ny=(1, 2, 1)))
    account = Account.of(record(tmp_path / "run.mcap", gains, simulate(gains, steps=50), steps=50))
    losses, deliveries = schedule.Losses(gains.problem, seed=1), schedule.Deliveries(gains.problem, seed=1)
    assert account.done_without[:-1].sum() > 0
    for k in range(50):
        np.testing.assert_array_equal(account.lost[k], 1.0 - losses.at(k))
        if k < 49:
            hears = gains.problem.topologies[account.log.mode[k]].adjacency > 0.0
            np.testing.assert_array_equal(account.done_without[k], (hears & ~deliveries.at(k)).sum(axis=1))
    assert np.isnan(account.done_without[-1]).all(), "the last step has no successor that could say it"


def test_of_real_sensors_only_what_they_say_is_known(tmp_path: Path) -> None:
    gains = random_gains(random_problem(3))
    sent = simulate(gains, steps=20, real_y={"n1": np.zeros((20, 2))})
    account = Account.of(record(tmp_path / "run.mcap", gains, sent, steps=20, external="n1"))
    assert np.isnan(account.lost[:, 1]).all()
    assert np.isfinite(account.lost[:, [0, 2, 3]]).all()
    z_hat = account.log.z_hat
    np.testing.assert_array_equal(account.errors[:, :, 0], z_hat - np.median(z_hat, axis=1)[:, None])
    assert account.mean_bound is account.verdict.chance is None


def test_a_run_settles_where_everything_stays_small() -> None:
    account = Account.of(GOLDEN_RUN)
    size = np.abs(np.hstack([account.log.z, account.log.z_hat])).max(axis=1)
    assert account.settled < account.log.steps
    assert size[account.settled :].max() <= 0.01 * size.max() < size[account.settled - 2]


def test_one_that_does_not_settle_is_shown_whole(tmp_path: Path) -> None:
    assert account_of(tmp_path).settled == 50


def test_without_a_step_there_is_nothing_to_report(tmp_path: Path) -> None:
    gains = random_gains(random_problem(3))
    path = record(tmp_path / "run.mcap", gains, [], steps=50, whole=False)
    with pytest.raises(RunBroken, match="holds no step of its run, so there is nothing to report"):
        Account.of(path)


def test_nodes_of_which_nothing_is_known_count_for_nothing() -> None:
    values = np.array([[1.0, np.nan, 3.0], [np.nan, np.nan, np.nan]])
    np.testing.assert_array_equal(over_nodes(np.nanmedian, values), [2.0, np.nan])
    np.testing.assert_array_equal(over_nodes(np.nanmax, values[:, :, None]), [[3.0], [np.nan]])


# what single runs keep
def test_a_lyapunov_certificate_proves_its_gamma_for_single_runs() -> None:
    account = Account.of(GOLDEN_RUN)
    gamma = account.log.gains.certificate.gamma
    energy, chance = (account.log.w**2).sum(), account.verdict.chance
    assert chance is not None
    assert chance == Chance(gamma, pytest.approx(energy, rel=1e-12))
    assert chance.level(0.96) == pytest.approx(5.0 * gamma * np.sqrt(energy), rel=1e-8)  # rounded up
    said = re.search(r"\|z~\| stays below (\S+) at every step with probability 95% at least", account.verdict.text())
    assert said is not None
    assert chance.level() <= float(said[1]) == pytest.approx(chance.level(), rel=1e-3)


@pytest.fixture(scope="module")
def exact() -> Gains:
    return design(find("two-nodes"), method="exact")


def test_of_an_exact_certificate_it_is_the_least_gamma_that_its_matrix_proves(exact: Gains) -> None:
    """It is not below the exact gain, which says nothing of single runs; of a thousandth less (18) is not proved."""
    known = single_run(exact)
    assert known is not None
    gamma, P, _ = known
    prover = Prover(exact.problem, exact.K, exact.H, P=P)
    assert exact.certificate.exact is not None
    assert gamma >= exact.certificate.exact[0]
    assert prover.theorem1(gamma).holds
    less = prover.theorem1(0.999 * gamma)
    assert less.failure is not None
    assert "(18) fails" in less.failure


def test_it_is_far_below_what_the_matrix_that_ends_the_recursion_proves() -> None:
    """That of energies is of use: the other one would let the errors of single runs be many times as large."""
    gains = design(find("zhu2020-lossy"))
    known = single_run(gains)
    assert known is not None
    ends_it = least_of_P(gains.problem, prover_of(gains))
    assert ends_it is not None
    assert known.gamma < 0.2 * ends_it.gamma


def test_without_a_matrix_nothing_is_said_of_single_runs(tmp_path: Path, exact: Gains) -> None:
    P = prover_of(exact).P
    assert P is not None
    turned = exact.certificate.model_copy(update={"form": "full", "P": {"linked": -P[0]}})
    assert single_run(exact.model_copy(update={"certificate": turned})) is None
    assert account_of(tmp_path).verdict.chance is None


def test_the_rung_of_the_lmi_is_there_where_the_weights_of_the_gains_prove_it(tmp_path: Path) -> None:
    """And not where they prove less than is claimed."""
    golden = Gains.load(GOLDEN / "zhu2020-lossy.gains.json")
    found = undercut(golden.problem)
    assert found.gamma is not None
    for number, (claimed, there) in enumerate([(found.gamma, True), (found.gamma * (1.0 + 1e-6), False)]):
        claim = golden.certificate.model_copy(update={"lmi_least": claimed, "lmi_weights": found.weights})
        gains = golden.model_copy(update={"certificate": claim})
        path = record(tmp_path / f"run-{number}.mcap", gains, simulate(gains, steps=10), steps=10)
        rungs = dict(Account.of(path).rungs)
        assert rungs.get("proved: no gains have less by Theorem 2") == (claimed if there else None)
