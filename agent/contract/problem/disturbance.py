"""The kinds of disturbance w(k) that a simulated plant knows: [disturbance] of a problem. Real plants ignore it."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from agent.contract.arrays import Matrix, Model, Number


class DampedSine(Model):
    """w(k) = amplitude exp(-decay k) sin(frequency k), alike in every component."""

    kind: Literal["damped-sine"]
    amplitude: Number = 1.0
    decay: Number = Field(ge=0.0)
    frequency: Number = 1.0


class Impulse(Model):
    """w(k) = amplitude at step `at`, in every component, else 0."""

    kind: Literal["impulse"]
    amplitude: Number = 1.0
    at: int = Field(default=0, ge=0, strict=True)


class White(Model):
    """w(k) independent, zero-mean, Gaussian with the given standard deviation, in every component."""

    kind: Literal["white"]
    deviation: Number = Field(gt=0.0)


class Samples(Model):
    """w(k) is row k of a CSV file (one column for each component, no header), and 0 after its last row."""

    kind: Literal["csv"]
    file: str
    values: Matrix


class WorstCase(Model):
    """w(k) is `amplitude` times the sequence of energy 1 that is worst for the gains; their file has it."""

    kind: Literal["worst-case"]
    amplitude: Number = 1.0


class Quiet(Model):
    """w(k) = 0."""

    kind: Literal["none"] = "none"


Disturbance = Annotated[DampedSine | Impulse | White | Samples | WorstCase | Quiet, Field(discriminator="kind")]
