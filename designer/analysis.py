"""What any gains do on a problem: the exact gain, the disturbances that attain it, and the ladder.

The gains may be those of a gains file, which may have been designed for another problem of the same shape, or somebody
else's in a plain JSON file: {"K": {mode: {i: {j: rows}}}, "H": the same}, where i receives from j, and the filter (5)
multiplies K_ij and H_ij by a_ij; or one matrix for each mode (stacked.py).
The problem that they are analysed on is the one that is given, not the file's.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from pydantic import ValidationError

from agent.contract.arrays import Array, Model
from agent.contract.errors import InputError, first_fault
from agent.contract.files import read_bytes, read_json
from agent.contract.frozen import plain
from agent.contract.gains import FORMAT, Gains, LinkMatrices, Solver, check_links
from agent.contract.problem import Problem
from designer import stacked
from designer.beyond_gamma import BeyondGamma, beyond_gamma, told
from designer.box.extent import Box
from designer.box.radius import Radius, radii
from designer.box.robust import Robust, robust
from designer.diagnosis import refuse_nothing_to_estimate
from designer.gain.exact import Gain, exact_gain
from designer.gain.floor import floor
from designer.gain.worst_case import with_worst_case, worst_fixed, worst_policy
from designer.invariants import SLOW
from designer.ladder import Ladder, interval
from designer.lmi import beyond_paper
from designer.model.error_model import ErrorModel, model_of_gains
from designer.proof.prover import Prover
from designer.search.exact_design import certify, confirmed, lower_end, narrowed

_MOST_OF_POLICY = 500, 4e6  # steps of the worst policy where errors decay slowly, and numbers of all Y in them
_MOST_SECONDS = 10.0  # for what no gains are below by an LMI
_SHORT = 1e-3  # a policy that attains less than the exact gain by so much of it is said to
_NEAR_1 = 1e-4  # rates nearer to 1 are told by what is left to it


class GivenGains(NamedTuple):
    """Gains for the links of a problem, and where they come from."""

    K: LinkMatrices
    H: LinkMatrices
    source: str
    file: Gains | None  # the gains file; None for a plain JSON


class _Plain(Model):
    """A file with nothing but gains."""

    K: LinkMatrices
    H: LinkMatrices


class Analysis(NamedTuple):
    """The answer; where the errors are not mean-square stable, there is no gain and no worst disturbance."""

    problem: Problem
    given: GivenGains
    stable: bool | None  # mean-square: proved, proved not to be, or not known
    radius: float  # what E|eta|^2 is multiplied by in each step, in the long run
    horizon: int
    ladder: Ladder
    mode: str | None  # of the worst policy: where it begins
    steps: int  # of the worst policy, from the first w to the peak
    policy_gain: float | None  # what it attains
    u: Array | None  # (nw,): its first w
    fixed: float | None  # the gain to the worst w that is fixed beforehand, from r(0) = initial
    fixed_within: int  # the steps that it was sought over
    w: Array | None  # (at most fixed_within, nw), of energy 1
    unproved: str | None = None  # why no gamma is certified, where the gain is finite
    beyond: BeyondGamma | None = None  # noise, and each node by itself
    robust: Robust | None = None  # what is proved for every model of a box, if one was given
    radii: tuple[Radius, ...] = ()  # how large boxes may be, if that was asked
    digits: int = 9  # of the rate that are known

    @property
    def foreign(self) -> bool:
        """Whether the gains file was made for another problem."""
        return self.given.file is not None and self.given.file.problem_digest != self.problem.digest()

    def document(self) -> dict[str, Any]:
        """For --json."""
        return {
            "problem": self.problem.name,
            "gains": self.given.source,
            "designed_for": None if self.given.file is None else self.given.file.problem.name,
            "same_problem": None if self.given.file is None else not self.foreign,
            "stable": self.stable,
            "radius": self.radius if math.isfinite(self.radius) and self._rate_is_credible else None,
            "exact": self.ladder.exact,
            "unproved": self.unproved,
            "horizon": self.horizon,
            "floor": self.ladder.floor,
            "ladder": self.ladder.document(),
            "worst_policy": None
            if self.u is None
            else {"mode": self.mode, "steps": self.steps, "gain": self.policy_gain, "first_w": self.u.tolist()},
            "worst_fixed": None
            if self.w is None
            else {
                "gain": self.fixed,
                "initial_mode": self.problem.markov.initial,
                "searched_steps": self.fixed_within,
                "w": self.w.tolist(),
            },
            **({"white_noise": None, "node_gains": None} if self.beyond is None else self.beyond.document()),
            "within": None if self.robust is None else self.robust.document(),
            "radii": [radius.document() for radius in self.radii],
        }

    @property
    def _shown(self) -> str:
        """What the lower end needs; where errors decay slowly it is proved by many steps at once, not counted."""
        if self.radius > SLOW:
            return ""
        return f": {_steps(self.horizon)} {'shows' if self.horizon == 1 else 'show'} that it is no less"

    def _short_of(self, low: float) -> str:
        """Where errors decay so slowly that the worst policy takes more steps than are looked at."""
        if self.policy_gain is None or self.policy_gain >= (1.0 - _SHORT) * low:
            return ""
        return f"; its gain is {self.policy_gain:.6g}, and it takes more steps to come to the exact one"

    @property
    def _rate_is_credible(self) -> bool:
        """Eigenvalues are in floats; no proof says that these are wrong."""
        return self.stable is None or self.stable is (self.radius < 1.0)

    def _rate(self, digits: int) -> str:
        if not self._rate_is_credible:
            return "how fast in the long run, floats do not tell"
        rate = f"{self.radius:.{digits}g}" if math.isfinite(self.radius) else "more than a float64 holds"
        if self.digits < digits and math.isfinite(self.radius):
            rate = f"about {self.radius:.{self.digits}g}"
        elif 0.0 < abs(self.radius - 1.0) < _NEAR_1:
            rate = f"1 {'-' if self.radius < 1.0 else '+'} {abs(1.0 - self.radius):.3g}"
        return f"computed: in the long run each step multiplies E|error|^2 by {rate}"

    def text(self) -> str:
        """The facts for people."""
        problem, given = self.problem, self.given
        lines = [f"{given.source} on {problem.name}"]
        if self.foreign:
            assert given.file is not None
            lines.append(
                f"designed for another problem, {given.file.problem.name} ({given.file.problem_digest[:12]}...), "
                f"than the one here ({problem.digest()[:12]}...)"
            )
        if self.u is None:
            known = {
                True: "mean-square stable, proved, but no gain was found: floats do not resolve it",
                False: "NOT mean-square stable, proved: from some start the errors never die out",
                None: "it is not known whether the errors are mean-square stable",
            }[self.stable]
            lines.append(f"{known}; {self._rate(9)}")
            if self.ladder.floor is None:
                lines.append("no other gains do better: the sensors do not show an unstable part of the plant")
            return "\n".join(lines)
        assert self.ladder.exact is not None
        assert self.u is not None
        assert self.w is not None
        low, high = self.ladder.exact
        how = "proved" if self.unproved is None else "as far as floats tell"
        rungs = "\n           ".join(self.ladder.lines())
        then = f", then w = Gamma [x; e] for {_steps(self.steps - 1)}" if self.steps > 1 else ""
        if given.file is not None and given.file.certificate.holds and not self.foreign:
            lines.append(f"claimed    gamma {given.file.certificate.gamma}; peakmesh verify checks it")
        if self.unproved is not None:
            lines.append(f"certified  no gamma: {self.unproved}")
        lines += [
            f"stable     mean-square, {'proved' if self.stable else 'as far as floats tell'}; {self._rate(6)}",
            f"exact gain between {interval(low, high)}, {how}{self._shown}",
            f"ladder     {rungs}",
            *([] if self.robust is None else self.robust.lines()),
            *(f"radius     {radius.line()}" for radius in self.radii),
            f'worst w    that sees the past: w = 0 until mode "{self.mode}", then w along {_vector(self.u)}{then}; '
            f"E|z~|^2 peaks {_steps(self.steps)} after the first w{self._short_of(low)}",
            f"           that is fixed beforehand: gain {self.fixed:.6g} "
            f'from mode "{problem.markov.initial}" '
            f"over {_steps(self.fixed_within)}",
            *([] if self.beyond is None else told(self.beyond.document())),
        ]
        return "\n".join(lines)


def load_given(path: Path, problem: Problem) -> GivenGains:
    """Read gains for the links of `problem`. Raises InputError: one sentence for what does not fit."""
    if path.suffix in stacked.SUFFIXES:
        return GivenGains(*stacked.load(path, problem), str(path), None)
    data = read_bytes(path, kind="gains file")
    try:
        document = read_json(data)
    except (ValueError, RecursionError):
        document = None
    file = None
    if isinstance(document, dict) and "format" not in document and {"K", "H"} & set(document):
        document = _unstacked(document, problem, path)
        try:
            plain = _Plain.model_validate(document)
        except ValidationError as error:
            raise InputError(f"{path}: {first_fault(error, document)}") from None
        K, H = plain.K, plain.H
    elif isinstance(document, dict) and document.get("format") != FORMAT:
        raise InputError(
            f'{path} holds no gains: it is neither a gains file, which says "format": "{FORMAT}", nor a table of '
            '"K" and "H", K[mode][i][j] for what node i does with the estimate of node j'
        )
    else:
        file = Gains.from_bytes(data, source=str(path))
        K, H = file.K, file.H
    return given(problem, K, H, source=str(path), file=file)


def given_plain(problem: Problem, K: Any, H: Any) -> GivenGains:
    """Gains that Python has, as maps by mode, receiver and sender, of arrays or lists. Raises InputError."""
    plain_gains = _Plain.from_document(plain({"K": K, "H": H}))
    return given(problem, plain_gains.K, plain_gains.H, source="what is given", file=None)


def given(problem: Problem, K: LinkMatrices, H: LinkMatrices, *, source: str, file: Gains | None) -> GivenGains:
    """Gains for the links of `problem`; InputError where they are for others."""
    try:
        check_links(problem, K, H)
    except ValueError as error:
        raise InputError(f"{source} does not fit {problem.name}: {error}") from None
    return GivenGains(K, H, source, file)


def _unstacked(document: dict[str, Any], problem: Problem, path: Path) -> dict[str, Any]:
    """The document with gains for links, where it has one matrix for each mode."""
    some = document.get("K")
    some = next(iter(some.values()), None) if isinstance(some, dict) else some
    if not isinstance(some, list) or set(document) != {"K", "H"}:
        return document
    try:
        K, H = stacked.unstacked(problem, document["K"], document["H"])
    except ValueError as error:
        raise InputError(f"{path} does not fit {problem.name}: {error}") from None
    return {"K": K, "H": H}


def analyse(
    problem: Problem, given: GivenGains, box: Box | None = None, *, radius: Literal["all", "cheap"] | None = None
) -> Analysis:
    """The exact gain of the gains on the problem, what attains it, and what holds for every model of a box.

    `radius`: how large boxes may be for a gamma that is a little larger, of every shape or of those that take little.
    """
    from designer.undercut import undercut  # loads a solver, which reading gains does not take

    refuse_nothing_to_estimate(problem)
    model = model_of_gains(problem, given.K, given.H)
    gain = narrowed(problem, given.K, given.H, exact_gain(model))
    exact = (gain.low, gain.high) if gain.stable else None
    least = floor(problem)
    ladder = Ladder(None if math.isinf(least) else least, exact, gamma=None, theorem2_exact=None, theorem2=None)
    if not gain.stable:
        stable = Prover(problem, given.K, given.H).stable.holds
        none = ladder, None, 0, None, None, None, 0, None
        return Analysis(problem, given, stable, gain.radius, gain.horizon, *none, digits=gain.digits)
    verdict = confirmed(problem, given.K, given.H, gain.high)
    if verdict.holds:
        ladder = ladder._replace(exact=(lower_end(problem, given.K, given.H, gain), verdict.gamma))
    in_box = None if box is None else robust(problem, given.K, given.H, box)
    if in_box is not None:
        found = in_box.found if math.isfinite(in_box.found) else None
        ladder = ladder._replace(found_in_box=found, proved_in_box=in_box.gamma)
    by_lmi = undercut(problem, seconds=_MOST_SECONDS)
    policy = worst_policy(model, horizon=_steps_of_policy(model, gain))
    fixed = worst_fixed(model, initial=problem.mode_index(problem.markov.initial))
    return Analysis(
        problem=problem,
        given=given,
        stable=verdict.holds or Prover(problem, given.K, given.H).stable.holds,
        radius=gain.radius,
        digits=gain.digits,
        horizon=gain.horizon,
        ladder=ladder._replace(
            gamma=verdict.gamma if verdict.holds else None,
            lmi="the LMI" if beyond_paper(problem) else "Theorem 2",
            theorem2_least=by_lmi.gamma,
            theorem2_why_not=by_lmi.why_not,
        ),
        mode=problem.mode_names[policy.mode],
        steps=len(policy.Gamma) + 1,
        policy_gain=policy.gamma,
        u=policy.u * (-1.0 if policy.u[np.abs(policy.u).argmax()] < 0.0 else 1.0),
        fixed=fixed.gain,
        fixed_within=fixed.within,
        w=fixed.w,
        unproved=verdict.failure,
        beyond=beyond_gamma(problem, given.K, given.H),
        robust=in_box,
        radii=tuple(radii(problem, given.K, given.H, verdict.gamma, dear=radius == "all"))
        if radius and verdict.holds
        else (),
    )


def _steps_of_policy(model: ErrorModel, gain: Gain) -> int:
    """Those that show the exact gain; where errors decay slowly it is known without, so as many as take no time."""
    if gain.radius < SLOW:
        return gain.horizon
    steps, numbers = _MOST_OF_POLICY
    return max(gain.horizon, min(steps, int(numbers / (model.modes * model.size**2))))


def certified(problem: Problem, given: GivenGains) -> Gains:
    """A gains file of the given gains, with a certificate of their exact gain; or Unattainable."""
    certificate = certify(problem, given.K, given.H)
    solver = Solver(name="none", version="-", status="the gains were given", iterations=0, seconds=0.0)
    return with_worst_case(Gains.of(problem, given.K, given.H, method="given", certificate=certificate, solver=solver))


def _vector(u: Array) -> str:
    return "[" + ", ".join(f"{entry:.4g}" for entry in u) + "]"


def _steps(number: int) -> str:
    return "1 step" if number == 1 else f"{number} steps"
