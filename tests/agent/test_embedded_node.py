"""The node in C of examples/embedded: what it says on the wire and, where zenoh-pico is installed, runs with it."""

from __future__ import annotations

import hashlib
import math
import random
import shutil
import struct
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest
from places import ROOT

from agent.contract.messages import Measurement
from agent.contract.schedule import DELIVERIES, Stream

SOURCES = ROOT / "examples" / "embedded"
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
