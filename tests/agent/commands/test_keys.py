"""Certificates are made whole or not at all, kept from others, renewed, and shown with what is wrong with them."""

from __future__ import annotations

import json
import shutil
import stat
from collections.abc import Callable
from datetime import timedelta
from pathlib import Path

import pytest
from here import here

from agent import authority
from agent.authority import Authority
from agent.contract.errors import InputError
from agent.network.credentials import Credentials

PROBLEM = "two-nodes"  # built in
WHOS = ["coordinator", "plant", "recorder", "node-left", "node-right", "sensor-left", "viewer"]


def init(folder: Path) -> Path:
    done = here("keys", "init", "--problem", PROBLEM, "-o", folder, "--external", "left")
    assert done.returncode == 0, done.stderr
    return folder


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Not to be changed."""
    return init(tmp_path_factory.mktemp("made") / "keys")


@pytest.fixture
def keys(made: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(made, tmp_path / "keys"))


def test_everybody_gets_a_certificate_and_a_private_key(made: Path) -> None:
    """And the sensors that were asked for; each pair is good for its owner, and private keys are private."""
    files = {f"{who}.{kind}" for who in ["ca", *WHOS] for kind in ("pem", "key")} | {"sensor-left.json5"}
    assert {path.name for path in made.iterdir()} == files
    private = {path.name for path in made.iterdir() if stat.S_IMODE(path.stat().st_mode) == 0o600}
    assert private == {name for name in files if not name.endswith(".pem")}
    assert stat.S_IMODE(made.stat().st_mode) == 0o700
    for who in WHOS:
        Credentials(made, who).check(PROBLEM)


def test_nothing_is_overwritten_or_half_written(keys: Path, tmp_path: Path) -> None:
    """Exit 2, one sentence, and the folder as before; where a name is too long for a certificate, no folder at all."""
    before = {path.name: path.read_bytes() for path in keys.iterdir()}
    for words, sentence in (
        (["-o", keys], f"{keys} exists already; give another name, or let peakmesh keys renew make new ones in it"),
        (["-o", tmp_path / "no" / "keys"], f"the folder {tmp_path / 'no'} does not exist; create it first"),
        (
            ["-o", tmp_path / "new", "--external", "middle"],
            'node "middle" does not exist; the problem has nodes "left" and',
        ),
    ):
        done = here("keys", "init", "--problem", PROBLEM, *words)
        assert (done.returncode, done.stdout) == (2, "")
        assert done.stderr.startswith(f"peakmesh: {sentence}")
    with pytest.raises(InputError, match="is too long for a certificate, in which a name has at most 64 letters"):
        Authority.load(keys).issue(["node-" + 60 * "x"], days=1)
    assert {path.name: path.read_bytes() for path in keys.iterdir()} == before
    assert [path.name for path in tmp_path.iterdir()] == ["keys"]


def test_renewed_keys_are_new_and_good(keys: Path) -> None:
    """Those that are named, among them a sensor's first, or all; the authority stays, so old and new go together."""
    before = {path.name: path.read_bytes() for path in keys.iterdir()}

    def changed() -> set[str]:
        return {path.name for path in keys.iterdir() if before.get(path.name) != path.read_bytes()}

    done = here("keys", "renew", keys, "node-left", "sensor-right", "--days", 10, "--json")
    assert [found["who"] for found in json.loads(done.stdout)["certificates"]] == ["node-left", "sensor-right"]
    renewed = {f"{who}.{kind}" for who in ("node-left", "sensor-right") for kind in ("pem", "key")}
    assert changed() == renewed | {"sensor-right.json5"}
    assert here("keys", "renew", keys).returncode == 0
    assert changed() == {path.name for path in keys.iterdir()} - {"ca.pem", "ca.key"}
    for who in [*WHOS, "sensor-right"]:
        Credentials(keys, who).check(PROBLEM)


def test_who_is_not_there_is_not_renewed(keys: Path) -> None:
    done = here("keys", "renew", keys, "node-middle")
    assert done.returncode == 2
    assert done.stderr.startswith(f'peakmesh: {keys} has nothing of "node-middle"; there are "coordinator", ')
    (keys / "ca.key").unlink()
    done = here("keys", "renew", keys)
    assert (done.returncode, done.stderr) == (
        2, f"peakmesh: {keys / 'ca.key'} does not exist; a private key of the authority was expected there\n"
    )  # fmt: skip


