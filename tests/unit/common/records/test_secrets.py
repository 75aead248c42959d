"""Looks of keys, command lines without them, and values that a run passed, found by digest.

Attacks, each with its defence:
- keys on an agent's command line in `run.json`, logs, and the coordinator's state: replaced where they are
  recorded; the agent gets them.
"""

from __future__ import annotations

import base64
import hashlib
import json
import os
import shlex
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from evopolicy_common.errors import ConfigError
from evopolicy_common.records import secrets
from evopolicy_common.records.secrets import PASSED, Passed, note_passed, read_passed, without_keys

BODY = "a1B2c3D4" * 5
PEM = f"-----BEGIN OPENSSH PRIVATE KEY-----\n{BODY}\n{BODY}==\n-----END OPENSSH PRIVATE KEY-----"
LOOKS = [
    *(f"sk-{BODY}", f"sk-ant-api03-{BODY}", f"sk-proj-{BODY}", f"rk-{BODY}", f"pk-{BODY}"),
    *(f"sk_live_{BODY}", f"AIza{BODY[:35]}", f"hf_{BODY[:34]}", f"github_pat_11AB_{BODY}"),
    *(f"{kind}_{BODY[:36]}" for kind in ("ghp", "gho", "ghu", "ghs", "ghr")),
    *(f"glpat-{BODY[:20]}", "xoxb-1234567890-abcdefghij", "AKIAIOSFODNN7EXAMPLE", "ASIAIOSFODNN7EXAMPLE"),
    *(f"eyJhbGciOiJIUzI1NiJ9.{BODY}.{BODY[:20]}", PEM),
]
ROOT = Path(__file__).parents[4]


@pytest.mark.parametrize("secret", LOOKS)
def test_each_look_of_a_key_is_found_and_removed_also_in_json(secret: str) -> None:
    for text in (f"x = '{secret}'", f"{secret}\n", json.dumps({"text": f"a\n{secret}\tb"})):
        data = text.encode()
        assert len(list(secrets.positions(data))) == 1, text
        assert BODY.encode()[:8] not in secrets.redacted(data)
        assert list(secrets.positions(secrets.redacted(data))) == []
    json.loads(secrets.redacted(json.dumps({"text": f'a\n{secret}\\ "{secret}"'}).encode()))


def test_a_bearer_token_is_found_and_its_header_stays() -> None:
    assert secrets.redacted(f"Authorization: Bearer  {BODY}".encode()) == b"Authorization: Bearer [redacted]"
    assert list(secrets.positions(b"the bearer of responsibilities")) == []


def test_policies_with_hashes_and_arrays_in_base64_hold_no_secret() -> None:
    rng = np.random.default_rng(0)
    weights = rng.standard_normal((64, 64)).astype(np.float32).tobytes()
    lines = [base64.b64encode(weights), base64.b85encode(weights), weights.hex().encode(), weights]
    lines += [hashlib.sha256(bytes([n])).hexdigest().encode() for n in range(256)]
    lines += [
        b"task-list, mask-rcnn, risk-averse-policy-with-7-steps, sk-xxxxxxxxxxxxxxxxxxxx1, pk-of-the-table"
    ]
    assert list(secrets.positions(b"\n".join(lines))) == []


def test_examples_and_tests_of_this_project_hold_no_secret_by_mistake() -> None:
    files = [path for path in (ROOT / "examples").rglob("*") if path.is_file()]
    files += (ROOT / "tests" / "conformance" / "hostile" / "policies").glob("*.py")
    assert len(files) > 40
    assert [path for path in files if list(secrets.positions(path.read_bytes()))] == []


