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
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import msgspec
import numpy as np

from evopolicy_common.errors import ProtocolError
from evopolicy_common.records import journal
from evopolicy_common.records.policies import checkpoints
from evopolicy_common.records.policies.checkpoints import CheckpointMeta
from evopolicy_common.records.run_record import Artifacts, encode_run_record
from evopolicy_results.publish import contents, rules, run_rules
from evopolicy_results.publish.archive import Archive
from evopolicy_results.publish.contents import PublishedEpisode
from evopolicy_results.publish.findings import Findings, PublishedRun
from evopolicy_results.reading.comparability import mixtures
from evopolicy_results.reading.reader import load_runs
from evopolicy_results.reading.records import LeftOut, PastRun

_MAX_NAME = 120
_POINTS = 160

Replay = Callable[[Archive, Findings], None]
"""Replays recorded actions and adds the findings."""


class LabBundle(msgspec.Struct, kw_only=True):
    """One file of published results."""

    file: str
    """Its name without folders."""
    sha256: str
    number: int = 0
    """Position among the files of the site."""
    lab: str = ""
    """Name that the site's owner gives the signer; empty for none."""
    checked: Findings = msgspec.field(default_factory=Findings)
    runs: list[PastRun] = []
    episodes: dict[str, tuple[tuple[PublishedEpisode, tuple[float, ...]], ...]] = {}
    """By the coordinator's id of a run: held-out episodes of the selected checkpoint, each with the sum of its rewards
    so far at `_POINTS` steps at most; without sums where the recording was withheld."""
    left_out: list[LeftOut] = []
    """Runs of the file that a report leaves out, with the reason."""
    refused: str = ""
    """Why no run of it is shown; empty when they are."""
    heads: list[str] = []
    """Of its journal, after each entry."""

    def runs_of(self, unrecorded: bool) -> list[PastRun]:
        """Its runs that have episodes without a recording, or the others."""
        return [run for run in self.runs if bool(self.checked.unrecorded(run.record.run)) == unrecorded]

    @property
    def processors(self) -> list[str]:
        runs = () if self.refused else self.checked.runs
        cpus = (run.record.versions.fingerprint.get("cpu", "") for run in runs)
        return [each for each in dict.fromkeys(cpus) if each]

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
    bundles = [LabBundle(file=path.name, sha256=_sha256(path), number=n) for n, path in enumerate(files)]
    seen: dict[tuple[str, str], str] = {}
    for bundle, path in zip(bundles, files, strict=True):
        try:
            with Archive(path) as archive:
                bundle.checked = checked = rules.check(archive)
                if checked.signer in labs:
                    # The whole check again costs more than to replace its one finding on the signer.
                    checked.findings = [each for each in checked.findings if each.kind != "identity"]
                    checked.add("identity", "ok", "signed by a key that the site's owner named")
                    bundle.lab = labs[checked.signer]
                if not checked.failed:
                    replay(archive, checked)
                bundle.refused = _refusal(checked, seen)
                if not bundle.refused:
                    seen |= {(checked.signer, run.opening.run): bundle.file for run in checked.runs}
                    _read_runs(archive, bundle, folder.resolve() / f"{bundle.number:04d}")
        except ProtocolError as error:
            bundle.refused = str(error)
    _compare_journals(bundles)
    _tell_apart(bundles)
    return bundles


def _refusal(checked: Findings, seen: Mapping[tuple[str, str], str]) -> str:
    """Why a file is not shown; empty if it is. `seen`: the file of each signer's runs."""
    failed = [f"{each.kind}: {each.text}" for each in checked.findings if each.state == "failed"]
    runs = [run.opening.run for run in checked.runs]
    repeated = [f"run {run} is also in {file}" for run in runs if (file := seen.get((checked.signer, run)))]
    return "; ".join(dict.fromkeys(failed))[:500] or next(iter(repeated), "")


def _read_runs(archive: Archive, bundle: LabBundle, folder: Path) -> None:
    """Unpacks the runs below `folder`, and reads them as a report does."""
    lines = contents.journal_entries(archive.read_file(contents.JOURNAL, contents.MAX_RECORDING_BYTES))
    bundle.heads = journal.heads(lines)
    by_folder = {folder / run.folder: run for run in bundle.checked.runs}
    for place, run in by_folder.items():
        _unpack(archive, run, place)
    loaded = load_runs([folder])
    bundle.left_out = [
        msgspec.structs.replace(each, path=each.path.relative_to(folder))
        if each.path.is_relative_to(folder)
        else each
        for each in loaded.left_out
    ]
    bundle.runs = list(loaded.runs)
    bundle.episodes = {each.record.run: _curves(archive, by_folder[each.path]) for each in loaded.runs}
    if not bundle.runs:
        bundle.refused = "none of its runs has a score"


def _unpack(archive: Archive, run: PublishedRun, place: Path) -> None:
    """Writes `run.json` and the checkpoints as a run directory."""
    place.mkdir(parents=True)
    replace, record, agent = msgspec.structs.replace, run.record, run.record.agent
    fingerprint = {name: each for name, each in record.versions.fingerprint.items() if name != "cpu"}
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
    budget = run.opening.budget
    policies = run.bundles(archive)
    for submit in run.result.submits:
        before, budget = budget, budget - len(submit.env_instances)
        bundle = policies.get(submit.submit_index)
        meta = CheckpointMeta(
            submit_index=submit.submit_index,
            submit_time="",
            n_episodes_requested=len(submit.env_instances),
            remaining_budget_before=before,
            remaining_budget_after=budget,
            validation_status=submit.status,
            mean_return=submit.mean_return,
            val_mean=submit.val_mean,
        )
        folder = place / "checkpoints" / f"submit_{submit.submit_index:03d}"
        checkpoints.write(folder, meta, bundle, checkpoints.measured(bundle))


