"""What a node tells of a step, as the message that it sends. Pure."""

from __future__ import annotations

from collections.abc import Iterable

from pydantic import ValidationError

from agent.contract.errors import RunBroken
from agent.contract.gains import NodeGains
from agent.contract.messages import CEILING, Estimate, beyond_ceiling
from agent.filter import Pair
from agent.product import product


def told(
    own: NodeGains,
    k: int,
    pair: Pair,
    *,
    mode: str = "",
    heard: Iterable[str] = (),
    measured: bool = True,
    origin: str = "",
) -> Estimate:
    """The estimate of step k. Raises RunBroken where it is not finite, or so large that nobody would take it."""
    try:
        estimate = Estimate(
            step=k,
            x_hat=pair.x_hat.tolist(),
            innovation=pair.innovation.tolist(),
            z_hat=product(own.M, pair.x_hat).tolist(),
            mode=mode,
            heard=list(heard),
            measured=measured,
            origin=origin,
        )
    except ValidationError:  # a message refuses NaN and infinity
        estimate = None
    if estimate is None or beyond_ceiling(estimate.x_hat, estimate.innovation, estimate.z_hat):
        raise RunBroken(f'the estimate of node "{own.node}" is beyond {CEILING:g} at step {k}; its gains let it grow')
    return estimate
