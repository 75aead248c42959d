"""The checks of `evopolicy check` on published results, without playing episodes. Pure: files in, findings out.

Rules that this module owns:
- No part of a file is trusted because another part confirms it: everything is traced to the journal's entries, whose
  chain of hashes is in the signed manifest. The signer is trusted only if the caller names the key.
- A finding has a kind (`KINDS`). `failed`: the published data contradict each other or the signature. `open`: this
  check cannot decide, and states the reason.
- For any content of a file, the check ends with findings; only a file without published results is an error.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import TypeVar

from evopolicy_common.errors import ProtocolError
from evopolicy_common.records import journal
from evopolicy_common.records.journal import Ended, Opened
from evopolicy_common.records.words import CANARY
from evopolicy_common.terminal import counted
from evopolicy_results.publish import card as cards
from evopolicy_results.publish import contents, descriptions, fields
from evopolicy_results.publish.contents import (
    Manifest,
    Removed,
    Signature,
    signed_by,
)
from evopolicy_results.publish.findings import KINDS, UPDATE, FileSet, Findings, History, State, decoded
from evopolicy_results.publish.run_rules import check_run, check_starts, read_run

T = TypeVar("T")


def check(files: FileSet, identity: str = "", heads: Sequence[str] = ()) -> Findings:
    """All but the replay. `identity`: the public key (hex) that the signer must have; empty: any.

    `heads`: of the journal, as they were noted elsewhere, hexadecimal digits.
    """
    checked = Findings()
    manifest = _manifest(files, identity, checked)
    if manifest is None:
        return checked
    _names(files, manifest, checked)
    damaged, digests = _digests(files, manifest, checked)
    entries = _journal(files, manifest, checked)
    for state, text in _order(entries, heads):
        checked.add("order", state, text)
    try:
        checked.removed = _document(files, contents.REMOVED, tuple[Removed, ...], checked)
    except ProtocolError as error:
        checked.add("format", "failed", str(error))
    folders = sorted({"/".join(name.split("/")[:2]) for name in files.names if name.startswith("runs/")})
    if len(folders) > contents.MAX_RUNS:
        checked.add("format", "failed", f"{len(folders):,} runs; {contents.MAX_RUNS:,} are allowed")
        return checked
    if not folders:
        checked.add("format", "failed", "there is no run in it")
    seen: set[str] = set()
    for folder in folders:
        run = read_run(files, folder, checked)
        if run is None:
            continue
        if run.opening.run in seen:
            checked.add("digests", "failed", f"run {run.opening.run} occurs twice", run.opening.run)
        seen.add(run.opening.run)
        checked.runs.append(run)
        check_run(files, run, entries, damaged, checked)
    check_starts(checked)
    if any(name.startswith("runs/") and "/actions/" in name for name in files.names):
        text = "only --replay compares the recorded actions, single rewards and ends with the environment"
        checked.add("claims", "open", text)
    checked.listing = contents.listing(entries.entries, seen)
    is_whole = all(each.state == "published" for each in checked.listing)
    checked.add("completeness", "ok" if is_whole else "open", contents.completeness(checked.listing))
    _descriptions(files, manifest, digests, checked)
    for file, names in checked.claims.items():
        kind = fields.file_kind(file) or file
        by = next((run.opening.run for run in checked.runs if file.startswith(f"{run.folder}/")), "")
        text = f"nobody can check, in {kind.removeprefix('runs/*/')}: {', '.join(names)}"
        checked.add("claims", "open", text, by)
    return checked


def _manifest(files: FileSet, identity: str, checked: Findings) -> Manifest | None:
    try:
        manifest = _document(files, contents.MANIFEST, Manifest, checked)
        signature = _document(files, contents.SIGNATURE, Signature, checked)
        if (manifest.format, manifest.version) != (contents.FORMAT, contents.VERSION):
            raise ProtocolError(
                f"{manifest.format[:40]!r} version {manifest.version}; this program reads {contents.FORMAT!r}"
                f" version {contents.VERSION}"
            )
        if manifest.canary != CANARY:
            raise ProtocolError("the manifest has another canary")
    except ProtocolError as error:
        checked.add("format", "failed", str(error))
        return None
    checked.add("format", "ok", f"version {manifest.version}, made by evopolicy {manifest.software}")
    signed = contents.digest(files.read_file(contents.MANIFEST, contents.MAX_DOCUMENT_BYTES))
    if not signed_by(signature.key, signature.signature, signed):
        checked.add("signature", "failed", f"not a signature of this manifest by {signature.key[:64]}")
        return manifest
    checked.signer = signature.key
    checked.add("signature", "ok", f"signed by {signature.key}")
    if not identity:
        text = (
            "self-signed: the maker of the file chose the key. Name the key that you expect with --identity"
        )
        checked.add("identity", "open", text)
    elif signature.key == identity.lower():
        checked.add("identity", "ok", "signed by the key that you named")
    else:
        checked.add("identity", "failed", f"another signer: {signature.key}, not {identity}")
    return manifest


def _document(files: FileSet, name: str, kind: Callable[..., T] | type[T], checked: Findings) -> T:
    """A file's content. Raises ProtocolError for a damaged one. `checked` receives its unknown fields and claims."""
    data = files.read_file(name, contents.MAX_DOCUMENT_BYTES)
    content = decoded(name, data, kind)
    checked.refuse_unknown(name, fields.parsed(name, data))
    return content


