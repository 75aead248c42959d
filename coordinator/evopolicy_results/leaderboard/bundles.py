"""Reads published results for a leaderboard: checks each file, unpacks its runs into run directories, and
groups files that are one comparison.

Rules that this module owns:
- A file is untrusted. Its check comes first, and nothing is unpacked of a file that fails.
- Entries of different signers are different entries, also under one name.
- Files of one signer are of one journal. If no journal can have led to both of two files, the check `order` fails for
  both; their runs are shown, since nothing tells which file is true.
- Differences of processors do not make labs incomparable (`cpu` of the fingerprint); they are shown instead.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from evopolicy_common.errors import ProtocolError
from evopolicy_common.records import journal
from evopolicy_common.records.policies import checkpoints
from evopolicy_common.records.policies.checkpoints import CheckpointMeta
from evopolicy_common.records.run_record import Artifacts, encode_run_record
from evopolicy_results.publish import contents, rules, run_rules
from evopolicy_results.publish.archive import Archive
from evopolicy_results.publish.contents import Episode
from evopolicy_results.publish.findings import Checked, PublishedRun
from evopolicy_results.publish.scan import scan_published
from evopolicy_results.reading.comparability import mixtures
from evopolicy_results.reading.reader import load_runs
from evopolicy_results.reading.records import LeftOut, Run

_MAX_NAME = 120
_POINTS = 160

Replay = Callable[[Archive, Checked], None]
"""Replays recorded actions and adds the findings."""


class LabRun(msgspec.Struct, frozen=True, kw_only=True):
    """A published run and its run directory."""

    run: Run
    published: str
    """The coordinator's id."""
    episodes: tuple[tuple[Episode, tuple[float, ...]], ...]
    """Held-out episodes of the selected checkpoint, each with the sum of its rewards so far at `_POINTS`
    steps at most; without sums where the recording was withheld."""
    unrecorded: bool = False
    """Some of its episodes have no recording, so that no replay can contradict their returns."""


class LabBundle(msgspec.Struct, kw_only=True):
    """One file of published results."""

    file: str
    """Its name without folders."""
    sha256: str
    number: int = 0
    """Position among the files of the site."""
    lab: str = ""
    """Name that the site's owner gives the signer; empty for none."""
    checked: Checked = msgspec.field(default_factory=Checked)
    runs: list[LabRun] = []
    left_out: list[LeftOut] = []
    """Runs of the file that a report leaves out, with the reason."""
    refused: str = ""
    """Why no run of it is shown; empty when they are."""
    processors: list[str] = []
    heads: list[str] = []
    """Of its journal, after each entry."""

    @property
    def page(self) -> str:
        """Its page, relative to the site's folder."""
        return f"bundles/{self.number:03d}.html"

    @property
    def signer(self) -> str:
        return self.checked.signer

    @property
    def label(self) -> str:
        """The signer as text: its name, or the first digits of its key."""
        return self.lab or (f"key {self.signer[:8]}" if self.signer else "no signer")


def read_bundles(
    files: Sequence[Path], labs: dict[str, str], folder: Path, replay: Replay = lambda archive, checked: None
) -> list[LabBundle]:
    """Checks all files and unpacks their runs below `folder`. `labs`: public key (hex) to the signer's name, empty for
    none."""
    found: list[LabBundle] = []
    seen: dict[tuple[str, str], str] = {}
    for number, path in enumerate(files):
        bundle = LabBundle(file=path.name, sha256=_sha256(path), number=number)
        found.append(bundle)
        try:
            with Archive(path) as archive:
                _read(archive, bundle, labs, folder / f"{number:04d}", seen, replay)
        except ProtocolError as error:
            bundle.refused = str(error)
    _compare_journals(found)
    _tell_apart(found)
    return found


