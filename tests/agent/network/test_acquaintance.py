"""Whom the coordinator lets in, and whom it names where two cannot meet."""

from __future__ import annotations

import pytest

from agent.contract.errors import InputError
from agent.contract.messages import Joining
from agent.network.acquaintance import Acquaintance, stray_sensor

HERE, THERE = "tcp/127.0.0.1:0", "tcp/0.0.0.0:0"


def joining(who: str, *, listen: str = THERE, machine: str = "", **fields: object) -> Joining:
    return Joining.from_document(
        {"session": "s", "version": "1.2.3", "lease": 20.0}
        | {"lacks": [other for other in ("plant", "recorder", "node-a") if other != who]}
        | {"who": who, "listen": listen, "machine": machine or who}
        | fields
    )


@pytest.fixture
def acquaintance() -> Acquaintance:
    return Acquaintance(joining("coordinator"))


@pytest.mark.parametrize(
    ("one", "other", "meet"),
    [
        (THERE, THERE, True),
        (THERE, "tcp/10.0.0.7:7447", True),
        ("tcp/[::]:0", "tcp/name.local:1", True),
        (HERE, HERE, False),
        (HERE, THERE, False),
        ("tcp/[::1]:0", THERE, False),
        ("udp/localhost:7", THERE, False),
        ("unixsock-stream//tmp/a", THERE, False),
        (HERE, "none", True),
        ("none", "none", True),
    ],
)
@pytest.mark.parametrize("turned", [False, True])
def test_two_on_different_machines_who_can_never_meet_are_refused_at_once(
    acquaintance: Acquaintance, one: str, other: str, meet: bool, turned: bool
) -> None:
    first, second = (other, one) if turned else (one, other)
    acquaintance.heed(joining("plant", listen=first))
    if meet:
        assert acquaintance.heed(joining("recorder", listen=second)) == ""
        return
    with pytest.raises(InputError) as refused:
        acquaintance.heed(joining("recorder", listen=second))
    assert str(refused.value).startswith(
        f"the plant and the recorder have reached the coordinator, but have no link between them: the plant listens at "
        f"{first}, the recorder at {second}; each must listen where the other can connect to, such as --listen "
        "tcp/0.0.0.0:0, or "
    )


def test_on_one_machine_everybody_can_meet(acquaintance: Acquaintance) -> None:
    for who in ("plant", "recorder", "node-a"):
        assert acquaintance.heed(joining(who, listen=HERE, machine="one")) == ""
    assert 'the plant and node "a"' not in acquaintance.strangers([], seconds=1.0)


def test_who_need_not_meet_is_not_refused(acquaintance: Acquaintance) -> None:
    acquaintance.heed(joining("node-a", listen=HERE, lacks=["recorder"]))
    assert acquaintance.heed(joining("plant", listen=HERE, lacks=[])) == ""


def test_the_first_two_that_lack_each_other_are_named(acquaintance: Acquaintance) -> None:
    """With the number of other pairs; a pair is one, whoever of it complains."""
    for who in ("plant", "recorder", "node-a"):
        acquaintance.heed(joining(who))
    said = acquaintance.strangers(["plant", "recorder", "node-a"], seconds=5.0)
    assert said.startswith("after 5 s the plant and the recorder have reached the coordinator, but have no link")
    assert said.endswith("; the same holds for 2 more pairs")
    for who in ("plant", "recorder"):
        acquaintance.heed(joining(who, lacks=["node-a"]))
    acquaintance.heed(joining("node-a", lacks=["plant"]))
    assert acquaintance.strangers(["plant"], seconds=5.0).endswith("; the same holds for 1 more pair")


def test_who_lacks_nobody_is_not_said_to(acquaintance: Acquaintance) -> None:
    for who in ("plant", "recorder"):
        acquaintance.heed(joining(who, lacks=[]))
    said = acquaintance.strangers(["recorder", "plant"], seconds=5.0)
    assert said == "the plant and the recorder reached the coordinator, but had not met everybody within 5 s"


@pytest.mark.parametrize(
    ("version", "allowed"), [("1.2.3", True), ("1.2.4.dev1", True), ("1.3.0", False), ("2.2.3", False), ("", False)]
)
def test_versions_are_compared(acquaintance: Acquaintance, version: str, allowed: bool) -> None:
    """What only mends is let in, and told; anything else is refused by name."""
    if allowed:
        said = "" if version == "1.2.3" else f"the plant is peakmesh {version}, the coordinator 1.2.3"
        assert acquaintance.heed(joining("plant", version=version)) == said
        assert acquaintance.heed(joining("plant", version=version)) == ""  # once
        return
    with pytest.raises(InputError, match=r"the plant is peakmesh .*, this is 1\.2\.3: update one"):
        acquaintance.heed(joining("plant", version=version))


def test_a_shorter_patience_is_told(acquaintance: Acquaintance) -> None:
    """A link would be given up before the coordinator's deadline."""
    assert acquaintance.heed(joining("plant", lease=30.0)) == ""
    said = acquaintance.heed(joining("recorder", lease=10.0))
    assert said.startswith("the recorder gives up a link after 10 s of silence, the coordinator after 20 s")


def test_a_sensor_that_nobody_expects_is_named() -> None:
    assert stray_sensor("sensor-a").startswith('sensor "a" is there, but the run was started without --external a: ')
    assert [stray_sensor(who) for who in ("node-a", "plant", "viewer")] == [""] * 3
