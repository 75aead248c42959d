"""Keys and tokens: their looks, their removal from texts and command lines, and the values that a run has passed on.

One table (`PATTERNS`) serves agents' logs, `run.json`, published results, and exports. Values without a known look are
found by keyed digests in the private file `PASSED` of the run's folder, which is never published.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import os
import re
import shlex
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any

import msgspec
from msgspec import Meta

from evopolicy_common.errors import DECODE_ERRORS, ConfigError
from evopolicy_common.records.blobs import write_atomically
from evopolicy_common.regular_files import read_regular

REDACTED = b"[redacted]"
_REDACTED = REDACTED.decode()
PASSED = ".passed.json"
"""In a run's folder, mode 0600: `Passed`."""
PASSED_VALUE = "a value that the run passed to its agent"
MIN_PASSED = 12
"""Characters of the shortest value that is recorded: a shorter one could be guessed from its digest."""
_MAX_PASSED = 1024
_MAX_FILE_BYTES = 1 << 20
_MIN_SECRET = 8
"""Minimal length of a known secret; shorter values are words, and would remove half of a log."""
_ESCAPE = re.compile(rb"\\{1,8}(?:u([0-9a-fA-F]{4})|/)")
_SECRET_NAME = re.compile(r"KEY|TOKEN|SECRET|PASSW|CREDENTIAL|AUTH|COOKIE", re.IGNORECASE)
_NO_SECRET_NAME = re.compile(r"SSH_AUTH_SOCK|XAUTHORITY|_FILE$|_PATH$|_SOCK$", re.IGNORECASE)
_TOKEN_IN_URL = re.compile(r"://[^/]+/([0-9A-Za-z_-]{16,})/")
_KEY_OPTION = re.compile(
    r"-k|(?:--?)?(?:[\w.-]*[_.-])?(?:\w*(?:api|access|auth|secret))?"
    r"(?:key|token|secret|passw(?:or)?d|passphrase|credentials?|auth|cookie|pat)",
    re.IGNORECASE,
)
"""An option or variable with a secret value: `--api-key`, `HF_TOKEN`; not `--max-tokens`, `--monkey`."""
# In a JSON line, the letter before a key may be that of an escape. Repetitions are bounded where a match may fail after
# them: otherwise a line of many beginnings would take quadratic time.
_START = rb"(?:\b|(?<=\\[nrtbf]))"
PATTERNS: tuple[tuple[re.Pattern[bytes], str, tuple[bytes, ...]], ...] = (
    (
        re.compile(
            rb"-----BEGIN [A-Z0-9 ]{0,40}PRIVATE KEY(?: BLOCK)?-----(?:[A-Za-z0-9+/=\s]|\\[nrt])*"
            rb"(?:-----END [A-Z0-9 ]{0,40}PRIVATE KEY(?: BLOCK)?-----)?"
        ),
        "a private key",
        (b"PRIVATE KEY",),
    ),
    (
        re.compile(
            _START + rb"(?:(?:sk|pk|rk)-[A-Za-z0-9_-]{16,}"
            rb"|(?:sk|pk|rk)_(?:live|test)_[A-Za-z0-9]{16,}"
            rb"|AIza[A-Za-z0-9_-]{30,}"
            rb"|gh[pousr]_[A-Za-z0-9]{20,}|github_pat_[A-Za-z0-9_]{20,}|glpat-[A-Za-z0-9_-]{20,}"
            rb"|xox[abeprs]-[A-Za-z0-9-]{10,}"
            rb"|hf_[A-Za-z0-9]{20,}"
            rb"|A[KS]IA[A-Z0-9]{16}\b)"
        ),
        "an API key",
        tuple(
            b"sk- pk- rk- _live_ _test_ AIza AKIA ASIA hf_ xox glpat- ghp_ gho_ ghu_ ghs_ ghr_ github_pat_".split()
        ),
    ),
    (
        re.compile(_START + rb"eyJ[A-Za-z0-9_-]{10,1024}\.[A-Za-z0-9_-]{10,2048}\.[A-Za-z0-9_-]{5,}"),
        "a JSON web token",
        (b"eyJ",),
    ),
    (re.compile(rb"(?<=[Bb]earer\s)\s{0,8}[A-Za-z0-9._~+/=-]{12,}"), "a bearer token", (b"earer",)),
)
"""Looks of secrets, each with its kind, and with texts of which each match holds one."""


def patterns(data: bytes) -> Iterator[tuple[re.Pattern[bytes], str]]:
    """The patterns that may match in `data`, each with its kind."""
    return ((pattern, what) for pattern, what, parts in PATTERNS if any(part in data for part in parts))


def positions(data: bytes, passed: Passed | None = None) -> Iterator[tuple[int, str]]:
    """Positions and kinds of secrets: of what looks like one, and of the values that a run has passed. A text
    without a digit is none, nor one of few characters, such as `sk-xxxxxxxxxxxxxxxx1`."""
    for pattern, what in patterns(data):
        for match in pattern.finditer(data):
            text = match[0]
            if text.startswith(b"-----") or (any(48 <= each < 58 for each in text) and len(set(text)) > 5):
                yield match.start(), what
    if passed is not None:
        for begin, _ in passed.places(data):
            yield begin, PASSED_VALUE