def _read(
    archive: Archive,
    bundle: LabBundle,
    labs: dict[str, str],
    folder: Path,
    seen: dict[tuple[str, str], str],
    replay: Replay,
) -> None:
    checked = rules.check(archive)
    if checked.signer in labs:
        # The whole check again costs more than to replace its one finding on the signer.
        checked.findings = [each for each in checked.findings if each.kind != "identity"]
        checked.add("identity", "ok", "signed by a key that the site's owner named")
        bundle.lab = labs[checked.signer]
    scan_published(archive, checked)
    bundle.checked = checked
    if not checked.failed:
        replay(archive, checked)
    if checked.failed:
        bundle.refused = "; ".join(
            dict.fromkeys(f"{each.kind}: {each.text}" for each in checked.findings if each.state == "failed")
        )[:500]
        return
    for run in checked.runs:
        if before := seen.get((checked.signer, run.opening.run)):
            bundle.refused = f"run {run.opening.run} is also in {before}"
            return
    lines = contents.journal_entries(archive.read(contents.JOURNAL, contents.MAX_RECORDING_BYTES))
    bundle.heads = journal.heads(lines)
    folder = folder.resolve()
    by_folder = {folder / run.folder: run for run in checked.runs}
    for place, run in by_folder.items():
        seen[checked.signer, run.opening.run] = bundle.file
        _unpack(archive, run, place)
    cpus = (run.record.versions.fingerprint.get("cpu", "") for run in checked.runs)
    bundle.processors = [each for each in dict.fromkeys(cpus) if each]
    loaded = load_runs([folder])
    bundle.left_out = [
        msgspec.structs.replace(each, path=each.path.relative_to(folder))
        if each.path.is_relative_to(folder)
        else each
        for each in loaded.left_out
    ]
    bundle.runs = [
        LabRun(
            run=each,
            published=run.opening.run,
            episodes=_curves(archive, run),
            unrecorded=bool(checked.unrecorded(run.opening.run)),
        )
        for each in loaded.runs
        for run in (by_folder[each.path],)
    ]
    if not bundle.runs:
        bundle.refused = "none of its runs has a score"


def _unpack(archive: Archive, run: PublishedRun, place: Path) -> None:
    """Writes `run.json` and the checkpoints as a run directory."""
    place.mkdir(parents=True)
    replace, record = msgspec.structs.replace, run.record
    fingerprint = {name: each for name, each in record.versions.fingerprint.items() if name != "cpu"}
    agent = record.agent
    kept = replace(
        record,
        exp_id=_short(record.exp_id),
        agent=replace(agent, entry=_short(agent.entry), harness=_short(agent.harness)),
        versions=replace(record.versions, fingerprint=fingerprint),
        # They name files of a run directory; this folder contains only the files written here.
        artifacts=Artifacts(),
        replays=(),
    )
    (place / "run.json").write_bytes(encode_run_record(kept))
    left = run.opening.budget
    policies = dict(run.bundles(archive))
    for submit in run.result.submits:
        before, left = left, left - len(submit.env_instances)
        bundle = policies.get(submit.submit_index)
        meta = CheckpointMeta(
            submit_index=submit.submit_index,
            submit_time="",
            n_episodes_requested=len(submit.env_instances),
            remaining_budget_before=before,
            remaining_budget_after=left,
            validation_status=submit.status,
            mean_return=submit.mean_return,
            val_mean=submit.val_mean,
        )
        folder = place / "checkpoints" / f"submit_{submit.submit_index:03d}"
        checkpoints.write(folder, meta, bundle, checkpoints.measured(bundle))


