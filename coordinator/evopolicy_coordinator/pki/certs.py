"""X.509 certificates for a cluster: its own authority, the coordinator's certificate, and one for each machine that
joins.

Rules:
- Bytes in, bytes out: no file, no clock. `machines.py` stores the results.
- An identity is a certificate's common name: `coordinator`, or `ROLE/NAME` of a machine. Zenoh's access rules use it.
- Only listeners may present their certificate as a server (the extended key usage), so that a worker or a gateway
  cannot impersonate the coordinator. Clients check a server's names and addresses.
- The authority signs leaves only. It belongs to this cluster alone: none of its names is in any directory.
"""

from __future__ import annotations

import datetime as dt
import ipaddress
import re
from collections.abc import Sequence

import msgspec
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from evopolicy_common.errors import ConfigError

COORDINATOR = "coordinator"
"""The common name of the coordinator's own certificate."""
AUTHORITY_DAYS = 3650
CLOCK_SKEW = dt.timedelta(hours=1)
"""How long before their issue certificates become valid: machines' clocks differ."""
_HOST_NAME = re.compile(r"(?!-)[A-Za-z0-9_-]{1,63}(?<!-)(\.(?!-)[A-Za-z0-9_-]{1,63}(?<!-))*")


class KeyPair(msgspec.Struct, frozen=True):
    """A certificate and its private key, both PEM."""

    certificate: bytes
    private_key: bytes


class CertFields(msgspec.Struct, frozen=True, kw_only=True):
    """The fields of a certificate that we use."""

    serial: str
    """Hexadecimal."""
    expires: dt.datetime
    hosts: tuple[str, ...]
    """DNS names and addresses that clients may dial, as given."""


def make_authority(cluster: str, now: dt.datetime, days: int = AUTHORITY_DAYS) -> KeyPair:
    """Creates an authority. Its name has a random part, so that two authorities of one cluster are never confused."""
    key = ec.generate_private_key(ec.SECP256R1())
    name = _name(f"evopolicy {cluster[:24]} {x509.random_serial_number():x}"[:64])
    certificate = (
        _builder(name, name, key.public_key(), now, days)
        .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        .add_extension(_key_usage(signs_certificates=True), critical=True)
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(key.public_key()), critical=False)
        .sign(key, hashes.SHA256())
    )
    return _pair(certificate, key)


def issue(
    authority: KeyPair,
    common_name: str,
    now: dt.datetime,
    days: int,
    *,
    hosts: Sequence[str] = (),
    serves: bool,
) -> KeyPair:
    """Issues a certificate with a new key, signed by `authority`. `hosts`: DNS names and IP addresses that
    clients dial; required when it `serves`. Raises ConfigError for an invalid name, or a validity beyond the
    authority's own."""
    parent = x509.load_pem_x509_certificate(authority.certificate)
    if now + dt.timedelta(days=days) > parent.not_valid_after_utc:
        raise ConfigError(
            f"{days} days exceed the validity of the authority (until {parent.not_valid_after_utc:%Y-%m-%d});"
            " make a new authority with `certs init --force`"
        )
    if serves and not hosts:
        raise ConfigError(f"{common_name} needs a --host, the name or address that others dial it at")
    signer = serialization.load_pem_private_key(authority.private_key, password=None)
    assert isinstance(signer, ec.EllipticCurvePrivateKey)
    key = ec.generate_private_key(ec.SECP256R1())
    usages = [ExtendedKeyUsageOID.CLIENT_AUTH] + ([ExtendedKeyUsageOID.SERVER_AUTH] if serves else [])
    builder = (
        _builder(_name(common_name), parent.subject, key.public_key(), now, days)
        .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        .add_extension(_key_usage(signs_certificates=False), critical=True)
        .add_extension(x509.ExtendedKeyUsage(usages), critical=False)
        .add_extension(
            x509.AuthorityKeyIdentifier.from_issuer_public_key(signer.public_key()), critical=False
        )
    )
    if hosts:
        names = x509.SubjectAlternativeName([general_name(host) for host in hosts])
        builder = builder.add_extension(names, critical=False)
    return _pair(builder.sign(signer, hashes.SHA256()), key)


def describe(certificate: bytes) -> CertFields:
    """Parses a PEM certificate. Raises ConfigError when it is not one."""
    try:
        parsed = x509.load_pem_x509_certificate(certificate)
        names = parsed.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
        hosts = tuple(str(name.value) for name in names)
    except x509.ExtensionNotFound:
        hosts = ()
    except ValueError as error:
        raise ConfigError(f"not a certificate in PEM form: {error}") from error
    return CertFields(serial=f"{parsed.serial_number:x}", expires=parsed.not_valid_after_utc, hosts=hosts)


def general_name(host: str) -> x509.GeneralName:
    """Raises ConfigError for what is neither a DNS name nor an address."""
    try:
        return x509.IPAddress(ipaddress.ip_address(host.strip("[]")))
    except ValueError:
        pass
    if not _HOST_NAME.fullmatch(host) or len(host) > 253 or re.fullmatch(r"[0-9.]+", host):
        raise ConfigError(f"--host {host!r}: a DNS name or an IP address, without protocol or port")
    return x509.DNSName(host)


def _name(common_name: str) -> x509.Name:
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, common_name)])


def _builder(
    subject: x509.Name, issuer: x509.Name, key: ec.EllipticCurvePublicKey, now: dt.datetime, days: int
) -> x509.CertificateBuilder:
    return (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer)
        .public_key(key)
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - CLOCK_SKEW)
        .not_valid_after(now + dt.timedelta(days=days))
    )


def _key_usage(*, signs_certificates: bool) -> x509.KeyUsage:
    return x509.KeyUsage(
        digital_signature=not signs_certificates,
        content_commitment=False,
        key_encipherment=False,
        data_encipherment=False,
        key_agreement=False,
        key_cert_sign=signs_certificates,
        crl_sign=signs_certificates,
        encipher_only=False,
        decipher_only=False,
    )


def _pair(certificate: x509.Certificate, key: ec.EllipticCurvePrivateKey) -> KeyPair:
    return KeyPair(
        certificate.public_bytes(serialization.Encoding.PEM),
        key.private_bytes(
            serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
        ),
    )
