"""Each field of each published file, changed and signed again by its own publisher: refused, contradicted, or listed as
a claim.

Attacks, each with its defence:
- any other edit of a field, files or fields added, keys that occur twice, by the publisher with the own key:
  refused, contradicted, or listed as a claim that nobody can check.
"""

from __future__ import annotations

import copy
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from publications import Forger, Held, Results, spelt

from evopolicy_results.publish import contents, fields, rules
from evopolicy_results.publish.findings import Findings

pytestmark = pytest.mark.system

FILES = {
    "manifest.json": contents.MANIFEST,
    "signature.json": contents.SIGNATURE,
    "removed.json": contents.REMOVED,
    contents.CARD: contents.CARD,
    **{
        name: f"runs/0000/{name}"
        for name in (contents.RUN, contents.OPENING, contents.RESULT, contents.EPISODES, contents.DIGESTS)
    },
}


def changed(leaf: Any) -> Any:
    if isinstance(leaf, bool):
        return not leaf
    if isinstance(leaf, int | float):
        return leaf + 1
    return "x" if leaf is None else leaf[:-1] + ("0" if leaf.endswith("1") else "1")


def with_leaf(content: Any, path: tuple[str, ...]) -> Any:
    content = copy.deepcopy(content)
    part = content
    for step in path[:-1]:
        part = part[int(step) if isinstance(part, list) else step]
    last = int(path[-1]) if isinstance(part, list) else path[-1]
    part[last] = changed(part[last])
    return content


def checked(results: Results, forger: Forger) -> Findings:
    """As a reader who knows the signer's key and noted the journal's head at the end."""
    head = results.summary["journal_head"]
    return rules.check(Held(forger.files), results.summary["signer"], heads=[head])


def claimed(outcome: Findings, file: str, path: tuple[str, ...]) -> bool:
    """Whether the output lists the field as a claim."""
    kind = (fields.file_kind(file) or "").removeprefix("runs/*/")
    begin = f"nobody can check, in {kind}: "
    texts = [each.text.removeprefix(begin) for each in outcome.findings if each.text.startswith(begin)]
    listed = [field for text in texts for field in text.split(", ")]
    # `a.*.b` for any element, `a.**` for everything below.
    return any(
        len(steps := pattern.split(".")) <= len(path)
        and all(a in ("*", "**", b) for a, b in zip(steps, path, strict=False))
        and (len(steps) == len(path) or steps[-1] == "**")
        for pattern in listed
    )


def in_manifest(results: Results, forger: Forger, file: str, digest: str) -> None:
    manifest = json.loads(forger.files[contents.MANIFEST])
    manifest["files"][file] = digest
    forger.put(contents.MANIFEST, manifest)
    forger.sign_manifest(results.root / "st")


def signed(results: Results, forger: Forger, file: str) -> Findings:
    """A forger cannot make digests anew that contradict the files: the manifest's own fields are signed as they are."""
    if file in (contents.MANIFEST, contents.SIGNATURE):
        if file == contents.MANIFEST:
            forger.sign_manifest(results.root / "st")
    elif file.endswith(contents.DIGESTS):
        in_manifest(results, forger, file, contents.digest(forger.files[file]))
    else:
        forger.sign(results.root / "st")
    return checked(results, forger)


@pytest.mark.parametrize("kind", FILES)
def test_each_changed_field_is_refused_contradicted_or_listed_as_a_claim(results: Results, kind: str) -> None:
    file = FILES[kind]
    content = json.loads(results.files[file])
    through, n = [], 0
    for path, _ in fields.leaves(content):
        if kind == contents.OPENING and path[0] == "train" and int(path[1]) > 2:
            continue  # hundreds of cases that are alike
        forger = Forger(results.files)
        forger.put(file, with_leaf(content, path))
        outcome = signed(results, forger, file)
        n += 1
        if not outcome.failed and not claimed(outcome, file, path):
            through.append(".".join(path))
    assert n > 1
    assert through == []


@pytest.mark.parametrize("kind", FILES)
def test_a_key_that_occurs_twice_is_refused(results: Results, kind: str) -> None:
    file = FILES[kind]
    for path in ((), ("agent",)) if kind == contents.RUN else ((),):
        content = json.loads(results.files[file])
        key = next(iter(content[path[0]] if path else _first(content)))
        data = results.files[file].replace(f'"{key}":'.encode(), f'"{key}":null,"{key}":'.encode(), 1)
        assert data != results.files[file]
        forger = Forger(results.files)
        forger.files[file] = data
        assert signed(results, forger, file).failed


