"""No copy is stale or unchecked: every model of both packages, and every frozen dataclass that caches."""

from __future__ import annotations

import copy
import importlib
import pickle
import pkgutil
import warnings
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, fields, is_dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import peakmesh
import pytest
from made_recordings import observer_gains, real_problem
from places import GOLDEN
from pydantic import BaseModel

import agent
import designer
from agent.contract import messages
from agent.contract.arrays import Array, Matrix, Model, Number
from agent.contract.errors import InputError
from agent.contract.frozen import Frozen
from agent.contract.gains import BoxClaim, Gains, Weights
from agent.contract.problem import Problem
from agent.contract.problem.disturbance import DampedSine, Impulse, Quiet, Samples, White, WorstCase
from agent.contract.problem.parts import Continuous
from agent.contract.problem.uncertainty import OfChain, OfLink, OfNode, OfPlant, Uncertainty
from designer import analysis, problems
from designer.model.error_model import ErrorModel, Stacks, error_model, stacked_gains, stacks
from designer.replay.central import Central
from designer.replay.coupling import Coupling
from designer.replay.inputs import draw, logged_inputs
from designer.replay.proofs import to_be_heard
from designer.report.account import Account

BASES = {Frozen, Model, messages.Message, messages.Word}  # of which there are no instances
LOSSY = problems.find("zhu2020-lossy")
PLANT, NODES = LOSSY.plant, LOSSY.nodes


def modules() -> Iterator[Any]:
    """Every module of both packages."""
    for package in (agent, designer, peakmesh):
        for found in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
            if not found.name.endswith("__main__"):
                yield importlib.import_module(found.name)


def classes() -> set[type]:
    """Every class of both packages."""
    return {
        value
        for module in modules()
        for value in vars(module).values()
        if isinstance(value, type) and value.__module__ == module.__name__
    }


def models() -> set[type[Frozen]]:
    return {value for value in classes() if issubclass(value, BaseModel)} - BASES


def caching() -> set[type]:
    """The dataclasses that keep what they have computed."""
    return {value for value in classes() if is_dataclass(value) and cached(value)}


def cached(kind: type) -> list[str]:
    """The cached properties of a class."""
    return [name for base in kind.__mro__ for name, value in vars(base).items() if isinstance(value, cached_property)]


def parts(value: Any) -> Iterator[Any]:
    """A model, and everything in it."""
    yield value
    if isinstance(value, BaseModel):
        value = [getattr(value, name) for name in type(value).model_fields]
    if isinstance(value, dict):
        value = list(value.values())
    for part in value if isinstance(value, list | tuple) else ():
        yield from parts(part)


def examples() -> dict[type, Frozen]:
    """One of every model."""
    gains = observer_gains(real_problem(1, radius=1.02))
    made: list[Frozen] = [
        gains,
        analysis._Plain(K=gains.K, H=gains.H),
        LOSSY,
        Continuous(A_continuous=np.zeros((1, 1)), B_continuous=np.ones((1, 1)), sample_time=0.5),
        DampedSine(kind="damped-sine", decay=0.2),
        Impulse(kind="impulse"),
        White(kind="white", deviation=1.0),
        Samples(kind="csv", file="w.csv", values=np.ones((2, 1))),
        WorstCase(kind="worst-case"),
        Quiet(),
        Weights(states=np.eye(1), V={"1": [[1.0], [0.0, 1.0]]}),
        BoxClaim(gamma=1.0, ends=[True], rows=[0], signs=[]),
        OfPlant(A=[[0.1, "2%"]]),
        OfNode(C="1%", arrival_probability=[0.1, 0]),
        OfLink(delivery_probability=0.1),
        OfChain(transition=[0.1, 0]),
        Uncertainty(probabilities="2%"),
        messages.Mode(step=0, mode="1"),
        messages.PlantState(step=0, x=[0.0], z=[0.1], w=[-0.0], arrived=[1]),
        messages.Measurement(step=0, y=[1e-300]),
        messages.Estimate(step=1, x_hat=[0.1], innovation=[0.2], z_hat=[0.3], mode="1", heard=["2"]),
        messages.Event(step=0, kind="start", who="coordinator", detail=""),
        messages.Evidence(step=0, who="plant", first=0, digests="0123abcd--------", head="0" * 32),
        messages.Account(
            step=1,
            who="node-1",
            steps=2,
            pairs=3,
            pairs_substituted=0,
            measurements_substituted=1,
            late=0,
            to_estimate_median=0.001,
            to_estimate_p99=0.002,
            to_estimate_max=0.003,
            to_step_median=0.001,
            to_step_p99=0.002,
            to_step_max=0.003,
        ),
        messages.BrokenOff(reason="the disk is full", steps=3, stop=True),
        messages.Joining(
            who="plant", session="a", version="0", listen="none", machine="", lease=1.0, lacks=["recorder"]
        ),
        messages.Leaving(who="plant", reason="b"),
        messages.Ready(who="node-1", session="a", gains="b"),
        messages.Refusals(who="node-1", counts={"mode": {"forged": 1}}),
        messages.Control(order="start", steps=1, seed=0, window=1, external=[], reason=""),
        messages.Facts(
            start=messages.Control(order="start", steps=1, seed=0, window=1, external=["1"], reason=""), gains="{}"
        ),
        messages.Acknowledged(
            steps=1, messages=2, missing=0, received={"plant": 1}, reached={}, lacking=[], closed=False
        ),
    ]
    return {type(part): part for whole in made for part in parts(whole) if isinstance(part, Frozen)}


