"""The coordinator's identity: an Ed25519 key that signs published results, and from which runs get their names and
secrets.

It is unrelated to the certificates of `certs`, which machines of one cluster present to each other.
"""

from __future__ import annotations

import hmac
from pathlib import Path

from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from cryptography.hazmat.primitives.serialization import Encoding, PublicFormat

from evopolicy_coordinator.splits import load_or_create_secret
from evopolicy_results.publish.contents import SIGNED_MANIFEST

SIGNING_KEY = "signing-key"
"""File of the state folder: 32 random bytes, mode 0600."""


def public_key(state: Path) -> str:
    """The public key, 64 hex digits. Creates the key on first use. Raises ConfigError as `load_or_create_secret`."""
    return sign(state, "")[0]


def of_run(state: Path, what: str, key: str) -> bytes:
    """32 secret bytes of the run that is opened with a key. A coordinator that is started on a backup derives the same
    ones, so that a run it has lost is opened again as the same run."""
    message = f"evopolicy run|{what}|{key}".encode()
    return hmac.digest(load_or_create_secret(state / SIGNING_KEY), message, "sha256")


def sign(state: Path, digest: str) -> tuple[str, str]:
    """Signs a SHA-256 (hex). Returns the public key (64 hex digits) and the signature (128)."""
    key = Ed25519PrivateKey.from_private_bytes(load_or_create_secret(state / SIGNING_KEY))
    public = key.public_key().public_bytes(Encoding.Raw, PublicFormat.Raw).hex()
    return public, key.sign(SIGNED_MANIFEST + bytes.fromhex(digest)).hex()
