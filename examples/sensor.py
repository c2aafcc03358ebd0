"""Feeds one node of a network from a function, as a driver would from a device: python sensor.py."""

import math
import tempfile
from pathlib import Path

import peakmesh


def read(step):
    """What the sensor of node "left" measures at this step."""
    return [0.1 * math.sin(0.2 * step)]


gains = peakmesh.design("two-nodes", method="decomposed")
with (
    tempfile.TemporaryDirectory() as folder,
    peakmesh.Mesh(gains, Path(folder) / "run.mcap", sensors={"left": read}, steps=50) as mesh,
):
    print(f"run {mesh.run} at {mesh.address}")
    print(mesh.verdict().text())
    print("y of left:", peakmesh.load(mesh.recording).y[:3, 0])
