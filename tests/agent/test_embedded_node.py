"""The node in C of examples/embedded: what it says on the wire and, where zenoh-pico is installed, runs with it."""

from __future__ import annotations

import hashlib
import math
import os
import random
import re
import shlex
import shutil
import signal
import struct
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from here import here
from made_recordings import observer_gains, real_problem
from places import ROOT
from runs import child, numbers_of, roles_left, run_here

from agent.contract.errors import RunBroken
from agent.contract.gains import Gains
from agent.contract.messages import Measurement
from agent.contract.schedule import DELIVERIES, Stream
from agent.embed import export
from agent.guests import Guests, guests
from designer.replay import replay

SOURCES = ROOT / "examples" / "embedded"
README = (SOURCES / "README.md").read_text()
STRICT = ["-std=c99", "-Wall", "-Wextra", "-Wconversion", "-pedantic", "-Werror", "-O2"]
DRIVER = r"""
#include "wire.h"
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
int main(void)
{
    char line[4096], text[WIRE_NUMBER], *rest;
    unsigned long long v[5];
    while (fgets(line, sizeof line, stdin)) {
        line[strcspn(line, "\n")] = 0;
        if (*line == 'n') {
            size_t length = wire_number(text, strtod(line + 2, NULL));
            printf("%s %d\n", text, length == strlen(text) && length < WIRE_NUMBER);
        } else if (*line == 'd') {
            uint8_t digest[64];
            size_t size = strtoul(line + 2, &rest, 10), i;
            wire_digest(digest, size, rest + 1, strlen(rest + 1));
            for (i = 0; i < size; i++)
                printf("%02x", digest[i]);
            puts("");
        } else {
            sscanf(line + 2, "%llu %llu %llu %llu %llu", v, v + 1, v + 2, v + 3, v + 4);
            printf("%a\n", wire_draw(v[0], v[1], v[2], (unsigned)v[3], (unsigned)v[4]));
        }
    }
    return 0;
}
"""


class Network(NamedTuple):
    """Where the gains are, and the nodes in C."""

    gains: Path
    nodes: Guests


def compiler() -> str:
    found = shutil.which("gcc") or shutil.which("cc") or shutil.which("clang")
    if found is None:
        pytest.skip("gcc, cc or clang is not installed")
    return found