def _curves(archive: Archive, run: PublishedRun) -> tuple[tuple[Episode, tuple[float, ...]], ...]:
    best = run.result.best_submit_index
    group = next((each for each in run.groups if each.split == "heldout" and each.submit_index == best), None)
    if group is None:
        return ()
    recordings = dict(enumerate(run.recordings(archive, group.name)))
    found = []
    for episode in group.episodes:
        sums = np.zeros(0)
        if (data := recordings.get(episode.index)) is not None:
            sums = np.cumsum([0.0, *run_rules.recording_of(data).rewards.tolist()])
        step = max(1, -(-len(sums) // _POINTS))
        found.append((episode, (*sums[:-1:step].tolist(), *sums[-1:].tolist())))
    return tuple(found)


def _compare_journals(found: Sequence[LabBundle]) -> None:
    """Reports files whose journal is not the beginning of the longest one of their signer."""
    longest: dict[str, LabBundle] = {}
    for bundle in found:
        if bundle.heads and len(bundle.heads) > len(longest.setdefault(bundle.signer, bundle).heads):
            longest[bundle.signer] = bundle
    for bundle in found:
        n, other = len(bundle.heads), longest.get(bundle.signer)
        if n and other is not None and other.heads[n - 1] != bundle.heads[-1]:
            for one, another in ((bundle, other), (other, bundle)):
                text = (
                    f"the first {n} entries are others in {another.file} of the same signer: one journal was begun"
                    " anew, or cut"
                )
                one.checked.add("order", "failed", text)


def _tell_apart(found: Sequence[LabBundle]) -> None:
    """Adds the signer to entries that several signers have, until none is shared: a signer may have chosen the name
    that another's entry gets. Of a signer's runs with one name, the later ones get their ids."""
    names = [bundle.label for bundle in found]
    while shared := _shared(found):
        for bundle, name in zip(found, names, strict=True):
            for number, each in enumerate(bundle.runs):
                agent = each.run.record.agent
                if agent.entry in shared:
                    new = msgspec.structs.replace(agent, entry=f"{agent.entry} ({name})")
                    bundle.runs[number] = _with(each, agent=new)
        # Names and first digits may be equal; whole keys are not.
        names = [bundle.signer for bundle in found]
    # A report knows a run by its name, so two files of one signer may not have the same one.
    seen: set[str] = set()
    for bundle in found:
        for number, each in enumerate(bundle.runs):
            while each.run.name in seen:
                each = _with(each, exp_id=f"{each.run.record.exp_id} ({each.published})")
            bundle.runs[number] = each
            seen.add(each.run.name)


def _with(each: LabRun, **changes: Any) -> LabRun:
    """The run with other fields of its `run.json`."""
    record = msgspec.structs.replace(each.run.record, **changes)
    return msgspec.structs.replace(each, run=msgspec.structs.replace(each.run, record=record))


def _shared(found: Sequence[LabBundle]) -> set[str]:
    """Entries that several signers have."""
    signers: dict[str, set[str]] = {}
    for bundle in found:
        for each in bundle.runs:
            signers.setdefault(each.run.entry, set()).add(bundle.signer)
    return {entry for entry, keys in signers.items() if len(keys) > 1}


def _short(text: str) -> str:
    """The text; a longer one is cut and gets a hash, so that different texts stay different."""
    if len(text) <= _MAX_NAME:
        return text
    return f"{text[: _MAX_NAME - 10]}…{hashlib.sha256(text.encode()).hexdigest()[:8]}"


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


class Board(msgspec.Struct, kw_only=True):
    """Bundles whose runs are one comparison."""

    bundles: list[LabBundle]
    apart: list[str] = []
    """How its runs differ from those of the first board; empty for the first board."""
    mixed: bool = False
    """A single bundle whose own runs are no one comparison."""
    unrecorded: bool = False
    """Its runs have episodes without a recording."""

    @property
    def runs(self) -> list[Run]:
        return [each.run for bundle in self.bundles for each in bundle.runs]


def boards(bundles: Sequence[LabBundle]) -> list[Board]:
    """The boards, the one with most runs first. A bundle joins the first board that it is comparable with. Its runs
    with episodes that have no recording stand on boards of their own, after the others."""
    found: list[Board] = []
    parts = [
        (unrecorded, msgspec.structs.replace(bundle, runs=runs))
        for bundle in bundles
        for unrecorded in (False, True)
        if not bundle.refused and (runs := [one for one in bundle.runs if one.unrecorded == unrecorded])
    ]
    for unrecorded, bundle in sorted(parts, key=lambda part: (-len(part[1].runs), part[1].file)):
        own = [each.run for each in bundle.runs]
        if mixtures(own):
            found.append(Board(bundles=[bundle], mixed=True, unrecorded=unrecorded))
            continue
        alike = [board for board in found if not board.mixed and board.unrecorded == unrecorded]
        home = next((board for board in alike if not mixtures([*board.runs, *own])), None)
        if home is None:
            found.append(Board(bundles=[bundle], unrecorded=unrecorded))
        else:
            home.bundles.append(bundle)
    found.sort(key=lambda board: (board.unrecorded, board.mixed, -len(board.runs)))
    for board in found:
        if board.unrecorded:
            board.apart.append(
                "some of their episodes have no recording, so that no replay can contradict the returns"
            )
        if board is not found[0]:
            whole = board.runs if board.mixed else [*found[0].runs, *board.runs]
            board.apart += [str(one) for one in mixtures(whole)]
    return found