EXAMPLES = examples()

WAYS: dict[str, Callable[[Any], Any]] = {
    "model_copy": lambda model: model.model_copy(),
    "model_copy of all fields": lambda model: model.model_copy(
        update={name: getattr(model, name) for name in type(model).model_fields}, deep=True
    ),
    "copy.copy": copy.copy,
    "copy.deepcopy": copy.deepcopy,
    "copy.replace": lambda model: model.__replace__(),  # of Python 3.13
    "pickle": lambda model: pickle.loads(pickle.dumps(model)),
}
UNCHECKED: dict[str, Callable[[Any], Any]] = {
    "model_construct": lambda model: type(model).model_construct(**dict(model)),
    "construct": lambda model: type(model).construct(**dict(model)),
    "copy": lambda model: model.copy(update={"no_field": 1}),
}


class Stale:
    """A value that nobody has computed."""


def faults(model: Any) -> set[str]:
    """What is wrong with copies of a model. What it caches is wrong to begin with, so that it is known again."""
    found, names, caches = set(), type(model).model_fields, cached(type(model))
    for way, copied in WAYS.items():
        vars(model).update(dict.fromkeys(caches, Stale()))
        twin = copied(model)
        for name in caches:
            del vars(model)[name]
        if type(twin) is not type(model) or twin.model_dump_json() != model.model_dump_json():
            found.add(f"{way}: differs")
        if any(isinstance(value, Stale) for value in vars(twin).values()):
            found.add(f"{way}: keeps what was cached")
        if any(isinstance(part, np.ndarray) and part.flags.writeable for part in parts(twin)):
            found.add(f"{way}: arrays can be written to")
    for name in [*names, "no_field"]:
        if accepted(lambda name=name: model.model_copy(update={name: object()})):
            found.add(f"model_copy: takes anything for {name}")
    return found | {way for way, made in UNCHECKED.items() if accepted(lambda made=made: made(model))}


def accepted(copied: Callable[[], Any]) -> bool:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # `copy` and `construct` are of pydantic 1
            copied()
    except (InputError, TypeError):
        return False
    return True


def unfrozen(kinds: Iterable[type]) -> set[type]:
    """The models and dataclasses of which what is cached may become wrong."""
    return {
        kind
        for kind in kinds
        if not (issubclass(kind, Frozen) or (is_dataclass(kind) and kind.__dataclass_params__.frozen))
    }


def test_every_model_is_frozen_and_has_an_example() -> None:
    assert unfrozen(models()) == set()
    assert models() == set(EXAMPLES)


@pytest.mark.parametrize("kind", EXAMPLES, ids=lambda kind: kind.__name__)
def test_every_copy_is_validated_and_caches_nothing(kind: type) -> None:
    assert faults(EXAMPLES[kind]) == set()


# mutants
class Pair(Model):
    """Two numbers, and what is computed of them."""

    values: Matrix
    share: Number = 1.0

    @cached_property
    def total(self) -> float:
        return self.share * float(self.values.sum())


class PlainShallow(Pair):
    __copy__ = BaseModel.__copy__


class PlainDeep(Pair):
    __deepcopy__ = BaseModel.__deepcopy__


class PlainCopy(PlainShallow, PlainDeep):
    model_copy = BaseModel.model_copy


class PlainPickle(Pair):
    __reduce__ = object.__reduce__


class PlainConstruct(Pair):
    model_construct = vars(BaseModel)["model_construct"]


class OldCopy(Pair):
    copy = BaseModel.copy


class Plain(BaseModel):
    """A frozen model, as pydantic makes them."""

    model_config = {"frozen": True}


@dataclass
class Loose:
    """Its field can be set."""

    values: Array


CACHED, WRITABLE = "keeps what was cached", "arrays can be written to"


