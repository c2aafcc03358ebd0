"""The authority of a network's keys: makes certificates, renews them, says what is there. Alone imports cryptography.

A folder has the authority's certificate `ca.pem` and private key `ca.key`, and for everybody a certificate `<who>.pem`
and a private key `<who>.key`; for a sensor both again in `<who>.json5`, as a configuration of Zenoh. The authority's
private key makes certificates; nobody needs it to take part.
"""

from __future__ import annotations

import json
import os
from base64 import b64encode
from collections.abc import Iterable
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import NamedTuple

from cryptography import x509
from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from agent.contract.errors import InputError
from agent.contract.files import read_bytes
from agent.contract.keys import sensor_who
from agent.network.credentials import AUTHORITY, AUTHORITY_NAME

PEM = serialization.Encoding.PEM
AUTHORITY_KEY = "ca.key"
LONGEST_NAME = 64  # characters, of a common name in X.509
EARLIER = timedelta(days=1)  # certificates begin so long ago: clocks differ


class Certificate(NamedTuple):
    """One that is there."""

    who: str
    begins: datetime
    ends: datetime
    fingerprint: str  # SHA-256, hexadecimal
    faults: list[str]  # what is wrong with it, in words


class Authority:
    """Whose certificate and private key are in `folder`."""

    def __init__(self, folder: Path, certificate: x509.Certificate, private: ec.EllipticCurvePrivateKey) -> None:
        self._folder, self._certificate, self._private = folder, certificate, private

    @classmethod
    def create(cls, folder: Path, problem: str, *, days: int) -> Authority:
        """A new one, in a folder that is there and empty."""
        private = ec.generate_private_key(ec.SECP256R1())
        name = _name(AUTHORITY_NAME, problem)
        usage = _usage(key_cert_sign=True, crl_sign=True)
        certificate = (
            _builder(name, private, issuer=name, days=days)
            .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
            .add_extension(usage, critical=True)
            .add_extension(x509.SubjectKeyIdentifier.from_public_key(private.public_key()), critical=False)
            .sign(private, hashes.SHA256())
        )
        _write(folder, AUTHORITY.removesuffix(".pem"), certificate, private)
        return cls(folder, certificate, private)

    @classmethod
    def load(cls, folder: Path) -> Authority:
        """Raises InputError where it is not there."""
        certificate = _read(folder / AUTHORITY)
        data = read_bytes(folder / AUTHORITY_KEY, kind="private key of the authority")
        try:
            private = serialization.load_pem_private_key(data, None)
        except (ValueError, TypeError) as error:
            raise InputError(f"{folder / AUTHORITY_KEY} is not an unencrypted private key: {error}") from None
        if not isinstance(private, ec.EllipticCurvePrivateKey) or private.public_key() != certificate.public_key():
            raise InputError(f"{folder / AUTHORITY_KEY} is not the private key of {folder / AUTHORITY}")
        return cls(folder, certificate, private)

    def issue(self, whos: Iterable[str], *, days: int) -> None:
        """New private keys and certificates in these names, in the place of those that are there."""
        whose = x509.AuthorityKeyIdentifier.from_issuer_public_key(self._private.public_key())
        for who in whos:
            private = ec.generate_private_key(ec.SECP256R1())
            purposes = [ExtendedKeyUsageOID.SERVER_AUTH, ExtendedKeyUsageOID.CLIENT_AUTH]  # every peer is both
            certificate = (
                _builder(_name(who), private, issuer=self._certificate.subject, days=days)
                .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
                .add_extension(_usage(digital_signature=True), critical=True)
                .add_extension(x509.ExtendedKeyUsage(purposes), critical=False)
                .add_extension(whose, critical=False)
                .sign(self._private, hashes.SHA256())
            )
            pair = _write(self._folder, who, certificate, private)
            if who.startswith(sensor_who("")):
                _write_whole(self._folder / f"{who}.json5", _zenoh(self._certificate, *pair), 0o600)


