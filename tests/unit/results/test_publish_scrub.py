"""Terms of the publishing machine are matched wherever they stand; names that identify nobody are not.

Attacks, each with its defence:
- secrets in an agent's log that is published with `--with-logs`: replaced, and searched for again.
- secrets, paths, and names of the publishing machine in what is published: removed, and searched for.
"""

from __future__ import annotations

import json

import pytest

from evopolicy_common.records.secrets import Passed
from evopolicy_results.publish import scrub

VARIABLES = {
    "HOME": "/home/marie",
    "PATH": "/usr/local/bin:/usr/bin:/srv/marie/tools",
    "API_KEY": "k-0123456789",
    "LANG": "en_US.UTF-8",
    "SHORT": "yes",
    "PWD": "/data/lab7/work",
}


def needles() -> tuple[scrub.Needle, ...]:
    names = {"marie": "the user's name", "gpu-lab7": "the host's name", "root": "the user's name"}
    return scrub.needles(VARIABLES, names, ["/data/lab7/work"], ["tok3n-of-the-operator"])


@pytest.mark.parametrize(
    ("text", "what"),
    [
        ("# written by marie", "the user's name"),
        ("on gpu-lab7:", "the host's name"),
        ("open('/data/lab7/work/x')", "a folder"),
        ("token tok3n-of-the-operator", "a token"),
        ("key = 'k-0123456789'", "variable API_KEY"),
        ("/srv/marie/tools/run", "variable PATH"),
        ("/home/jean/policy.py", "a home folder"),
    ],
)
def test_terms_of_a_machine_are_matched(text: str, what: str) -> None:
    data = b"\x93\x00" + text.encode() + b"\xff"
    assert any(what in kind for kind in scrub.search(data, needles()))


@pytest.mark.parametrize(
    "text",
    ["summaries of rootless trees", "#!/usr/bin/env python3", "yes, en_US.UTF-8", "roots = np.roots(x)"],
)
def test_names_that_identify_nobody_are_not_matched(text: str) -> None:
    assert scrub.search(text.encode(), needles()) == []


def test_a_match_is_named_without_its_text() -> None:
    kinds = scrub.search(b"marie tok3n-of-the-operator k-0123456789", needles())
    assert len(kinds) == 3
    assert not any("marie" in text or "tok3n" in text or "k-01" in text for text in kinds)


def test_a_log_keeps_everything_but_what_the_search_finds() -> None:
    lines = [
        {"text": "hello\nmarie is at /home/jean/x\n/data/lab7/work/runs"},
        {"text": "summaries\nsk-" + "a1B2" * 8 + "\tk-0123456789"},
    ]
    data = "".join(json.dumps(line) + "\n" for line in lines).encode()
    assert len(scrub.search(data, needles())) == 4
    assert scrub.secret_lines(data, None) == {2: "an API key"}
    clean, counts = scrub.redact(data, needles())
    assert scrub.search(clean, needles()) == []
    assert scrub.secret_lines(clean, None) == {}
    texts = [json.loads(line)["text"] for line in clean.splitlines()]
    assert texts[0] == "hello\n[removed] is at [removed]/x\n[removed]/runs"
    assert texts[1] == "summaries\n[removed]\t[removed]"
    assert sum(counts.values()) == 5
    assert scrub.redact(clean, needles()) == (clean, {})


def test_a_name_that_json_spells_otherwise_is_found() -> None:
    named = scrub.needles({}, {"renée": "the user's name"}, [], [])
    for text in (json.dumps({"by": "renée"}), "by renée"):
        assert scrub.search(text.encode(), named) == ["the user's name"]
        assert b"[removed]" in scrub.redact(text.encode(), named)[0]


def test_each_line_with_a_secret_is_named_once_with_its_number() -> None:
    passed = Passed(key="00" * 32).with_values(["value of the run"])
    key = "hf_" + "a1B2c3D4e5" * 3
    data = f"one\n{key} {key}\nthree\nfour = 'value of the run'\n{key}".encode()
    kinds = {2: "an API key", 4: "a value that the run passed to its agent", 5: "an API key"}
    assert scrub.secret_lines(data, passed) == kinds
    assert scrub.secret_lines(data, None) == {line: what for line, what in kinds.items() if line != 4}