def redacted(data: bytes, passed: Passed | None = None) -> bytes:
    """The data without what looks like a secret, and without the values that a run has passed. JSON stays JSON."""
    data, _ = replaced(data, passed.places(data) if passed is not None else (), REDACTED)
    for pattern, _ in patterns(data):
        data = pattern.sub(REDACTED, data)
    return data


def replaced(data: bytes, places: Iterable[tuple[int, int]], by: bytes) -> tuple[bytes, int]:
    """The data with `by` at these places, of which overlapping ones count as one, and their number."""
    parts: list[bytes] = []
    last = 0
    for begin, end in sorted(places):
        if begin >= last:
            parts += (data[last:begin], by)
        last = max(last, end)
    return b"".join([*parts, data[last:]]), len(parts) // 2


class Redaction:
    """The secrets to remove, compiled once."""

    def __init__(self, secrets: Iterable[str] = ()) -> None:
        self.secrets = tuple(secrets)
        words = {form for secret in self.secrets if len(secret) >= _MIN_SECRET for form in _forms(secret)}
        # Longest first, so that a secret that contains another one is removed as a whole.
        ordered = sorted(words, key=lambda word: (-len(word), word))
        self._known = re.compile(b"|".join(re.escape(word) for word in ordered)) if ordered else None

    @classmethod
    def of(cls, environment: Mapping[str, str], urls: Mapping[str, str]) -> Redaction:
        named = [value for name, value in environment.items() if is_secret(name)]
        tokens = [token.group(1) for url in urls.values() if (token := _TOKEN_IN_URL.search(url))]
        return cls([*named, *tokens])

    def knowing(self, secrets: Iterable[str]) -> Redaction:
        return Redaction((*self.secrets, *secrets))

    def __call__(self, line: bytes) -> bytes:
        """Returns the line without secrets. A JSON line stays valid JSON."""
        return redacted(self.without_known(line))

    def without_known(self, line: bytes) -> bytes:
        """Returns the line without the known secrets, also where JSON spells some of their characters as `\\u002d`."""
        if self._known is None:
            return line
        line = self._known.sub(REDACTED, line)
        # The search for spellings is slow, and a line that has one is rare.
        return self._escaped.sub(REDACTED, line) if self._known.search(_unescaped(line)) else line

    @functools.cached_property
    def _escaped(self) -> re.Pattern[bytes]:
        known = sorted(self.secrets, key=len, reverse=True)
        spelt = [b"".join(map(_spelt, secret)) for secret in known if len(secret) >= _MIN_SECRET]
        return re.compile(b"|".join(spelt))

    def text(self, text: str) -> str:
        return self(text.encode("utf-8", "backslashreplace")).decode("utf-8", "replace")


def is_secret(name: str) -> bool:
    """Whether a variable or field of this name may hold a secret."""
    return bool(_SECRET_NAME.search(name)) and not _NO_SECRET_NAME.search(name)


def without_keys(value: object, removed: list[str] | None = None) -> Any:
    """A document without keys in its texts, command lines and lists of words; `removed` collects them."""
    removed = [] if removed is None else removed
    if isinstance(value, str):
        return _line(value, removed)
    if isinstance(value, dict):
        shown = {}
        for name, each in value.items():
            # Other settings of such names, such as `auth`, only name a variable or a method.
            if isinstance(each, str) and each and name.isupper() and _KEY_OPTION.fullmatch(name):
                removed.append(each)
                shown[name] = _REDACTED
            else:
                shown[name] = without_keys(each, removed)
        return shown
    if isinstance(value, list | tuple):
        if all(isinstance(each, str) for each in value):
            return _words(value, removed)
        return [without_keys(each, removed) for each in value]
    return value


def _line(text: str, removed: list[str]) -> str:
    """A command line, as it was written if it holds no key."""
    words: list[str] = []
    with contextlib.suppress(ValueError):  # quotes that do not match
        words = shlex.split(text)
    n = len(removed)
    shown = _words(words, removed) if len(words) > 1 else []
    if len(removed) > n:
        return " ".join(word if _REDACTED in word else shlex.quote(word) for word in shown)
    data = text.encode("utf-8", "surrogateescape")
    for pattern, _ in patterns(data):
        removed += [match[0].decode("utf-8", "surrogateescape") for match in pattern.finditer(data)]
        data = pattern.sub(REDACTED, data)
    return data.decode("utf-8", "surrogateescape")


