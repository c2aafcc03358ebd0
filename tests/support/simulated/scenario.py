"""What a seed asks for: the network, the kind of run, the weather, and what befalls whom."""

from __future__ import annotations

import random
from dataclasses import dataclass, field
from functools import cache

from made_recordings import observer_gains, random_gains, random_problem, real_problem

from agent.contract.gains import Gains
from agent.contract.keys import COORDINATOR, PLANT, RECORDER, participants
from agent.plan import Pace, Plan
from simulated.network import Weather

KINDS = ("kill", "freeze", "part", "signal", "twin")


@dataclass(frozen=True)
class Trouble:
    """What happens to participant `who` so many seconds after the beginning, or once it has begun."""

    kind: str  # one of KINDS
    who: str
    at: float  # part of the run's steps after which it happens; below 0 while everybody is still gathering
    seconds: float = 0.0  # how long it lasts
    other: str = ""  # the other end of a link that is parted; "" isolates `who`

    def text(self) -> str:
        whom = f"{self.who} and {self.other}" if self.other else self.who
        long = f" for {self.seconds:g} s" if self.seconds else ""
        return f"{self.kind} {whom} at {self.at:.2f}{long}"


@dataclass(frozen=True)
class Scenario:
    seed: int
    gains: Gains
    plan: Plan
    weather: Weather
    troubles: tuple[Trouble, ...] = ()
    wait: float = 20.0
    keep: float = 64e6  # bytes
    starts: dict[str, float] = field(default_factory=dict)  # when each process is started, in seconds

    @property
    def is_fair(self) -> bool:
        """Whether nothing happens that a run in lock-step does not survive."""
        weather = self.weather
        harmless = not (weather.dropped or weather.disordered or weather.doubled) or weather.victims == RECORDER
        return harmless and not self.troubles and not self.plan.faults

    def text(self) -> str:
        """In one line, for whoever looks into a seed."""
        plan, weather = self.plan, self.weather._asdict()
        words = [
            f"seed {self.seed}: {self.gains.problem.n} nodes, {plan.steps} steps",
            f"paced, {1e3 * plan.pace.period:g} ms" if plan.pace else f"lock-step, window {plan.window}",
            ", ".join(f"{name} {value}" for name, value in weather.items() if value),
            *plan.faults,
            *(trouble.text() for trouble in self.troubles),
        ]
        return "; ".join(words)


@cache
def _networks() -> tuple[Gains, ...]:
    """Small ones; two have links that lose messages."""
    return (
        random_gains(random_problem(11, ny=(1, 2), modes=2)),
        random_gains(random_problem(5, ny=(1, 2, 1), modes=2)),
        observer_gains(real_problem(3, ny=(1, 1, 1), modes=2)),
        random_gains(real_problem(7, ny=(1, 2, 1), modes=3, unbiased=False)),
    )


def scenario(seed: int) -> Scenario:
    """The same for a seed every time."""
    chance = random.Random(f"scenario {seed}")
    gains = chance.choice(_networks())
    everybody = participants(gains.problem)
    paced = chance.random() < 0.5
    steps = chance.randint(5, 25)
    pace = Pace(chance.choice((0.02, 0.05, 0.1))) if paced else None
    weather = _weather(chance, paced)
    how_many = chance.choice((0, 0, 1, 1, 2, 3) if paced else (0, 0, 1))
    troubles = tuple(_trouble(chance, everybody) for _ in range(how_many))
    faults = tuple(_faults(chance, gains, steps)) if paced and chance.random() < 0.4 else ()
    plan = Plan(
        steps, chance.randrange(2**32), chance.choice((1, 2, 8, 32)), chance.choice((5.0, 10.0)), (), pace, faults
    )
    starts = {who: chance.expovariate(1.0) for who in everybody}
    return Scenario(seed, gains, plan, weather, troubles, starts=starts)


def _weather(chance: random.Random, paced: bool) -> Weather:
    calm = Weather(delay=chance.choice((2e-4, 1e-3, 5e-3)), reaction=chance.choice((5e-5, 1e-3)))
    if chance.random() < 0.3:
        calm = calm._replace(stutter=0.02)
    if chance.random() < 0.5:
        return calm
    worse = {name: chance.choice((0.01, 0.1)) for name in ("dropped", "doubled", "disordered") if chance.random() < 0.5}
    victims = "" if chance.random() < (0.5 if paced else 0.1) else RECORDER
    return calm._replace(victims=victims, **worse)


def _trouble(chance: random.Random, everybody: list[str]) -> Trouble:
    kind = chance.choice(KINDS)
    who = chance.choice(everybody)
    at = chance.uniform(-0.3, 1.2)
    seconds = chance.choice((0.05, 0.5, 3.0, 12.0)) if kind in ("freeze", "part") else 0.0
    other = ""
    if kind == "part" and chance.random() < 0.7:
        other = chance.choice([name for name in everybody if name != who])
    return Trouble(kind, who, at, seconds, other)


def _faults(chance: random.Random, gains: Gains, steps: int) -> list[str]:
    """As `--fault` takes them."""
    names = gains.problem.node_names
    found = []
    for _ in range(chance.choice((1, 1, 2, 4))):
        whom = chance.choice((*(f"node={name}" for name in names), COORDINATOR, PLANT, RECORDER))
        step = chance.randrange(steps)
        match chance.choice(("kill", "freeze", "mute-link", "delay", "drop")):
            case "kill":
                found.append(f"kill:{whom},step={step}")
            case "freeze":
                found.append(f"freeze:{whom},step={step},for={chance.choice((30, 300, 2000))}ms")
            case "mute-link":
                name = chance.choice(names)
                found.append(f"mute-link:{chance.choice((PLANT, COORDINATOR))}>{name},steps={step}")
            case "delay":
                found.append(f"delay:node={chance.choice(names)},by={chance.choice((5, 30, 90))}ms")
            case "drop":
                found.append("drop:probability=0.1")
    return found