def _names(files: FileSet, manifest: Manifest, checked: Findings) -> None:
    """Files that publication does not write, and those of the manifest that it leaves to a run's digests."""
    odd = sorted(name for name in files.names if fields.file_kind(name) is None)
    top = (contents.JOURNAL, contents.REMOVED, *contents.DESCRIPTIONS)
    odd += [name for name in manifest.files if name not in top and not name.endswith(f"/{contents.DIGESTS}")]
    for name in odd:
        checked.add("format", "failed", f"{name[:120]} is no file of published results: {UPDATE}")


def _digests(files: FileSet, manifest: Manifest, checked: Findings) -> tuple[set[str], dict[str, str]]:
    """The names of files that differ from those that were signed, and the signed digests of all."""
    wanted = dict(manifest.files)
    bad: list[str] = []
    for name in [name for name in manifest.files if name.endswith(f"/{contents.DIGESTS}")]:
        try:
            inner = _document(files, name, dict[str, str], checked)
        except ProtocolError as error:
            bad.append(str(error))
            continue
        folder = name.removesuffix(contents.DIGESTS)
        wanted |= {f"{folder}{path}": digest for path, digest in inner.items()}
    expected = wanted.keys() | {contents.MANIFEST, contents.SIGNATURE}
    damaged: set[str] = set()
    for name in sorted(wanted.keys() & files.names):
        try:
            actual = contents.digest(files.read_file(name, contents.MAX_RECORDING_BYTES))
            fault = f"{name} was changed" if actual != wanted[name] else ""
        except ProtocolError as error:
            fault = str(error)
        if fault:
            bad.append(fault)
            damaged.add(name)
    bad += [f"{name} is missing" for name in sorted(expected - files.names)]
    bad += [f"{name} was added" for name in sorted(files.names - expected)]
    checked.conclude("digests", bad, counted(len(wanted), "file"))
    return damaged, wanted


def _journal(files: FileSet, manifest: Manifest, checked: Findings) -> History:
    try:
        lines = contents.journal_entries(files.read_file(contents.JOURNAL, contents.MAX_RECORDING_BYTES))
        entries = [journal.read_entry(line) for line in lines]
        for line in lines:
            fields.parsed(contents.JOURNAL, line)
    except ProtocolError as error:
        checked.add("journal", "failed", f"{contents.JOURNAL}: {error}")
        return History([], [])
    heads = journal.heads(lines)
    head = heads[-1] if heads else journal.EMPTY_HEAD
    fault = _history_fault(entries)
    if (len(lines), head) != (manifest.journal_entries, manifest.journal_head):
        fault = f"its {len(lines)} entries come to the head {head}, which is not the signed one"
    checked.conclude("journal", [fault] if fault else [], f"{len(lines)} entries, head {head}")
    return History(entries, heads)


def _order(history: History, noted: Sequence[str]) -> Iterator[tuple[State, str]]:
    """Whether the journal had the heads that were noted elsewhere."""
    if not noted:
        text = "the journal is its owner's, who could have deleted it and begun another"
        yield "open", f"{text}: compare its head with one that was noted elsewhere in time (--head)"
    for head in noted:
        if head not in history.heads:
            yield "failed", f"the journal never had the head {head}: it was changed, or begun anew"
            continue
        number = history.heads.index(head)
        later = sum(isinstance(entry, Opened) for entry in history.entries[number + 1 :])
        opened = counted(later, "run")
        yield "ok", f"the journal had entry {number} with the head that you gave; {opened} opened after it"


def _history_fault(entries: Sequence[journal.EpochEntry]) -> str | None:
    """A contradiction in the order of the entries; None if there is none."""
    still_open: dict[str, str] = {}
    seen: set[str] = set()
    at = 0.0
    for number, entry in enumerate(entries):
        if entry.at < at:
            return f"entry {number} is older than the one before it"
        at = entry.at
        if isinstance(entry, Opened):
            if entry.run in seen:
                return f"run {entry.run} is opened twice"
            seen.add(entry.run)
            still_open[entry.run] = entry.epoch
        elif isinstance(entry, Ended):
            if still_open.pop(entry.run, None) is None:
                return f"run {entry.run} ends without being open"
        else:
            run = next((run for run, epoch in still_open.items() if epoch == entry.epoch), None)
            if run is not None:
                return f"epoch {entry.epoch} is revealed while run {run} is open"
    return None


def _descriptions(files: FileSet, manifest: Manifest, digests: Mapping[str, str], checked: Findings) -> None:
    """Makes the card and its descriptions again, and compares."""
    if checked.failed:
        return
    try:
        data = {name: files.read_file(name, contents.MAX_DOCUMENT_BYTES) for name in contents.DESCRIPTIONS}
        card = _document(files, contents.CARD, cards.Card, checked)
    except ProtocolError as error:
        checked.add("card", "failed", str(error))
        return
    if card.version != cards.VERSION:
        text = f"it has version {card.version}, this program makes version {cards.VERSION}: not compared"
        checked.add("card", "open", text)
        for name in contents.DESCRIPTIONS:
            checked.claim(name, ["**"])
        return
    own = cards.make(
        [cards.CardSource(run.folder, run.record, run.result) for run in checked.runs],
        contents.journal_entries(files.read_file(contents.JOURNAL, contents.MAX_RECORDING_BYTES)),
        signer=checked.signer,
        software=manifest.software,
        licence=card.licence,
        claimed=card.licences,
    )
    made = descriptions.files(cards.matching(own, card), digests)
    wrong = [f"{name} is not what follows from the runs" for name in made if made[name] != data[name]]
    checked.conclude("card", wrong, KINDS["card"])