def test_what_is_wrong_is_shown(keys: Path, tmp_path: Path) -> None:
    """Exit 1: expired, in another name, by another authority. Private keys need not be there."""
    assert here("keys", "show", keys).returncode == 0
    Authority.load(keys).issue(["plant"], days=-0.5)  # type: ignore[arg-type]
    shutil.copy(keys / "node-left.pem", keys / "node-right.pem")
    shutil.copy(init(tmp_path / "other") / "viewer.pem", keys)
    for path in keys.glob("*.key"):
        path.unlink()
    done = here("keys", "show", keys, "--json")
    faults = {found["who"]: found["faults"] for found in json.loads(done.stdout)["certificates"] if found["faults"]}
    assert done.returncode == 1
    assert faults == {"plant": ["expired"], "node-right": ['in the name of "node-left"'], "viewer": ["not by ca.pem"]}
    assert "until" in here("keys", "show", keys).stdout


def test_two_authorities_may_be_trusted(keys: Path, tmp_path: Path) -> None:
    """While one takes the place of the other: both kinds of certificates are good where ca.pem has both authorities."""
    other = init(tmp_path / "other")
    both = (keys / "ca.pem").read_bytes() + (other / "ca.pem").read_bytes()
    for folder in (keys, other):
        (folder / "ca.pem").write_bytes(both)
        Credentials(folder, "plant").check(PROBLEM)


def swap(keys: Path) -> None:
    for kind in ("pem", "key"):
        shutil.copy(keys / f"node-left.{kind}", keys / f"plant.{kind}")


def from_elsewhere(*names: str) -> Callable[[Path], object]:
    def copy(keys: Path) -> None:
        other = init(keys.parent / "other")
        for name in names:
            shutil.copy(other / name, keys)

    return copy


def reissue(days: float, *, ago: float = 1.0) -> Callable[[Path], object]:
    def issue(keys: Path) -> None:
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(authority, "EARLIER", timedelta(days=ago))
            Authority.load(keys).issue(["plant"], days=days)  # type: ignore[arg-type]

    return issue


def expired_authority(keys: Path) -> None:
    Authority.create(keys, PROBLEM, days=-0.5).issue(["plant"], days=1)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("spoil", "sentence"),
    [
        (swap, '{keys}/plant.pem is the certificate of "node-left", not of the plant'),
        (from_elsewhere("ca.pem"), "{keys}/plant.pem was not issued by the authority of {keys}/ca.pem"),
        (from_elsewhere("plant.key"), "{keys}/plant.key is not the private key of {keys}/plant.pem"),
        (reissue(-0.5), "{keys}/plant.pem is valid from "),
        (reissue(3, ago=-2.0), "{keys}/plant.pem is valid from "),
        (expired_authority, "{keys}/ca.pem: certificate has expired"),
        (
            lambda keys: (keys / "plant.key").unlink(),
            "--keys {keys}: there is no plant.key in it, which the plant needs; ",
        ),
        (lambda keys: (keys / "ca.pem").write_text("hello"), "{keys}/ca.pem is not a certificate in PEM format"),
        (lambda keys: (keys / "plant.pem").write_bytes(b"\xff"), "{keys}/plant.pem and {keys}/plant.key are not a "),
        (lambda keys: (keys / "plant.key").write_text(""), "{keys}/plant.pem and {keys}/plant.key are not a "),
        (shutil.rmtree, "--keys {keys}: there is no ca.pem in it, which the plant needs; peakmesh keys init makes it"),
    ],
)
def test_keys_that_do_not_fit_are_refused_at_the_start(
    keys: Path, spoil: Callable[[Path], object], sentence: str
) -> None:
    spoil(keys)
    with pytest.raises(InputError) as caught:
        Credentials(keys, "plant").check(PROBLEM)
    assert str(caught.value).startswith(sentence.format(keys=keys))


def test_keys_of_another_problem_are_refused(made: Path) -> None:
    with pytest.raises(InputError) as caught:
        Credentials(made, "plant").check("zhu2020-lossy")
    assert str(caught.value) == (
        f'the keys in {made} were made for problem "two-nodes", not for "zhu2020-lossy"; '
        "peakmesh keys init makes others"
    )