def _words(words: Iterable[str], removed: list[str]) -> list[str]:
    shown: list[str] = []
    is_value = False
    for word in words:
        name, equals, value = word.partition("=")
        is_key = _KEY_OPTION.fullmatch(name) is not None
        if is_value and not word.startswith("--"):
            removed.append(word)
            shown.append(_REDACTED)
            is_value = False
        elif is_key and value:
            removed.append(value)
            shown.append(f"{name}={_REDACTED}")
            is_value = False
        else:
            is_value = is_key and not equals and word.startswith("-")
            shown.append(_line(word, removed))
    return shown


class PassedValue(msgspec.Struct, frozen=True, kw_only=True):
    """One spelling of a value: how long it is, and its digest."""

    length: int
    """Bytes."""
    mark: Annotated[int, Meta(ge=0, le=255)]
    """One byte, which tells quickly where the value cannot be."""
    digest: str


class Passed(msgspec.Struct, frozen=True, kw_only=True):
    """Values that a run has passed to its agent, by keyed digests."""

    key: Annotated[str, Meta(pattern="^[0-9a-f]{64}$")]
    """32 random bytes, hex."""
    values: Annotated[tuple[PassedValue, ...], Meta(max_length=_MAX_PASSED)] = ()

    def with_values(self, values: Iterable[str]) -> Passed:
        """These too, as far as they are long enough."""
        key, weights = bytes.fromhex(self.key), self._weights()
        forms = {form for each in values if len(each) >= MIN_PASSED for form in _forms(each)}
        known = dict.fromkeys(self.values)
        for form in sorted(forms):
            mark = sum(weights[each] for each in form) % 256
            known[PassedValue(length=len(form), mark=mark, digest=_digest(form, key))] = None
        return Passed(key=self.key, values=tuple(known)[:_MAX_PASSED])

    def places(self, data: bytes) -> Iterator[tuple[int, int]]:
        """Begin and end of each value in `data`. Takes time linear in its size, for each length of a value."""
        # Here, as an agent's supervisor needs none of it.
        import numpy as np

        key = bytes.fromhex(self.key)
        weights = np.frombuffer(self._weights(), np.uint8)
        # A window's mark is the sum of its bytes' weights, a difference of two of these. One in 256 has that of a
        # value.
        sums = np.zeros(len(data) + 1, np.uint8)
        np.cumsum(weights[np.frombuffer(data, np.uint8)], dtype=np.uint8, out=sums[1:])
        for length in sorted({each.length for each in self.values}):
            if not 0 < length <= len(data):
                continue
            same = [each for each in self.values if each.length == length]
            digests = {each.digest for each in same}
            marked = np.zeros(256, np.bool_)
            marked[[each.mark for each in same]] = True
            for at in np.flatnonzero(marked[sums[length:] - sums[:-length]]).tolist():
                if _digest(data[at : at + length], key) in digests:
                    yield at, at + length

    def _weights(self) -> bytes:
        return hashlib.shake_256(bytes.fromhex(self.key)).digest(256)


def note_passed(path: Path, values: Iterable[str]) -> None:
    """Adds the values to the file at `path`, which is made with the first that is long enough. Raises StorageError."""
    kept = read_passed(path.parent) or Passed(key=os.urandom(32).hex())
    more = kept.with_values(values)
    if more.values != kept.values:
        write_atomically(path, msgspec.json.encode(more), mode=0o600)


def read_passed(folder: Path) -> Passed | None:
    """Values that a run's folder records; None without the file. Raises ConfigError for a damaged one."""
    path = folder / PASSED
    try:
        return msgspec.json.decode(read_regular(path, _MAX_FILE_BYTES), type=Passed)
    except FileNotFoundError:
        return None
    except (OSError, *DECODE_ERRORS) as error:
        raise ConfigError(f"{path}: {error}; restore it, as it finds keys in what is published") from error


def _digest(value: bytes, key: bytes) -> str:
    return hashlib.blake2b(value, key=key, digest_size=16).hexdigest()


def _unescaped(line: bytes) -> bytes:
    """The line with the characters that JSON's escapes stand for."""
    if b"\\u" not in line and b"\\/" not in line:
        return b""
    return _ESCAPE.sub(
        lambda match: chr(int(match[1], 16)).encode("utf-8", "surrogatepass") if match[1] else b"/", line
    )


def _spelt(character: str) -> bytes:
    """A pattern of the character as any JSON writer may spell it, also within a JSON text of a JSON text."""
    units = character.encode("utf-16-be", "surrogatepass").hex()
    escape = b"".join(rb"\\{1,8}u(?i:" + units[at : at + 4].encode() + b")" for at in range(0, len(units), 4))
    plain = re.escape(character.encode("utf-8", "surrogateescape"))
    return b"(?:" + (rb"\\{0,8}" if character in '"/\\' else b"") + plain + b"|" + escape + b")"


def _forms(secret: str) -> set[bytes]:
    """The secret's bytes, plain and as JSON spells it."""
    quoted = secret.replace("\\", "\\\\").replace('"', '\\"')
    spelt = {secret, quoted, quoted.replace("\n", "\\n").replace("\t", "\\t").replace("\r", "\\r")}
    return {each.encode("utf-8", "surrogateescape") for each in spelt}
