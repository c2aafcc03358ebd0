"""Without keys this machine alone is listened to; with them everything is encrypted."""

from __future__ import annotations

from pathlib import Path

import pytest
from here import here

from agent.commands.security import refuse_insecure
from agent.contract.errors import InputError


@pytest.mark.parametrize(
    ("address", "local"),
    [
        ("tcp/127.0.0.1:0", True),
        ("tcp/127.1.2.3:7447", True),
        ("tcp/[::1]:7447", True),
        ("udp/localhost:7447", True),
        ("unixsock-stream//tmp/peakmesh.sock", True),
        ("none", True),
        ("tcp/0.0.0.0:7447", False),
        ("tcp/[::]:7447", False),
        ("tcp/192.0.2.1:7447", False),
        ("udp/[2001:db8::1]:7447", False),
        ("tcp/127.example.com:7447", False),
    ],
)
def test_other_machines_reach_nothing_unless_that_is_asked_for(address: str, local: bool) -> None:
    refuse_insecure(address, (), keys=None, insecure=True)
    refuse_insecure("tcp/127.0.0.1:0", (address,), keys=None, insecure=False)
    if local:
        refuse_insecure(address, (), keys=None, insecure=False)
    else:
        with pytest.raises(InputError, match="other machines could take part and forge everything"):
            refuse_insecure(address, (), keys=None, insecure=False)


def test_keys_and_tls_go_together() -> None:
    """Wherever it listens, and with --insecure too."""
    keys, plain, encrypted = Path("keys"), "tcp/127.0.0.1:1", "tls/0.0.0.0:1"
    refuse_insecure(encrypted, (encrypted, "multicast"), keys=keys, insecure=False)
    for listen, connect, given, sentence in (
        (plain, encrypted, keys, f"--listen {plain}: with --keys everything is encrypted; an address looks like tls/"),
        (encrypted, plain, keys, f"--connect {plain}: with --keys everything is encrypted; an address looks like tls/"),
        (encrypted, "tls/[::1]:1", keys, "--connect tls/[::1]:1: Zenoh's TLS has no IPv6 addresses; give one of IPv4"),
        (
            "none",
            encrypted,
            keys,
            "--listen none: with --keys everybody must listen, for whoever passed on what others",
        ),
        (
            encrypted,
            plain,
            None,
            f"--listen {encrypted}: there is no TLS without --keys FOLDER; peakmesh keys init makes",
        ),
        (plain, encrypted, None, f"--connect {encrypted}: there is no TLS without --keys FOLDER; peakmesh keys init "),
    ):
        with pytest.raises(InputError) as caught:
            refuse_insecure(listen, (connect,), keys=given, insecure=True)
        assert str(caught.value).startswith(sentence)


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["coordinator", "--listen", "tcp/0.0.0.0:7447"], "--listen tcp/0.0.0.0:7447: other machines could take part "
         "and forge everything; --keys FOLDER keeps them out, --insecure lets them in"),
        (["live", "--connect", "tcp/127.0.0.1:1", "--host", "0.0.0.0"], "--host 0.0.0.0: others could look on, for "
         "Foxglove is sent everything in the clear; --insecure lets them"),
        (["recorder", "--connect", "tcp/127.0.0.1:1", "--keys", "nowhere"], "--keys nowhere: there is no ca.pem in it, "
         "which the recorder needs; peakmesh keys init makes it"),
        (["run", "--keys", "nowhere"], "--keys nowhere: there is no ca.pem in it, which"),
    ],
)  # fmt: skip
def test_a_role_says_so_and_does_not_start(pair_path: Path, tmp_path: Path, words: list[str], sentence: str) -> None:
    command, *options = words
    done = here(command, pair_path, *options, cwd=tmp_path)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith(f"peakmesh: {sentence}")
