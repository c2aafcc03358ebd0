"""Who cannot be reached is found, over real Zenoh, and who can is not accused."""

from __future__ import annotations

import socket
import threading
from collections.abc import Iterator
from contextlib import closing, suppress

import pytest

from agent.contract.errors import InputError
from agent.contract.keys import COORDINATOR
from agent.doctor import network as module
from agent.doctor.findings import State
from agent.network.configuration import Network
from agent.network.session import Session

PATIENCE = 60.0  # seconds; nobody waits so long where all is well
SOON = 0.5  # for what never comes


def of(run: str, address: str = "tcp/127.0.0.1:0") -> closing[Session]:
    return closing(Session(Network(address), run=run, who=COORDINATOR, hand_over=lambda duty: None))


@pytest.fixture
def port() -> Iterator[int]:
    """Of somebody who listens and hangs up at once, for Zenoh would wait for his words for ten seconds."""

    def hang_up() -> None:
        with suppress(OSError):  # the server is closed
            while True:
                server.accept()[0].close()

    with socket.create_server(("127.0.0.1", 0)) as server:
        thread = threading.Thread(target=hang_up)
        thread.start()
        yield int(server.getsockname()[1])
        server.shutdown(socket.SHUT_RDWR)  # wakes who accepts
        thread.join()


def nobody() -> str:
    """An address at which nobody listens."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        return f"tcp/127.0.0.1:{server.getsockname()[1]}"


def test_sessions_of_one_process_meet() -> None:
    for look in (module.loopback, module.sockets):
        found = look(PATIENCE)
        assert found.state is State.GOOD, found.said


@pytest.mark.parametrize("look", [module.loopback, module.sockets])
def test_sessions_that_do_not_meet_are_told(look: object, monkeypatch: pytest.MonkeyPatch) -> None:
    """The second has another address than that of the first."""

    def meet(what: str, listens: Session, network: Network, how: str, wait: float) -> object:
        return honest(what, listens, Network("tcp/127.0.0.1:0", (nobody(),)), how, wait)

    honest = module._meet
    monkeypatch.setattr(module, "_meet", meet)
    found = look(SOON)  # type: ignore[operator]
    assert found.state is State.WRONG
    assert "did not meet" in found.said


def test_a_folder_without_sockets_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "folder_of_sockets", lambda: "/proc")
    assert module.sockets(SOON).state is State.WRONG


def test_a_session_that_cannot_be_opened_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object, **__: object) -> object:
        raise InputError("cannot listen")

    monkeypatch.setattr(module, "Session", refuse)
    assert [look(SOON) for look in (module.loopback, module.sockets)] == [("zenoh", State.WRONG, "cannot listen")] * 2


def test_a_port_that_is_taken(port: int) -> None:
    taken = module.listening(Network(f"tcp/127.0.0.1:{port}"))
    assert (taken.state, "the port is in use" in taken.said) == (State.WRONG, True)
    free = module.listening(Network("tcp/127.0.0.1:0"))
    assert (free.state, free.said.startswith("can listen at tcp/127.0.0.1:")) == (State.GOOD, True)


def test_a_run_is_found_by_its_name() -> None:
    with of("a-run") as there:
        there.appear(COORDINATOR)
        (address, *_) = there.locators()
        (found,) = module.reached(Network(connect=(address,), wait=PATIENCE))
    assert (found.state, found.said) == (State.GOOD, f'run "a-run" is at {address}')


def test_where_there_is_no_run(port: int) -> None:
    """Nobody at all; somebody who speaks no Zenoh; and somebody who does, and is in no run."""
    (refused,) = module.reached(Network(connect=(address := nobody(),), wait=PATIENCE))
    assert (refused.state, refused.said) == (State.WRONG, f"nobody answers at {address}: Connection refused")
    (silent,) = module.reached(Network(connect=(f"tcp/127.0.0.1:{port}",), wait=SOON))
    assert (silent.state, "no run was found" in silent.said) == (State.WRONG, True)
    with of("a-run") as there:
        (address, *_) = there.locators()
        (idle,) = module.reached(Network(connect=(address,), wait=SOON))
    assert (idle.state, "no run was found" in idle.said) == (State.WRONG, True)


def test_several_addresses_are_each_tried() -> None:
    addresses = nobody(), nobody()
    assert [finding.state for finding in module.reached(Network(connect=addresses, wait=PATIENCE))] == ["wrong"] * 2
