"""Signatures of published results and of heads of a journal: the signed bytes, and their check."""

from __future__ import annotations

from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey

MANIFEST, HEAD = b"evopolicy manifest 1\0", b"evopolicy head 1\0"
"""Prefixes of the signed bytes: a signature of one kind is not valid for the other."""


def signed_by(key: str, signature: str, digest: str, kind: bytes = MANIFEST) -> bool:
    """Whether the owner of the public `key` signed the `digest`; False for anything malformed."""
    try:
        public = Ed25519PublicKey.from_public_bytes(bytes.fromhex(key))
        public.verify(bytes.fromhex(signature), kind + bytes.fromhex(digest))
    except (InvalidSignature, ValueError):
        return False
    return True
