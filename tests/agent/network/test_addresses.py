"""Addresses that cannot work are refused before anybody waits for them."""

from __future__ import annotations

import pytest

from agent.contract.errors import InputError
from agent.network.addresses import machine, refuse_addresses


@pytest.mark.parametrize(
    "address",
    ["tcp/127.0.0.1:7447", "tcp/[::1]:1", "udp/localhost:65535", "ws/127.0.0.1:80", "unixsock-stream//tmp/a.sock",
     "tcp/127.0.0.1:7447?prio=1-3", "tcp/127.0.0.1:7447#iface=eth0", "multicast"],
)  # fmt: skip
def test_addresses_that_can_work_are_taken(address: str) -> None:
    refuse_addresses(listen="none" if address == "multicast" else address, connect=[address])


@pytest.mark.parametrize(
    ("address", "why"),
    [
        ("tcp/127.0.0.1", "the port is missing"),
        ("tcp/127.0.0.1:", "the port is missing"),
        ("tcp/[::1]", "the port is missing"),
        ("tcp/:7447", "the host is missing"),
        ("tcp/127.0.0.1:99999", "99999 is not a port; ports are "),
        ("tcp/127.0.0.1:-1", "-1 is not a port"),
        ("tcp/127.0.0.1:٧٧", "٧٧ is not a port"),
        ("tcp/127.0.0.1:http", "http is not a port"),
        ("tcp/::1:7447", "an IPv6 address stands in brackets"),
        ("tcp/127.0.0.1:1,tcp/127.0.0.1:2", "one address has no comma; give --{} once for each"),
        ("tcp/127.0.0.1:1, tcp/127.0.0.1:2", "one address has no comma; give --{} once for each"),
        ("foo/127.0.0.1:7447", "there is no such protocol as foo; there are tcp, udp, "),
        ("127.0.0.1:7447", "an address looks like tcp/127.0.0.1:7447"),
        ("", "an address looks like tcp/127.0.0.1:7447"),
        ("tcp/no-such-host.invalid:7447", "the host no-such-host.invalid is not known here: "),
        (f"tcp/{'a' * 70}.invalid:7447", " is not known here: "),
    ],
)
@pytest.mark.parametrize("option", ["connect", "listen"])
def test_addresses_that_cannot_work_are_refused(option: str, address: str, why: str) -> None:
    good = "tcp/127.0.0.1:7447"
    with pytest.raises(InputError) as refused:
        refuse_addresses(
            listen=address if option == "listen" else good, connect=[address if option == "connect" else good]
        )
    assert why.format(option) in str(refused.value)
    assert address in str(refused.value)


def test_port_0_is_to_listen_on_alone() -> None:
    refuse_addresses(listen="tcp/127.0.0.1:0", connect=[])
    with pytest.raises(InputError, match="0 is not a port; ports are 1 to 65535"):
        refuse_addresses(listen="none", connect=["tcp/127.0.0.1:0"])


def test_a_process_is_on_one_machine() -> None:
    assert machine() == machine() != ""
