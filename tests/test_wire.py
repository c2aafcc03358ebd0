"""The files in tests/wire/: our own node hears and says exactly them, and the node in C computes what it says there."""

from __future__ import annotations

import json
import shutil
import subprocess
from pathlib import Path

import pytest
from wire import EXAMPLES, FOLDER, GOLDEN, LEASE, NODE, RUN, STEPS, VERSION, Line, Scripted, file_of, made, read

from agent.contract.gains import Gains
from agent.contract.keys import decode, model_of, node_who
from agent.contract.messages import Stamp, digest_of
from agent.embed import export
from agent.network import barrier
from agent.network.bus import Bus
from agent.network.configuration import Network
from agent.roles import node

STRICT = ["-std=c99", "-Wall", "-Wextra", "-pedantic", "-Werror", "-ffp-contract=off"]


def gains_of(example: str) -> Gains:
    return Gains.load(GOLDEN / f"{example}.gains.json")


def as_of_any_version(lines: list[Line]) -> list[Line]:
    """Joining has the version of whoever says it."""
    return [
        line._replace(payload=json.dumps(json.loads(line.payload) | {"version": VERSION}).encode())
        if line.topic.startswith("joining/")
        else line
        for line in lines
    ]


@pytest.mark.parametrize("example", EXAMPLES)
def test_messages_are_made_as_they_stand_there(example: str) -> None:
    """To the last byte. Where a change is meant: python tests/support/wire.py."""
    assert "".join(f"{line.text()}\n" for line in made(gains_of(example))) == file_of(example).read_text()


@pytest.mark.parametrize("example", EXAMPLES)
def test_every_message_is_what_its_stamp_says(example: str) -> None:
    """And reads as it was written."""
    seen: dict[str, int] = {}
    messages = [line for line in read(file_of(example)) if model_of(line.topic) is not None]
    for line in messages:
        stamp = Stamp.decode(line.attachment)
        assert stamp.digest == digest_of(line.topic, line.payload)
        assert decode(line.topic, line.payload).encode() == line.payload
        assert stamp.number == seen.get(stamp.sender, 0)
        seen[stamp.sender] = stamp.number + 1
        assert (stamp.sender == node_who(NODE)) == line.is_said
    assert len(messages) == 6 * STEPS


@pytest.mark.parametrize("example", EXAMPLES)
def test_our_own_node_says_what_stands_there(example: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The role as it is, to which the file is the network: its tokens, its words, its messages and their stamps."""
    monkeypatch.setattr(barrier, "machine", lambda: "")
    lines = read(file_of(example))
    network = Network("none", ("tcp/127.0.0.1:7447",), lease=LEASE)
    with Bus(network, run=RUN, who=node_who(NODE), session=Scripted.of(lines), signals=lambda handler: {}) as bus:
        node.run(bus, gains_of(example), node=NODE)
    said = bus._session.said
    assert as_of_any_version(said) == as_of_any_version([line for line in lines if line.is_said])


@pytest.fixture(scope="module")
def compiler() -> str:
    found = next((found for name in ("gcc", "cc", "clang") if (found := shutil.which(name))), None)
    if found is None:
        pytest.skip("there is no C compiler")
    return found


def answered(compiler: str, folder: Path, wire: Path) -> tuple[int, list[str]]:
    """What the exported node in `folder` makes of a file: exit code, and what was printed."""
    made = [compiler, *STRICT, f"-I{folder}", "-o", folder / "read", folder / "node_2.c", FOLDER / "node_2.c"]
    subprocess.run(list(map(str, made)), check=True, timeout=300)
    done = subprocess.run([folder / "read", wire], capture_output=True, text=True, timeout=60, check=False)
    return done.returncode, [*done.stdout.splitlines(), *done.stderr.splitlines()]


@pytest.mark.parametrize("example", EXAMPLES)
def test_the_node_in_c_computes_what_stands_there(example: str, compiler: str, tmp_path: Path) -> None:
    """From the same file; x_hat, innovation and z_hat of every step, to the last bit. A changed digit is found."""
    gains = gains_of(example)
    export(gains, NODE, tmp_path)
    numbers = STEPS * (gains.problem.nx + 1 + gains.problem.nz)
    assert answered(compiler, tmp_path, file_of(example)) == (0, [f"{numbers} numbers, 0 differ"])
    lines = read(file_of(example))
    place = max(place for place, line in enumerate(lines) if line.topic == f"node/{NODE}/measurement")
    message = json.loads(lines[place].payload)
    message["y"][0] += 1e-16
    lines[place] = lines[place]._replace(payload=json.dumps(message, separators=(",", ":")).encode())
    (tmp_path / "changed.wire").write_text("".join(f"{line.text()}\n" for line in lines))
    code, said = answered(compiler, tmp_path, tmp_path / "changed.wire")
    assert (code, said[-1]) == (1, f"{numbers} numbers, 1 differ")
    assert said[0].startswith("innovation[0] is ")