@pytest.mark.parametrize(
    ("words", "kept"),
    [
        (["p", "--api-key", "hunter2", "x"], ["p", "--api-key", "[redacted]", "x"]),
        (["p", "--api-key=hunter2"], ["p", "--api-key=[redacted]"]),
        (["p", "-k", "hunter2"], ["p", "-k", "[redacted]"]),
        (["p", "--token", "-hunter2"], ["p", "--token", "[redacted]"]),
        (["env", "HF_TOKEN=hunter2", "p"], ["env", "HF_TOKEN=[redacted]", "p"]),
        (["p", "--apikey", "hunter2"], ["p", "--apikey", "[redacted]"]),
        (["p", "--openai-api-key", "hunter2"], ["p", "--openai-api-key", "[redacted]"]),
        (["p", "--password=my long hunter2"], ["p", "--password=[redacted]"]),
        (["p", f"-H=Bearer {BODY}"], ["p", "-H=Bearer [redacted]"]),
        (["p", LOOKS[0]], ["p", "[redacted]"]),
        (
            ["sh", "-c", "exec p --key 'hun ter2' && TOKEN=hunter2 q"],
            ["sh", "-c", "exec p --key [redacted] '&&' TOKEN=[redacted] q"],
        ),
        *(
            (words, words)
            for words in (["p", "--max-tokens", "4", "--monkey", "b", "KEY"], ["p", "--key", "--v"])
        ),
    ],
)
def test_a_command_line_is_recorded_without_keys(words: list[str], kept: list[str]) -> None:
    removed: list[str] = []
    assert without_keys(words, removed) == kept
    assert bool(removed) == (words != kept)
    assert without_keys(kept) == kept
    text = "command:" + shlex.join(words)
    shown = without_keys(text)
    assert "hunter2" not in shown
    assert BODY not in shown
    assert (shown == text) == (words == kept)


def test_settings_keep_names_of_variables_and_methods() -> None:
    settings = {
        "acp": {"auth": "oauth-personal"},
        "api": {"key": "OPENAI_API_KEY"},
        "pass_environment": ["OPENAI_API_KEY", "HF_TOKEN"],
        "max_tokens": 7,
        "tokens": None,
    }
    secret, without = ({"MODE": "fast", "PROXY_TOKEN": word} for word in ("hunter2", "[redacted]"))
    assert without_keys({**settings, "environment": secret}) == {**settings, "environment": without}


printable = st.text(st.characters(min_codepoint=32, max_codepoint=126), min_size=12, max_size=60)


@given(value=printable, before=st.text(max_size=40), after=st.text(max_size=40))
def test_a_passed_value_is_found_wherever_it_stands(value: str, before: str, after: str) -> None:
    passed = Passed(key="00" * 32).with_values([value])
    plain = f"{before}{value}{after}".encode()
    assert (len(before.encode()), len(f"{before}{value}".encode())) in set(passed.places(plain))
    document = json.loads(secrets.redacted(json.dumps([f"{before} {value} {after}"]).encode(), passed))
    assert value not in document[0]


def test_the_file_of_passed_values_is_private_and_holds_none_of_them(tmp_path: Path) -> None:
    path = tmp_path / PASSED
    note_passed(path, ["", "short"])
    assert not path.exists()
    assert read_passed(tmp_path) is None
    note_passed(path, ["correct horse battery", "too short", "", 'line\nof "two" lines'])
    first = read_passed(tmp_path)
    note_passed(path, ["another value of a later start"])
    again = read_passed(tmp_path)
    assert first is not None
    assert again is not None
    assert path.stat().st_mode & 0o777 == 0o600
    assert set(first.values) < set(again.values)
    assert b"horse" not in path.read_bytes()
    assert list(again.places(b"too short")) == []
    for text in ("correct horse battery", "another value of a later start"):
        assert list(again.places(f"x{text}y".encode())) == [(1, 1 + len(text))]
    assert list(again.places(json.dumps('line\nof "two" lines').encode()))
    note_passed(tmp_path / PASSED, [str(n) * 20 for n in range(5000)])
    assert path.stat().st_size < 1 << 20


@pytest.mark.parametrize(
    "text",
    ["{}", "", '{"key": "00"}', '{"key": "%s", "values": [{"length": 1, "mark": 256, "digest": ""}]}', None],
)
def test_a_damaged_file_of_passed_values_is_refused_by_name(tmp_path: Path, text: str | None) -> None:
    if text is None:
        os.mkfifo(tmp_path / PASSED)
    else:
        (tmp_path / PASSED).write_text(text.replace("%s", "00" * 32))
    with pytest.raises(ConfigError, match=r"passed\.json"):
        read_passed(tmp_path)


@pytest.mark.parametrize(
    "piece", [b"a", b"sk-", b"eyJ", b"-----BEGIN PRIVATE KEY-----", b"Bearer ", b"\\n", b"gh"]
)
def test_searching_takes_time_linear_in_the_size_of_a_file(piece: bytes) -> None:
    size = 1 << 20
    passed = Passed(key=os.urandom(32).hex()).with_values(["a" * 40, "b" * 41, "sk-" * 20])
    data = (piece * (size // len(piece) + 1))[:size]
    list(secrets.positions(data, passed))
    secrets.redacted(data)
