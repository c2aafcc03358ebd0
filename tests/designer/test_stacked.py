"""Gains as one matrix for each mode: out, in again, and what does not fit."""

from __future__ import annotations

import io
import json
from collections.abc import Callable
from contextlib import redirect_stdout
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from networks import random_gains, random_problem
from places import ROOT
from scipy.io import savemat

from agent.contract.errors import InputError
from agent.contract.gains import Gains
from designer.analysis import load_given
from designer.cli import main
from designer.model.error_model import link_gains
from designer.problems import find
from designer.stacked import stacked

GOLDEN = ROOT / "recordings" / "golden" / "zhu2020-lossy.gains.json"
GAINS = Gains.load(GOLDEN)
K, H = stacked(GAINS.problem, GAINS.K, GAINS.H)


@cache
def ladder_of(gains: Path) -> dict[str, Any]:
    """What `analyse` says of these gains on the problem of the golden ones."""
    out = io.StringIO()
    with redirect_stdout(out):
        assert main(["analyse", "zhu2020-lossy", "--gains", str(gains), "--json"]) == 0
    return dict(json.loads(out.getvalue())["ladder"])


@pytest.mark.parametrize("kind", ["npz", "mat"])
def test_what_is_exported_is_read_bit_for_bit(kind: str, tmp_path: Path) -> None:
    output = tmp_path / f"gains.{kind}"
    assert main(["export", str(GOLDEN), f"--{kind}", "-o", str(output)]) == 0
    given = load_given(output, GAINS.problem)
    for letter in ("K", "H"):
        for mode, rows in getattr(GAINS, letter).items():
            for receiver, row in rows.items():
                for sender, gain in row.items():
                    assert (getattr(given, letter)[mode][receiver][sender] == gain).all()
    assert main(["export", str(GOLDEN), f"--{kind}", "-o", str(output)]) == 2
    assert ladder_of(output) == ladder_of(GOLDEN)


def test_a_block_stands_where_8_has_it() -> None:
    """Times the weights it is the matrix of (8), for nodes of different measurement counts."""
    problem = random_problem(3)
    made = random_gains(problem, 1)
    weights = np.array([topology.adjacency for topology in problem.topologies])
    sizes = [len(node.C) for node in problem.nodes]
    ours = stacked(problem, *link_gains(problem, *made))
    by_states = weights.repeat(problem.nx, axis=1)
    assert len(set(sizes)) > 1
    assert ours[0] * by_states.repeat(problem.nx, axis=2) == pytest.approx(made[0], rel=1e-15)
    assert ours[1] * by_states.repeat(sizes, axis=2) == pytest.approx(made[1], rel=1e-15)


def written(path: Path, K: Any, H: Any) -> Path:
    match path.suffix:
        case ".npz":
            np.savez(path, K=K, H=H)
        case ".mat":
            savemat(path, {"K": K, "H": H})
        case _:
            path.write_text(json.dumps({"K": K, "H": H}))
    return path


def cells(matrices: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    made = np.empty((len(matrices), 1), dtype=object)
    made[:, 0] = list(matrices)
    return made


@pytest.mark.parametrize(
    ("name", "form"),
    [
        ("g.npz", lambda matrices: matrices),
        ("g.mat", lambda matrices: np.moveaxis(matrices, 0, -1)),
        ("g.mat", cells),
        ("g.json", lambda matrices: matrices.tolist()),
        ("g.json", lambda matrices: dict(zip(GAINS.problem.mode_names, matrices.tolist(), strict=True))),
    ],
)
def test_every_form_is_the_same(name: str, form: Callable[[Any], Any], tmp_path: Path) -> None:
    given = load_given(written(tmp_path / name, form(K), form(H)), GAINS.problem)
    assert (given.K["3"]["2"]["1"] == GAINS.K["3"]["2"]["1"]).all()
    assert (given.H["4"]["1"]["2"] == GAINS.H["4"]["1"]["2"]).all()


def test_one_mode_needs_no_third_dimension(tmp_path: Path) -> None:
    """MATLAB has none."""
    problem = find("two-nodes")
    given = load_given(written(tmp_path / "g.mat", [[1.0, 2.0], [3.0, 4.0]], [[5.0, 6.0], [7.0, 8.0]]), problem)
    assert given.K["linked"]["left"]["right"].tolist() == [[2.0]]
    assert given.H["linked"]["right"]["left"].tolist() == [[7.0]]


def changed(matrices: np.ndarray[Any, Any], value: float, *at: int) -> np.ndarray[Any, Any]:
    copy = matrices.copy()
    copy[at] = value
    return copy


@pytest.mark.parametrize(
    ("K", "H", "said"),
    [
        (K[:2], H, "K has 2 modes; the problem has 4 modes"),
        (K[:, :6], H, 'K: mode "1" is 6 x 8; it must be 8 x 8, a block for every two nodes in their order'),
        (K, H[:, :, :3], 'H: mode "1" is 8 x 3; it must be 8 x 4'),
        (changed(K, 1.0, 0, 0, 2), H, 'K: mode "1": "1" does not hear "2" in it, so that block must be 0'),
        (changed(K, np.nan, 1, 0, 0), H, 'K: mode "2" is no matrix of finite, real numbers'),
        (K + 0j, H, 'K: mode "1" is no matrix of finite, real numbers'),
    ],
)
def test_what_does_not_fit_is_said(K: Any, H: Any, said: str, tmp_path: Path) -> None:
    with pytest.raises(InputError) as caught:
        load_given(written(tmp_path / "g.npz", K, H), GAINS.problem)
    assert str(caught.value).startswith(f"{tmp_path / 'g.npz'} does not fit zhu2020-lossy: {said}")


@pytest.mark.parametrize("suffix", ["npz", "mat"])
def test_what_is_no_such_file_is_said(suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"g.{suffix}"
    with pytest.raises(InputError, match="does not exist"):
        load_given(path, GAINS.problem)
    for data in (b"", b"nothing of the kind", b"MATLAB 7.3 MAT-file" + bytes(200), b"PK\x03\x04" + bytes(50)):
        path.write_bytes(data)
        with pytest.raises(InputError) as caught:
            load_given(path, GAINS.problem)
        assert str(caught.value).startswith(str(path))
    path = written(tmp_path / f"k.{suffix}", K, H) if suffix == "npz" else path
    if suffix == "npz":
        np.savez(path, K=K)
        with pytest.raises(InputError, match="has no H; it needs both"):
            load_given(path, GAINS.problem)


def test_a_recording_goes_into_no_matrices_of_gains(capsys: pytest.CaptureFixture[str]) -> None:
    """Nor do two gains files, or what is said of recordings."""
    recording = str(GOLDEN.with_name("zhu2020-lossy.mcap"))
    for words, said in (
        ((recording, "--npz"), "is not a gains file"),
        ((str(GOLDEN), str(GOLDEN), "--mat"), "--mat takes one gains file, not 2"),
        ((str(GOLDEN), "--npz", "--run", "r"), "--run says something of a recording"),
    ):
        assert main(["export", *words]) == 2
        assert said in capsys.readouterr().err
