"""Without keys this machine alone is listened to; with them everything is encrypted."""

from __future__ import annotations

from pathlib import Path

import pytest
from here import here

from agent.commands.security import is_local, refuse_insecure
from agent.contract.errors import InputError


@pytest.mark.parametrize(
    ("address", "local"),
    [
        ("tcp/127.0.0.1:0", True),
        ("tcp/127.1.2.3:7447", True),
        ("tcp/[::1]:7447", True),
        ("udp/localhost:7447", True),
        ("unixsock-stream//tmp/peakmesh.sock", True),
        ("tcp/0.0.0.0:7447", False),
        ("tcp/[::]:7447", False),
        ("tcp/192.0.2.1:7447", False),
        ("udp/[2001:db8::1]:7447#iface=eth0", False),
    ],
)
def test_what_other_machines_reach_is_known(address: str, local: bool) -> None:
    assert is_local(address) == local
    for listening in (False, True):
        if local or not listening:
            refuse_insecure("--listen" if listening else "--connect", address, keys=None, insecure=False)
        else:
            with pytest.raises(InputError, match="other machines could take part and forge everything"):
                refuse_insecure("--listen", address, keys=None, insecure=False)
        refuse_insecure("--listen", address, keys=None, insecure=True)


@pytest.mark.parametrize("option", ["--listen", "--connect"])
def test_keys_and_tls_go_together(option: str) -> None:
    """Wherever it listens, and with --insecure too."""
    refuse_insecure(option, "tls/0.0.0.0:0", keys=Path("keys"), insecure=False)
    for address, keys, sentence in (
        (
            "tcp/127.0.0.1:0",
            Path("keys"),
            "with --keys everything is encrypted; an address looks like tls/127.0.0.1:7447",
        ),
        ("tls/127.0.0.1:0", None, "there is no TLS without --keys FOLDER, which peakmesh keys init makes"),
    ):
        with pytest.raises(InputError) as caught:
            refuse_insecure(option, address, keys=keys, insecure=True)
        assert str(caught.value) == f"{option} {address}: {sentence}"


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["coordinator", "--listen", "tcp/0.0.0.0:7447"], "--listen tcp/0.0.0.0:7447: other machines could take part "
         "and forge everything; --keys FOLDER keeps them out, --insecure lets them in"),
        (["plant", "--connect", "tcp/127.0.0.1:1", "--listen", "tcp/a..b:0"], 'there is no host "a..b"'),
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