@pytest.mark.parametrize(
    ("mutant", "caught"),
    [
        (Pair, set()),
        (
            PlainCopy,
            {f"{way}: {CACHED}" for way in WAYS if way != "pickle"}
            | {f"model_copy: takes anything for {name}" for name in ("values", "share", "no_field")}
            | {f"copy.deepcopy: {WRITABLE}"},
        ),
        (PlainShallow, {f"copy.copy: {CACHED}"}),
        (PlainDeep, {f"copy.deepcopy: {CACHED}", f"copy.deepcopy: {WRITABLE}"}),
        (PlainPickle, {f"pickle: {CACHED}", f"pickle: {WRITABLE}"}),
        (PlainConstruct, {"model_construct", "construct"}),
        (OldCopy, {"copy"}),
    ],
)  # fmt: skip
def test_a_model_that_copies_as_pydantic_does_is_caught(mutant: type[Pair], caught: set[str]) -> None:
    assert faults(mutant(values=[[1.0, 2.0]])) == caught


def test_what_is_not_frozen_is_caught() -> None:
    assert unfrozen([Plain, Loose, Pair, Central]) == {Plain, Loose}


# what it is for
def test_a_copy_of_a_problem_is_that_problem() -> None:
    """beta and the matrices of the model are those of the new nodes, as if they had been read from a file."""
    before = LOSSY.beta
    nodes = tuple(node.model_copy(update={"arrival_probability": 0.5}) for node in LOSSY.nodes)
    other = LOSSY.model_copy(update={"nodes": nodes})
    assert (before != 0.5).all()
    assert other.beta.tolist() == [0.5] * 4
    document = LOSSY.document()
    for node in document["node"]:
        node["arrival_probability"] = 0.5
    assert other == Problem.from_document(document)
    assert np.array_equal(stacks(other).C_beta, stacks(Problem.from_document(document)).C_beta)
    assert LOSSY.beta is before


def test_what_a_problem_has_computed_is_read_only() -> None:
    for name in ("beta", "delivery"):
        with pytest.raises(ValueError, match="read-only"):
            getattr(LOSSY, name)[0] = 0.5


@pytest.mark.parametrize(
    ("update", "sentence"),
    [
        ({"plant": PLANT.model_copy(update={"A": 2.0 * PLANT.A})}, "plant: A is unstable: its spectral radius is 1.6"),
        ({"nodes": [*NODES, NODES[0]]}, 'node "1" is there 2 times; names must differ'),
        ({"nodes": [NODES[0].document() | {"arrival_probability": 2}]}, 'node "1": arrival_probability: 2.0 is not in'),
        ({"topologies": LOSSY.topologies[:2]}, "markov: transition is 4 x 4; for 2 topologies it must be 2 x 2"),
        ({"beta": 0.5}, 'Problem has no field "beta"; it has "name", "plant", "nodes"'),
    ],
)  # fmt: skip
def test_an_update_that_breaks_the_problem_is_refused(update: dict[str, Any], sentence: str) -> None:
    """By the sentence that the file would get."""
    with pytest.raises(InputError) as caught:
        LOSSY.model_copy(update=update)
    assert sentence in str(caught.value)


def test_gains_of_another_problem_are_refused(gains: Gains) -> None:
    """The digest says for which problem they were designed."""
    other = gains.problem.model_copy(update={"name": "other"})
    with pytest.raises(InputError, match="the problem was edited afterwards; design the gains again"):
        gains.model_copy(update={"problem": other})
    assert gains.model_copy(update={"problem": other, "problem_digest": other.digest()}).problem == other


# dataclasses
def caching_examples() -> dict[type, Any]:
    gains = observer_gains(real_problem(1, radius=1.02))
    bar, model = stacks(gains.problem), error_model(gains.problem, *stacked_gains(gains))
    account = Account.of(GOLDEN / "zhu2020-lossy.mcap")
    log, central = account.log, Central.of(account.log.gains)
    drawn = draw(log, central)
    hears = to_be_heard(log, central, drawn)
    coupling = Coupling.of(log, central, logged_inputs(log, central, drawn), drawn, hears)
    return {ErrorModel: model, Stacks: bar, Central: central, Account: account, Coupling: coupling}


def test_what_dataclasses_cache_does_not_outlive_a_change_of_fields() -> None:
    """Each is frozen, and dataclasses.replace begins without what was computed."""
    made = caching_examples()
    assert caching() == set(made)
    assert unfrozen(made) == set()
    for kind, value in made.items():
        for name in cached(kind):
            getattr(value, name)
        assert set(vars(replace(value))) == {field.name for field in fields(kind)}
