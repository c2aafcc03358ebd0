"""The viewer: shows a running network to Foxglove. It only looks on (`onlooker`): a run is the same without it.

Foxglove's server, too, drops what a client is too slow for.
"""

from __future__ import annotations

import json
import math
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from agent.contract.errors import InputError
from agent.contract.extras import needing
from agent.contract.gains import Gains
from agent.contract.keys import COORDINATOR, EVENT, data_topics, model_of
from agent.network.configuration import Network
from agent.network.session import Channel
from agent.network.words import ChannelClosed, Words
from agent.roles.onlooker import viewing, wait_for_coordinator


def run(network: Network, gains: Gains, *, run: str, host: str, port: int, say: Callable[[str], None]) -> None:
    """Serve run `run` at ws://host:port until it has ended; `say` gets the address as soon as clients may come.

    Raises RunBroken where the run is not there within `network.wait` seconds, InputError where the port is taken.
    """
    words = Words("")
    with viewing(network, run, words) as session:
        overheard = session.overhear()
        with _server(gains, run, host, port) as (address, show):
            say(address)
            session.watch(words.see)
            wait_for_coordinator(words, run, network.wait)
            threading.Thread(target=_pass_on, args=(overheard, show), daemon=True).start()
            while COORDINATOR in words.present:
                words.take(math.inf)


def _pass_on(overheard: Channel, show: Callable[[str, bytes], None]) -> None:
    """Until the session is closed."""
    while True:
        try:
            sample = overheard.next()
        except ChannelClosed:
            return
        show(sample.topic, sample.payload)


@contextmanager
def _server(gains: Gains, run: str, host: str, port: int) -> Iterator[tuple[str, Callable[[str, bytes], None]]]:
    """Foxglove's server with a channel for each topic of the run: its address, and what takes the messages."""
    with needing("live"):
        import foxglove
    context = foxglove.Context()
    channels = {topic: _channel(foxglove, topic, context) for topic in (*data_topics(gains.problem), EVENT)}
    try:
        server = foxglove.start_server(name=f"peakmesh: {run}", host=host, port=port, context=context)
    except RuntimeError as error:
        raise InputError(f"{host}:{port} cannot be listened on: {error}; --port 0 takes a free one") from None

    def show(topic: str, payload: bytes) -> None:
        if topic in channels:
            channels[topic].log(payload, log_time=time.time_ns())

    try:
        yield f"ws://{host}:{server.port}", show
    finally:
        server.stop()


def _channel(foxglove: Any, topic: str, context: Any) -> Any:
    """With the schema that a recording has."""
    model = model_of(topic)
    assert model is not None
    schema = json.dumps(model.model_json_schema()).encode()
    return foxglove.Channel(
        topic,
        schema=foxglove.Schema(name=f"peakmesh.{model.__name__}", encoding="jsonschema", data=schema),
        message_encoding="json",
        context=context,
    )
