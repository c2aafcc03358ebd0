"""The tables of a report have every number that is drawn, to the last bit."""

from __future__ import annotations

import csv
import io
from pathlib import Path

import numpy as np
from made_recordings import random_gains, random_problem, record, simulate
from reports import account_of, recorded_network

from designer.report import tables
from designer.report.account import Account
from designer.report.pictures import pictures


def read(text: str) -> list[dict[str, str]]:
    return list(csv.DictReader(io.StringIO(text)))


def table(account: Account, key: str) -> list[dict[str, str]]:
    (chart,) = (chart for chart in pictures(account) if chart.key == key)
    return read(tables.of_chart(chart))


def test_floats_come_back_bit_for_bit(tmp_path: Path) -> None:
    account = account_of(tmp_path)
    rows = table(account, "outputs")
    assert [int(row["step"]) for row in rows] == list(range(50))
    assert [float(row["z of the plant"]) for row in rows] == account.log.z[:, 0].tolist()
    assert [float(row["ẑ of node n3"]) for row in rows] == account.log.z_hat[:, 3].tolist()
    names = account.log.gains.problem.mode_names
    assert [row["topology"] for row in table(account, "modes")] == [names[s] for s in account.log.mode]
    tolerances = {float(row["tolerance"]) for row in table(account, "gaps")}
    assert tolerances == {account.verdict.tolerance}


def test_of_many_nodes_the_map_has_them_all(tmp_path: Path) -> None:
    account = account_of(tmp_path, ny=(1,) * 9)
    rows = table(account, "error-map")
    for i in range(9):
        assert [float(row[f"node n{i}"]) for row in rows] == account.sizes[:, i].tolist()
    band = table(account, "errors")
    assert [float(row["all 9 nodes, highest"]) for row in band] == account.sizes.max(axis=1).tolist()


def test_what_is_not_known_is_empty(tmp_path: Path) -> None:
    gains = random_gains(random_problem(3))
    sent = [
        message for message in simulate(gains, steps=10) if message.topic != "mode" or message.document["step"] != 4
    ]
    account = Account.of(record(tmp_path / "run.mcap", gains, sent, steps=10))
    assert [row["step"] for row in table(account, "modes") if row["topology"] == ""] == ["4"]


def test_losses_and_links(tmp_path: Path) -> None:
    account = Account.of(recorded_network(tmp_path))
    rows = table(account, "losses")
    lost = np.array([[float(row[f"node n{i}, measurement lost"]) for i in range(3)] for row in rows])
    np.testing.assert_array_equal(lost, account.lost)
    problem = account.log.gains.problem
    links = read(tables.of_topologies(problem))
    for link in links:
        s, i, j = problem.mode_index(link["mode"]), *map(problem.node_index, (link["receiver"], link["sender"]))
        assert float(link["weight"]) == problem.topologies[s].adjacency[i, j] > 0.0
        assert float(link["delivery_probability"]) == problem.delivery[i, j]
    heard = sum(len(problem.neighbours(s, i)) - 1 for s in range(len(problem.topologies)) for i in range(problem.n))
    assert len(links) == heard