def _curves(archive: Archive, run: PublishedRun) -> tuple[tuple[PublishedEpisode, tuple[float, ...]], ...]:
    place = ("heldout", run.result.best_submit_index)
    episodes = []
    for group in (each for each in run.groups if (each.split, each.submit_index) == place):
        recordings = dict(enumerate(run.recordings(archive, group.name)))
        for episode in group.episodes:
            sums = np.zeros(0)
            if (data := recordings.get(episode.index)) is not None:
                sums = np.cumsum([0.0, *run_rules.recording_of(data).rewards.tolist()])
            step = max(1, -(-len(sums) // _POINTS))
            episodes.append((episode, (*sums[:-1:step].tolist(), *sums[-1:].tolist())))
    return tuple(episodes)


def _compare_journals(bundles: Sequence[LabBundle]) -> None:
    """Reports files whose journal is not the beginning of the longest one of their signer."""
    longest: dict[str, LabBundle] = {}
    for bundle in bundles:
        if bundle.heads and len(bundle.heads) > len(longest.setdefault(bundle.signer, bundle).heads):
            longest[bundle.signer] = bundle
    for bundle in (each for each in bundles if each.heads):
        n, other = len(bundle.heads), longest[bundle.signer]
        if other.heads[n - 1] != bundle.heads[-1]:
            for one, another in ((bundle, other), (other, bundle)):
                text = (
                    f"the first {n} entries are others in {another.file} of the same signer: one journal was begun"
                    " anew, or cut"
                )
                one.checked.add("order", "failed", text)


def _tell_apart(bundles: Sequence[LabBundle]) -> None:
    """Adds the signer to entries that several signers have, until none is shared: a signer may have chosen the name
    that another's entry gets. Of a signer's runs with one name, the later ones get their ids."""
    names = [bundle.label for bundle in bundles]
    while shared := _shared(bundles):
        for bundle, name in zip(bundles, names, strict=True):
            for number, each in enumerate(bundle.runs):
                agent = each.record.agent
                if agent.entry in shared:
                    new = msgspec.structs.replace(agent, entry=f"{agent.entry} ({name})")
                    bundle.runs[number] = _with(each, agent=new)
        # Names and first digits may be equal; whole keys are not.
        names = [bundle.signer for bundle in bundles]
    # A report knows a run by its name, so two files of one signer may not have the same one.
    seen: set[str] = set()
    for bundle in bundles:
        for number, each in enumerate(bundle.runs):
            while each.name in seen:
                each = _with(each, exp_id=f"{each.record.exp_id} ({each.record.run})")
            bundle.runs[number] = each
            seen.add(each.name)


def _with(run: PastRun, **changes: object) -> PastRun:
    """The run with other fields of its `run.json`."""
    return msgspec.structs.replace(run, record=msgspec.structs.replace(run.record, **changes))


def _shared(bundles: Sequence[LabBundle]) -> set[str]:
    """Entries that several signers have."""
    pairs = {(each.entry, bundle.signer) for bundle in bundles for each in bundle.runs}
    return {entry for entry, n in Counter(entry for entry, _ in pairs).items() if n > 1}


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
    """Whether its runs, of a single bundle, are no one comparison."""
    unrecorded: bool = False
    """Its runs have episodes without a recording, so that no replay can contradict their returns."""

    @property
    def runs(self) -> list[PastRun]:
        return [run for bundle in self.bundles for run in bundle.runs]

    @property
    def compared(self) -> list[PastRun]:
        """Those that a leaderboard ranks: not the ones that start from a submit of another run."""
        return [run for run in self.runs if run.record.start is None]


def boards(bundles: Sequence[LabBundle]) -> list[Board]:
    """The boards, the one with most runs first. A bundle joins the first board that it is comparable with. Its runs
    with episodes that have no recording stand on boards of their own, after the others."""
    all_boards: list[Board] = []
    parts = [
        (unrecorded, msgspec.structs.replace(bundle, runs=runs))
        for bundle in bundles
        for unrecorded in (False, True)
        if not bundle.refused and (runs := bundle.runs_of(unrecorded))
    ]
    for unrecorded, bundle in sorted(parts, key=lambda part: (-len(part[1].runs), part[1].file)):
        board = Board(bundles=[bundle], unrecorded=unrecorded)
        board.mixed = bool(mixtures(board.compared))
        others = [one for one in all_boards if not one.mixed and one.unrecorded == unrecorded]
        alike = (one for one in others if not mixtures([*one.compared, *board.compared]))
        if not board.mixed and (home := next(alike, None)):
            home.bundles.append(bundle)
        else:
            all_boards.append(board)
    all_boards.sort(key=lambda board: (board.unrecorded, board.mixed, -len(board.runs)))
    for board in all_boards:
        if board.unrecorded:
            board.apart.append(
                "some of their episodes have no recording, so that no replay can contradict the returns"
            )
        if board is not all_boards[0]:
            compared = board.compared if board.mixed else [*all_boards[0].compared, *board.compared]
            board.apart += [str(one) for one in mixtures(compared)]
    return all_boards