def _zenoh(authority: x509.Certificate, certificate: bytes, private: bytes) -> bytes:
    """A file for zenoh.Config.from_file, for programs that are not of peakmesh: all that they need."""
    tls = {
        "root_ca_certificate_base64": b64encode(authority.public_bytes(PEM)).decode(),
        "connect_certificate_base64": b64encode(certificate).decode(),
        "connect_private_key_base64": b64encode(private).decode(),
        "enable_mtls": True,
        "verify_name_on_connect": False,
    }
    return json.dumps({"transport": {"link": {"tls": tls}}}, indent=1).encode()


def certificates(folder: Path) -> list[Certificate]:
    """Everybody's in a folder, the authority's first. Raises InputError where there is none."""
    authority = _read(folder / AUTHORITY)
    others = sorted(path for path in folder.glob("*.pem") if path.name != AUTHORITY)
    return [_described("ca", authority, authority), *(_described(path.stem, _read(path), authority) for path in others)]


def _described(who: str, certificate: x509.Certificate, authority: x509.Certificate) -> Certificate:
    begins, ends = certificate.not_valid_before_utc, certificate.not_valid_after_utc
    faults, now = list[str](), datetime.now(UTC)
    names = [str(name.value) for name in certificate.subject.get_attributes_for_oid(NameOID.COMMON_NAME)]
    if who != "ca" and names != [who]:
        faults.append(f'in the name of "{"".join(names)}"')
    if not begins <= now < ends:
        faults.append("expired" if now >= ends else "not yet valid")
    try:
        certificate.verify_directly_issued_by(authority)
    except (ValueError, TypeError, InvalidSignature):  # another name, another kind of key, another key
        faults.append(f"not by {AUTHORITY}")
    return Certificate(who, begins, ends, certificate.fingerprint(hashes.SHA256()).hex(), faults)


def _read(path: Path) -> x509.Certificate:
    data = read_bytes(path, kind="certificate")
    try:
        return x509.load_pem_x509_certificate(data)
    except ValueError:
        raise InputError(f"{path} is not a certificate in PEM format") from None


def _name(common: str, organization: str = "") -> x509.Name:
    for text in (common, organization):
        if len(text) > LONGEST_NAME:
            raise InputError(
                f'"{text}" is too long for a certificate, in which a name has at most {LONGEST_NAME} letters'
            )
    parts = [x509.NameAttribute(NameOID.COMMON_NAME, common)]
    return x509.Name([*parts, *([x509.NameAttribute(NameOID.ORGANIZATION_NAME, organization)] if organization else [])])


def _usage(*, digital_signature: bool = False, key_cert_sign: bool = False, crl_sign: bool = False) -> x509.KeyUsage:
    return x509.KeyUsage(
        digital_signature=digital_signature,
        key_cert_sign=key_cert_sign,
        crl_sign=crl_sign,
        content_commitment=False,
        key_encipherment=False,
        data_encipherment=False,
        key_agreement=False,
        encipher_only=False,
        decipher_only=False,
    )


def _builder(
    subject: x509.Name, private: ec.EllipticCurvePrivateKey, *, issuer: x509.Name, days: int
) -> x509.CertificateBuilder:
    now = datetime.now(UTC)
    return (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer)
        .public_key(private.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - EARLIER)
        .not_valid_after(now + timedelta(days=days))
    )


def _write(
    folder: Path, who: str, certificate: x509.Certificate, private: ec.EllipticCurvePrivateKey
) -> tuple[bytes, bytes]:
    """Write certificate and private key as PEM, and return them."""
    shown = certificate.public_bytes(PEM)
    secret = private.private_bytes(PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption())
    _write_whole(folder / f"{who}.key", secret, 0o600)
    _write_whole(folder / f"{who}.pem", shown, 0o644)
    return shown, secret


def _write_whole(path: Path, data: bytes, mode: int) -> None:
    """With this mode from the beginning, in the place of what is there."""
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    with open(os.open(part, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode), "wb") as file:
        file.write(data)
    part.replace(path)