@pytest.fixture(scope="module")
def wire(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A program that answers a line for a line."""
    folder = tmp_path_factory.mktemp("wire")
    (folder / "driver.c").write_text(DRIVER)
    words = [compiler(), *STRICT, f"-I{SOURCES}", "-o", folder / "wire", folder / "driver.c", SOURCES / "wire.c"]
    made = subprocess.run([*map(str, words)], capture_output=True, text=True, timeout=300, check=False)
    assert (made.returncode, made.stderr) == (0, "")
    return folder / "wire"


def answers(wire: Path, questions: list[str]) -> list[str]:
    done = subprocess.run([wire], input="\n".join(questions), capture_output=True, text=True, timeout=300, check=True)
    return done.stdout.splitlines()


def doubles() -> Iterator[float]:
    """Of every kind: powers of two and ten, subnormal ones, short decimals, any bits."""
    draw = random.Random(1)
    yield from (0.0, -0.0, -1.0, 9007199254740993.0, 123456789012345680.0, 5e-324, 1.7976931348623157e308)
    yield from (sign * 2.0**k for sign in (1, -1) for k in range(-1074, 1024))
    yield from (1.5 * 10.0**k for k in range(-300, 300))
    for _ in range(4000):
        yield round(draw.uniform(-1000, 1000), draw.randint(0, 6))
        yield draw.gauss() * 10.0 ** draw.randint(-20, 20)
        (any_bits,) = struct.unpack("<d", draw.randbytes(8))
        if math.isfinite(any_bits):
            yield any_bits


def test_numbers_are_those_of_the_other_nodes(wire: Path) -> None:
    """The same characters."""
    values = list(doubles())
    expected = [Measurement(step=0, y=[value]).encode().decode()[15:-2] for value in values]
    assert answers(wire, [f"n {value!r}" for value in values]) == [f"{text} 1" for text in expected]


def test_digests_are_those_of_the_other_nodes(wire: Path) -> None:
    """BLAKE2b, of texts around the length of its blocks."""
    asked = [(size, "x" * length) for size in (8, 16, 64) for length in (0, 1, 127, 128, 129, 256, 300)]
    expected = [hashlib.blake2b(text.encode(), digest_size=size).hexdigest() for size, text in asked]
    assert answers(wire, [f"d {size} {text}" for size, text in asked]) == expected


def test_draws_are_those_of_everybody(wire: Path) -> None:
    """The losses of the model, of few links and of many."""
    questions, expected = [], []
    for seed in (0, 7, 2**63 - 1):
        for width in (1, 3, 4, 5, 12):
            stream = Stream(seed=seed, stream=DELIVERIES, width=width)
            for step in (0, 1, 255, 256, 3000):
                questions += [f"r {seed} {DELIVERIES} {step} {width} {place}" for place in range(width)]
                expected += stream.at(step).tolist()
    assert [float.fromhex(text) for text in answers(wire, questions)] == expected


@pytest.fixture(scope="module")
def zenoh_pico() -> list[str]:
    """What the compiler is told of it; its headers are not ours to be strict with."""
    asked = [shutil.which("pkg-config") or "false", "--cflags", "--libs", "zenohpico"]
    found = subprocess.run(asked, capture_output=True, text=True, timeout=60, check=False)
    if found.returncode:
        pytest.skip("zenoh-pico is not installed: pkg-config does not know zenohpico")
    words = found.stdout.split()
    return [f"-isystem{word[2:]}" if word.startswith("-I") else word for word in words]


def built(gains: Gains, node: str, folder: Path, zenoh_pico: list[str]) -> str:
    """The program of a node, by the command of the README, and strictly."""
    name = export(gains, node, folder)["name"]
    (command,) = re.findall(r"^cc (.*?) \$\(", README.replace("\\\n", ""), flags=re.MULTILINE)
    words = [str(SOURCES / word) if word.endswith(".c") and "/" not in word else word for word in shlex.split(command)]
    words = [word.replace("node_2", name).replace("node2", str(folder)) for word in words]
    made = subprocess.run(
        [compiler(), "-Wall", "-Wextra", "-Wconversion", "-Werror", f"-I{SOURCES}", *words, *zenoh_pico, "-lpthread"],
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert (made.returncode, made.stderr) == (0, "")
    return str(folder / "node")


@pytest.fixture(scope="module")
def network(tmp_path_factory: pytest.TempPathFactory, zenoh_pico: list[str]) -> Network:
    """Seen losses, lossy links, unbiased gains and an unstable plant; every node is one in C."""
    folder, gains = tmp_path_factory.mktemp("network"), observer_gains(real_problem(5, radius=1.02, ny=(1, 2, 1)))
    gains.save(folder / "gains.json")
    commands = {name: built(gains, name, folder / name, zenoh_pico) for name in gains.problem.node_names}
    return Network(folder / "gains.json", guests(gains, nodes=commands, sensors={}, plant=None))


def test_a_run_of_nodes_in_c_is_that_of_our_own(network: Network, tmp_path: Path) -> None:
    """The same payloads, to the last byte; nothing is refused, and nobody ends badly."""
    words: list[dict[str, Any]] = []
    plan: dict[str, Any] = {"steps": 200, "seed": 3}
    summary = run_here(network.gains, tmp_path / "c.mcap", guests=network.nodes, heed=words.append, **plan)
    assert (summary["missing"], summary.get("refused"), [word for word in words if "warning" in word]) == (0, None, [])
    run_here(network.gains, tmp_path / "ours.mcap", **plan)
    assert numbers_of(tmp_path / "c.mcap") == numbers_of(tmp_path / "ours.mcap")
    assert replay(tmp_path / "c.mcap").exit_code == 0


@pytest.mark.parametrize(
    ("number", "end"),
    [(signal.SIGTERM, "it said: asked to end; .*, ended with code 143"), (signal.SIGKILL, ".*, died of SIGKILL")],
)
def test_a_node_in_c_that_is_asked_to_end(network: Network, tmp_path: Path, number: int, end: str) -> None:
    """It says why; one that is killed is lost like any other."""
    ours = {"node-n0": network.nodes["node-n0"]}
    recording = tmp_path / "run.mcap"

    def stop() -> None:
        os.kill(child(os.getpid(), *ours["node-n0"]), number)

    with pytest.raises(RunBroken, match=rf'^node "n0" was lost: .*{end}'):
        run_here(network.gains, recording, at=10, do=stop, guests=ours)
    assert roles_left() == {}
    assert "agrees for what is there" in replay(recording).text()


def test_a_node_in_c_conforms(network: Network) -> None:
    """To all that is asked of a node in lock-step, the recorder's questions among it."""
    ((command,),) = [words for who, words in network.nodes.items() if who == "node-n1"]
    only = [word for trial in ("whole", "later", "twice", "stop", "signal", "lost") for word in ("--only", trial)]
    done = here("conform", "--gains", network.gains, "--node", "n1", *only, "--", command)
    assert (done.returncode, done.stdout.splitlines()[-1]) == (0, "6 of 6 trials passed"), done.stdout
