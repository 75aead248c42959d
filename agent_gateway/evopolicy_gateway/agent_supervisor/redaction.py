"""Takes keys and tokens out of what is logged. A line stays the JSON document that it was.

Known secrets go first: values of variables whose names say so, and the gateway's path token. Then whatever looks like a
key of a common provider.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping

REDACTED = b"[redacted]"
_MIN_SECRET = 8
"""Shorter values are words, and would blank out half a log."""
_SECRET_NAME = re.compile(r"KEY|TOKEN|SECRET|PASSW|CREDENTIAL|AUTH|COOKIE", re.IGNORECASE)
_NO_SECRET_NAME = re.compile(r"SSH_AUTH_SOCK|XAUTHORITY|_FILE$|_PATH$|_SOCK$", re.IGNORECASE)
_TOKEN_IN_URL = re.compile(r"://[^/]+/([0-9A-Za-z_-]{16,})/")
_LOOKS_LIKE = re.compile(
    rb"\b(?:sk|pk|rk)-[A-Za-z0-9_-]{16,}"
    rb"|\bAIza[A-Za-z0-9_-]{30,}"
    rb"|\bgh[pousr]_[A-Za-z0-9]{20,}|\bgithub_pat_[A-Za-z0-9_]{20,}"
    rb"|\bxox[abprs]-[A-Za-z0-9-]{10,}"
    rb"|\bhf_[A-Za-z0-9]{20,}"
    rb"|\bAKIA[A-Z0-9]{16}\b"
    # Its first part is bounded, as a line of nothing but beginnings would take time by its square.
    rb"|\beyJ[A-Za-z0-9_-]{10,1024}\.[A-Za-z0-9_-]{10,}\.[A-Za-z0-9_-]{5,}"
)
_BEARER = re.compile(rb"(\b[Bb]earer\s+)[A-Za-z0-9._~+/=-]{12,}")


class Redaction:
    """What to take out, compiled once."""

    def __init__(self, secrets: Iterable[str] = ()) -> None:
        words = {form for secret in secrets if len(secret) >= _MIN_SECRET for form in _forms(secret)}
        # Longest first, so that a secret that holds another is taken out whole.
        ordered = sorted(words, key=lambda word: (-len(word), word))
        self._known = re.compile(b"|".join(re.escape(word) for word in ordered)) if ordered else None

    @classmethod
    def of(cls, environment: Mapping[str, str], urls: Mapping[str, str]) -> Redaction:
        """For an agent with these variables and URLs."""
        named = [
            value
            for name, value in environment.items()
            if _SECRET_NAME.search(name) and not _NO_SECRET_NAME.search(name)
        ]
        tokens = [found.group(1) for url in urls.values() if (found := _TOKEN_IN_URL.search(url))]
        return cls([*named, *tokens])

    def __call__(self, line: bytes) -> bytes:
        """The line without secrets."""
        if self._known is not None:
            line = self._known.sub(REDACTED, line)
        return _BEARER.sub(rb"\1" + REDACTED, _LOOKS_LIKE.sub(REDACTED, line))

    def text(self, text: str) -> str:
        """The text without secrets."""
        return self(text.encode("utf-8", "backslashreplace")).decode("utf-8", "replace")


def _forms(secret: str) -> set[bytes]:
    """The secret as it is, and as it stands inside a JSON string."""
    escaped = secret.replace("\\", "\\\\").replace('"', '\\"')
    return {secret.encode("utf-8", "surrogateescape"), escaped.encode("utf-8", "surrogateescape")}
