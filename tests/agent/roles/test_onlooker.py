"""Whoever looks on finds the run that is there."""

from __future__ import annotations

import socket
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing

import pytest

from agent.contract.errors import InputError, RunBroken
from agent.contract.keys import COORDINATOR, PLANT
from agent.network.configuration import Network
from agent.network.session import Session
from agent.roles import onlooker
from agent.roles.onlooker import find_run

PATIENCE = 60.0


@pytest.fixture
def runs() -> Iterator[Callable[..., Network]]:
    """Takes who is there in which runs, as (run, who); returns how to get there."""
    with ExitStack() as stack:

        def there(*places: tuple[str, str]) -> Network:
            address = ()
            for run, who in places:
                network = Network(connect=address)
                session = stack.enter_context(closing(Session(network, run=run, who=who, hand_over=lambda duty: None)))
                session.appear(who)
                address = address or tuple(session.locators())
            return Network(connect=address, wait=PATIENCE)

        yield there


def test_the_only_run_is_found(runs: Callable[..., Network]) -> None:
    """By its coordinator: of other runs nobody but some plant is there."""
    assert find_run(runs(("one", COORDINATOR), ("two", PLANT))) == "one"


def test_of_several_runs_one_must_be_chosen(runs: Callable[..., Network], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(onlooker, "AMONG_SECONDS", PATIENCE)
    with pytest.raises(InputError, match='there are the runs "one" and "two"; choose one with --run'):
        find_run(runs(("one", COORDINATOR), ("two", COORDINATOR)))


def test_where_there_is_none_it_says_so() -> None:
    with socket.socket() as nobody:
        nobody.bind(("127.0.0.1", 0))
        address = f"tcp/127.0.0.1:{nobody.getsockname()[1]}"
        with pytest.raises(RunBroken, match=f"no run was found at {address} within 0.2 s"):
            find_run(Network(connect=(address,), wait=0.2))