def _first(content: Any) -> dict[str, Any]:
    return content if isinstance(content, dict) else content[0]


def test_every_json_object_refuses_an_added_field(results: Results) -> None:
    for file in FILES.values():
        content = json.loads(results.files[file])
        for path in _objects(content):
            new = copy.deepcopy(content)
            part = new
            for step in path:
                part = part[step]
            part["added"] = 1
            forger = Forger(results.files)
            forger.put(file, new)
            assert signed(results, forger, file).failed, (file, path)


def _objects(content: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    if isinstance(content, dict):
        yield path
    items = content.items() if isinstance(content, dict) else enumerate(content[:3])
    for key, inner in items:
        if isinstance(inner, dict | list):
            yield from _objects(inner, (*path, key))


def test_a_changed_journal_contradicts_the_noted_head(results: Results) -> None:
    lines = contents.journal_entries(results.files[contents.JOURNAL])
    for number, line in enumerate(lines):
        content = json.loads(line)
        for path, _ in fields.leaves(content):
            forger = Forger(results.files)
            new = spelt(contents.JOURNAL, with_leaf(content, path))
            forger.entries(lambda old, n=number, new=new: [*old[:n], new, *old[n + 1 :]])  # type: ignore[misc]
            forger.sign(results.root / "st")
            assert checked(results, forger).failed, (number, path)


def test_changed_policies_salts_and_rewards_are_found(results: Results) -> None:
    for name in ("checkpoints/000", contents.SALT, "actions/train-000"):
        forger = Forger(results.files)
        data = forger.files[f"runs/0000/{name}"]
        forger.files[f"runs/0000/{name}"] = data[:-9] + bytes([data[-9] ^ 1]) + data[-8:]
        forger.sign(results.root / "st")
        assert checked(results, forger).failed, name


def test_changed_actions_are_listed_as_what_replay_alone_compares(results: Results) -> None:
    forger = Forger(results.files)
    forger.rerecord("heldout-001", lambda row: (row.action + 1, row.reward))
    forger.sign(results.root / "st")
    outcome = checked(results, forger)
    assert not outcome.failed
    assert any(each.kind == "claims" and "only --replay" in each.text for each in outcome.findings)


def test_files_of_no_kind_are_refused(results: Results) -> None:
    for name in ("notes", "runs/0000/notes", "runs/0000/actions/train-777", "runs/0000/checkpoints/777"):
        forger = Forger(results.files)
        forger.files[name] = b"x"
        forger.sign(results.root / "st")
        if "/" not in name:
            in_manifest(results, forger, name, contents.digest(b"x"))
        assert checked(results, forger).failed, name


def test_a_digest_of_a_runs_file_in_the_manifest_is_refused(results: Results) -> None:
    forger = Forger(results.files)
    in_manifest(results, forger, "runs/0000/run.json", "00" * 32)
    assert checked(results, forger).failed


def untold(results: Results) -> Forger:
    """The same file with a result to which no gateway told anything."""
    forger = Forger(results.files)
    for run in ("runs/0000", "runs/0001"):
        forger.begin_anew(lambda result: result["record"].clear(), run)
    forger.place()
    forger.sign(results.root / "st")
    return forger


def test_fields_that_no_gateway_told_at_the_end_are_claims(results: Results) -> None:
    forger = untold(results)
    outcome = rules.check(Held(forger.files), results.summary["signer"])
    assert [each for each in outcome.findings if each.state == "failed"] == []
    now = rules.check(Held(results.files), results.summary["signer"])
    for field in ("agent.model_string", "jail", "versions.rules_hash"):
        assert claimed(outcome, "runs/0000/run.json", tuple(field.split("."))), field
        assert not claimed(now, "runs/0000/run.json", tuple(field.split("."))), field
    assert not claimed(outcome, "runs/0000/run.json", ("versions", "fingerprint", "cpu"))


def test_the_page_on_publication_lists_the_claims_of_the_table() -> None:
    page = (Path(__file__).parents[3] / "docs/how-to/publish.md").read_text()
    for file, by_cover in fields.FIELDS.items():
        for field in by_cover.get("claim", "").split():
            assert f"`{field.removeprefix('*.').replace('.*', '')}`" in page, (file, field)
