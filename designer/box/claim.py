"""What a gains file says of the box that its problem has: put into it by a design, and proved again."""

from __future__ import annotations

import math
from collections.abc import Sequence

from agent.contract.errors import InputError
from agent.contract.gains import BoxClaim, Gains
from agent.contract.problem import Problem
from designer.box.extent import Box, asked, box_in, truth_at
from designer.box.robust import Robust, proved_at, robust
from designer.box.weights import Recipe, Round
from designer.box.worst import Worst, gain_of
from designer.proof.findings import Verdict


def with_claim(gains: Gains, found: Robust) -> Gains:
    """The same gains, with what was found of them in the box that their problem has."""
    claim = BoxClaim(
        gamma=found.gamma,
        why_not=None if found.gamma is not None else found.why_not,
        found=found.found if math.isfinite(found.found) else None,
        ends=found.worst.ends,
        rows=found.worst.rows,
        signs=found.worst.signs,
        start=found.recipe.start,
        rounds=found.recipe.rounds,
    )
    return gains.model_copy(update={"certificate": gains.certificate.model_copy(update={"box": claim})})


def again(gains: Gains, *, balls: bool = False) -> Robust | None:
    """The claim of the file proved again, of the numbers and for the gamma that stand in it; None: it makes none.

    By the weights whose recipe stands in the file, or where these prove nothing by those that a search finds here.
    Raises InputError where it cannot be about the problem in the file.
    """
    claim = gains.certificate.box
    if claim is None or claim.gamma is None:
        return None
    box = box_in(gains.problem)
    if box is None:
        raise InputError("certificate: box: the problem has no tolerances, so there is nothing to claim of its box")
    truth = truth_at(gains.problem, box, *_fitting(claim, box))
    gain = gain_of(gains.problem, gains.K, gains.H, box, truth)
    worst = Worst(truth, gain, claim.ends, claim.rows, claim.signs)
    recipe = Recipe(claim.start, tuple(Round(*each) for each in claim.rounds))
    verdict = proved_at(gains.problem, gains.K, gains.H, box, worst, claim.gamma, recipe, balls=balls)
    said = Robust(box, worst, verdict, recipe)
    if said.gamma is not None or not gain <= claim.gamma:
        return said
    own = robust(gains.problem, gains.K, gains.H, box, balls=balls)
    if own.gamma is None or own.gamma > claim.gamma:
        return said
    return own._replace(verdict=own.verdict and own.verdict._replace(gamma=claim.gamma))


def with_box(
    verdict: Verdict, gains: Gains, problem: Problem, within: Sequence[str] = (), *, balls: bool = False
) -> tuple[Verdict, Robust | None]:
    """What was proved of the gains, and what is of the box asked for, or else of that of the problem.

    The claim that the file makes of its own box has to be true, or nothing holds. Raises InputError as `again` does,
    and for what is no box.
    """
    if not verdict.holds:
        return verdict, None
    claimed = again(gains, balls=balls)
    if claimed is not None and claimed.gamma is None:
        why = f"as it claims for every model of its box: {claimed.why_not}"
        return verdict._replace(holds=False, gamma=gains.certificate.box_gamma or 0.0, failure=why), None
    if claimed is not None and not within and gains.problem == problem:
        return verdict, claimed
    box = asked(problem, within)
    return verdict, None if box is None else robust(gains.problem, gains.K, gains.H, box, balls=balls)


def _fitting(claim: BoxClaim, box: Box) -> tuple[tuple[bool, ...], tuple[int, ...], tuple[int, ...]]:
    lengths = [("ends", claim.ends, len(box.intervals)), ("rows", claim.rows, len(box.rows))]
    for name, found, length in [*lengths, ("signs", claim.signs, len(box.entries))]:
        if len(found) != length:
            raise InputError(f"certificate: box: {name} has {len(found)} entries; the box has {length} of the kind")
    if any(not 0 <= k < len(rows) for k, rows in zip(claim.rows, box.rows, strict=True)):
        raise InputError("certificate: box: rows names a corner that a row of the transition matrix does not have")
    if any(sign not in (-1, 0, 1) for sign in claim.signs):
        raise InputError("certificate: box: signs are -1, 0 or 1")
    return claim.ends, claim.rows, claim.signs
