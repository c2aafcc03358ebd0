"""By what a participant proves who it is: its certificate and private key, and the authority that everybody trusts.

Of a certificate that does not fit Zenoh says no more than that nobody answers. So one's own are looked at here before
the start, in a TLS handshake with oneself; and others' in one with them, once they have been waited for in vain.
"""

from __future__ import annotations

import re
import socket
import ssl
import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from agent.contract.errors import InputError
from agent.contract.keys import in_words

AUTHORITY = "ca.pem"  # the certificate of the authority: the same for everybody, and no secret
AUTHORITY_NAME = (
    "peakmesh keys"  # the common name of one that `peakmesh keys init` makes; its organization: the problem
)
PROBE_SECONDS = 3.0  # for each step of a handshake with somebody else
NO_CHECK_TIME = 0x200000  # of OpenSSL's X509_V_FLAGs; ssl has no name for it


class Shown(NamedTuple):
    """What a certificate says, its times in seconds since 1970."""

    name: str
    issuer: str
    organization: str  # of the issuer
    begins: float
    ends: float


@dataclass(frozen=True)
class Credentials:
    """The files of participant `who` in `folder`."""

    folder: Path
    who: str

    @property
    def authority(self) -> Path:
        return self.folder / AUTHORITY

    @property
    def certificate(self) -> Path:
        return self.folder / f"{self.who}.pem"

    @property
    def private(self) -> Path:
        return self.folder / f"{self.who}.key"

    def check(self, problem: str | None) -> None:
        """Raises InputError, in one sentence, where they are not those of `who` in a run of this problem, today."""
        for path in (self.authority, self.certificate, self.private):
            self._refuse_unreadable(path)
        shown, now = self._shown(), time.time()
        if shown.name != self.who:
            raise InputError(f'{self.certificate} is the certificate of "{shown.name}", not of {in_words(self.who)}')
        if shown.issuer == AUTHORITY_NAME and problem not in (None, shown.organization):
            raise InputError(
                f'the keys in {self.folder} were made for problem "{shown.organization}", not for "{problem}"; '
                "peakmesh keys init makes others"
            )
        if not shown.begins <= now < shown.ends:
            raise InputError(
                f"{self.certificate} is valid from {_date(shown.begins)} to {_date(shown.ends)}, and this machine's "
                f"clock says {_date(now)}; peakmesh keys renew makes a new one"
            )
        try:
            self._handshake_with_oneself(0)
        except ssl.SSLCertVerificationError as error:
            raise InputError(f"{self.authority}: {error.verify_message}") from None

    def _refuse_unreadable(self, path: Path) -> None:
        try:
            path.read_bytes()
        except FileNotFoundError:
            raise InputError(
                f"--keys {self.folder}: there is no {path.name} in it, which {in_words(self.who)} needs; "
                "peakmesh keys init makes it"
            ) from None
        except OSError as error:
            raise InputError(f"{path} could not be read: {error.strerror}") from None

    def _context(self, side: int) -> ssl.SSLContext:
        """With our certificate; trusts the authority alone, whatever the address of who is at the other end."""
        context = ssl.SSLContext(side)
        context.check_hostname = False
        context.verify_mode = ssl.CERT_REQUIRED
        try:
            context.load_verify_locations(self.authority)
        except ssl.SSLError:
            raise InputError(f"{self.authority} is not a certificate in PEM format") from None
        try:
            context.load_cert_chain(self.certificate, self.private, password=lambda: b"")
        except ssl.SSLError as error:
            if error.reason == "KEY_VALUES_MISMATCH":
                raise InputError(f"{self.private} is not the private key of {self.certificate}") from None
            raise InputError(
                f"{self.certificate} and {self.private} are not a certificate and its private key, unencrypted, "
                "in PEM format"
            ) from None
        return context

    def _shown(self) -> Shown:
        """What our certificate says, whenever it is valid. Raises InputError where it is not by the authority."""
        try:
            shown = self._handshake_with_oneself(NO_CHECK_TIME)
        except ssl.SSLCertVerificationError:
            raise InputError(f"{self.certificate} was not issued by the authority of {self.authority}") from None
        of, by = ({name: value for ((name, value),) in shown[part]} for part in ("subject", "issuer"))
        times = (float(ssl.cert_time_to_seconds(shown[when])) for when in ("notBefore", "notAfter"))
        return Shown(of.get("commonName", ""), by.get("commonName", ""), by.get("organizationName", ""), *times)

    def _handshake_with_oneself(self, flags: int) -> Any:
        """What ssl says of our certificate."""
        there, back = ssl.MemoryBIO(), ssl.MemoryBIO()
        contexts = [self._context(side) for side in (ssl.PROTOCOL_TLS_CLIENT, ssl.PROTOCOL_TLS_SERVER)]
        for context in contexts:
            context.verify_flags |= flags
        client, server = contexts[0].wrap_bio(back, there), contexts[1].wrap_bio(there, back, server_side=True)
        for end in (client, server, client, server):  # TLS 1.3: hello, answer, the client's certificate, its check
            with suppress(ssl.SSLWantReadError):
                end.do_handshake()
        return server.getpeercert()

    def why_not(self, address: str) -> str:
        """Why we and who listens at `address` do not understand each other, as a sentence; "" where it is not known."""
        found = re.fullmatch(r"tls/([^:/]+):(\d+)", address)
        if found is None:
            return ""
        try:
            with (
                socket.create_connection((found[1], int(found[2])), PROBE_SECONDS) as plain,
                self._context(ssl.PROTOCOL_TLS_CLIENT).wrap_socket(plain) as link,
            ):
                link.recv(1)  # TLS 1.3: what is wrong with our certificate comes after the handshake
        except ssl.SSLCertVerificationError as error:
            return (
                f"who listens at {address} has no certificate that {self.authority} vouches for: {error.verify_message}"
            )
        except ssl.SSLError as error:
            alert = (error.reason or "").lower().partition("alert_")[2].replace("_", " ")
            return f"who listens at {address} does not accept {self.certificate}: {alert or error}"
        except OSError:
            return ""
        return ""


def _date(seconds: float) -> str:
    return time.strftime("%Y-%m-%d %H:%M", time.gmtime(seconds))
