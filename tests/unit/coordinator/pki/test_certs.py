"""Certificates as they are made: who signed them, what they may be shown for, whom they name, how long they live."""

from __future__ import annotations

import datetime as dt

import pytest
from cryptography import x509
from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives import serialization
from cryptography.x509.oid import ExtendedKeyUsageOID
from hypothesis import given
from hypothesis import strategies as st

from evopolicy_common.errors import ConfigError
from evopolicy_coordinator.pki import certs
from evopolicy_coordinator.pki.certs import KeyPair

NOW = dt.datetime(2031, 5, 6, 7, 8, 9, tzinfo=dt.UTC)
AUTHORITY = certs.make_authority("lab", NOW)


def loaded(pair: KeyPair) -> x509.Certificate:
    return x509.load_pem_x509_certificate(pair.certificate)


def test_a_certificate_is_signed_by_its_authority_alone() -> None:
    certificate = loaded(certs.issue(AUTHORITY, "worker/a", NOW, 30, serves=False))
    certificate.verify_directly_issued_by(loaded(AUTHORITY))
    other = certs.make_authority("lab", NOW)
    with pytest.raises((ValueError, InvalidSignature)):
        certificate.verify_directly_issued_by(loaded(other))


def test_two_authorities_of_one_cluster_have_different_names() -> None:
    assert loaded(AUTHORITY).subject != loaded(certs.make_authority("lab", NOW)).subject
    assert loaded(certs.make_authority("x" * 63, NOW)).subject


def test_the_private_key_is_the_certificates() -> None:
    for pair in (AUTHORITY, certs.issue(AUTHORITY, "worker/a", NOW, 30, serves=False)):
        key = serialization.load_pem_private_key(pair.private_key, password=None)
        assert key.public_key() == loaded(pair).public_key()


@pytest.mark.parametrize("serves", [True, False])
def test_only_who_listens_may_show_its_certificate_as_a_server(serves: bool) -> None:
    pair = certs.issue(AUTHORITY, "a", NOW, 30, hosts=("lab",), serves=serves)
    usages = loaded(pair).extensions.get_extension_for_class(x509.ExtendedKeyUsage).value
    assert ExtendedKeyUsageOID.CLIENT_AUTH in usages
    assert (ExtendedKeyUsageOID.SERVER_AUTH in usages) == serves


def test_a_machines_certificate_signs_nothing() -> None:
    certificate = loaded(certs.issue(AUTHORITY, "worker/a", NOW, 30, serves=False))
    assert not certificate.extensions.get_extension_for_class(x509.BasicConstraints).value.ca
    assert not certificate.extensions.get_extension_for_class(x509.KeyUsage).value.key_cert_sign
    constraints = loaded(AUTHORITY).extensions.get_extension_for_class(x509.BasicConstraints).value
    assert constraints.ca
    assert constraints.path_length == 0


@given(
    hosts=st.lists(
        st.ip_addresses().map(str)
        | st.from_regex(r"\A[a-z][a-z0-9]{0,20}(\.[a-z][a-z0-9-]{0,20}[a-z0-9]){0,3}\Z"),
        min_size=1,
        max_size=4,
        unique=True,
    ),
    days=st.integers(1, 3000),
)
def test_a_certificate_says_what_it_was_made_for(hosts: list[str], days: int) -> None:
    pair = certs.issue(AUTHORITY, "router/x", NOW, days, hosts=hosts, serves=True)
    description = certs.describe(pair.certificate)
    assert loaded(pair).subject.rfc4514_string() == "CN=router/x"
    assert description.hosts == tuple(hosts)
    assert description.expires == NOW + dt.timedelta(days=days)


def test_serials_differ() -> None:
    serials = {
        certs.describe(certs.issue(AUTHORITY, "a", NOW, 1, serves=False).certificate).serial
        for _ in range(20)
    }
    assert len(serials) == 20


def test_clocks_may_differ_a_little() -> None:
    certificate = loaded(certs.issue(AUTHORITY, "a", NOW, 1, serves=False))
    assert certificate.not_valid_before_utc == NOW - certs.CLOCK_SKEW


@pytest.mark.parametrize(
    "host", ["", "tls/lab:7447", "lab:7447", "a b", "-lab", "lab-", "*.lab", "x" * 64, "999.1.1.1", "a..b"]
)
def test_a_host_that_is_none_is_reported(host: str) -> None:
    with pytest.raises(ConfigError, match="--host"):
        certs.issue(AUTHORITY, "a", NOW, 1, hosts=(host,), serves=True)


def test_who_listens_needs_a_host() -> None:
    with pytest.raises(ConfigError, match="needs a --host"):
        certs.issue(AUTHORITY, "router/a", NOW, 1, serves=True)


def test_a_certificate_does_not_outlive_its_authority() -> None:
    with pytest.raises(ConfigError, match="exceed the validity of the authority"):
        certs.issue(AUTHORITY, "a", NOW, certs.AUTHORITY_DAYS + 1, serves=False)


def test_what_is_no_certificate_is_reported() -> None:
    with pytest.raises(ConfigError, match="not a certificate"):
        certs.describe(b"hello")
