"""Findings of a check of published results, and what it reads: the files, the journal's entries, one run's
documents."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from typing import Literal, NamedTuple, Protocol, TypeVar

import msgspec

from evopolicy_common.errors import DECODE_ERRORS, BundleError, ProtocolError, raised_as
from evopolicy_common.messages.environment import Case, Split
from evopolicy_common.messages.operator import RunResult
from evopolicy_common.records import journal
from evopolicy_common.records.journal import Opening
from evopolicy_common.records.policies import bundles
from evopolicy_common.records.policies.bundles import Bundle
from evopolicy_common.records.run_record import RunRecord
from evopolicy_results.publish import contents, fields
from evopolicy_results.publish.contents import EpisodeGroup, Listed, Removed

T = TypeVar("T")
OfRun = TypeVar("OfRun", journal.Opened, journal.Ended)

KINDS = {
    "format": "the format is one that this version reads",
    "signature": "the signature is of this manifest",
    "identity": "the signer is the one that you named",
    "digests": "every file has the digest that was signed",
    "journal": "the journal's entries are complete and in order",
    "commitment": "splits and settings are those that were fixed before the agent began",
    "disclosure": "the journal says that the cases were made public",
    "record": "run.json agrees with commitment and result",
    "result": "the result is the one that the journal fixed when the run ended",
    "budget": "submits keep to budget and bounds",
    "selection": "the selected checkpoint is the one with the best validation mean",
    "scores": "scores follow from the returns of the episodes",
    "recordings": "returns follow from the recorded rewards",
    "checkpoints": "the policies are those that were submitted",
    "logs": "agents' logs are what the agents wrote",
    "card": "the evaluation card and its descriptions follow from the runs",
    "worlds": "every world has a candidate that the fixed order allows",
    "starts": "every run began with the usual workspace",
    "completeness": "every run that was opened for the entries is here, with the runs that they start from",
    "order": "the journal could not be begun anew",
    "policies": "the actions came from the policies",
    "claims": "every field follows from another, or was fixed when the run was opened or ended",
    "replay": "the environments give the recorded rewards for the recorded actions",
}
"""The checks, in the order of the output."""
UPDATE = "it was added, or a later version of evopolicy wrote it (then update)"
_SHOWN = 8
"""Unknown fields of a file that become findings."""

State = Literal["ok", "failed", "open"]


class Finding(msgspec.Struct, frozen=True, kw_only=True):
    kind: str
    state: State
    text: str
    run: str = ""
    """The run it is of; empty for the whole."""


class FileSet(Protocol):
    @property
    def names(self) -> frozenset[str]: ...

    def read_file(self, name: str, most: int) -> bytes:
        """ProtocolError for a file that is not there, damaged, or larger than `most`."""


class PublishedRun(msgspec.Struct, frozen=True, kw_only=True):
    """A run whose documents could be read."""

    folder: str
    record: RunRecord
    opening: Opening
    salt: bytes
    result: RunResult
    groups: tuple[EpisodeGroup, ...]
    opening_bytes: bytes
    result_bytes: bytes
    as_written: dict[str, object]

    def cases(self, split: Split) -> tuple[Case, ...]:
        return self.opening.cases(split)

    def recordings(self, files: FileSet, group: str) -> list[bytes | None]:
        """The packed recordings of a group's episodes, by its name; empty without any. ProtocolError for damaged
        ones."""
        path = f"{self.folder}/actions/{group}"
        if path not in files.names:
            return []
        return contents.unpack_recordings(files.read_file(path, contents.MAX_RECORDING_BYTES))

    def policies(self, files: FileSet, damaged: Collection[str] = ()) -> Iterator[tuple[int, Bundle | str]]:
        """By index of each submit with a policy: the published policy, or why there is none; empty where it was
        withheld or is `damaged`."""
        for submit in self.result.submits:
            path = f"{self.folder}/{contents.checkpoint_path(submit.submit_index)}"
            policy: Bundle | str = ""
            if submit.bundle and path in files.names and path not in damaged:
                try:
                    policy = bundles.load(
                        files.read_file(path, contents.MAX_DOCUMENT_BYTES * 2), submit.bundle
                    )
                except (BundleError, ProtocolError) as error:
                    policy = str(error)
            if submit.bundle:
                yield submit.submit_index, policy

    def bundles(self, files: FileSet) -> dict[int, Bundle]:
        """The published policies by submit index."""
        return {index: each for index, each in self.policies(files) if not isinstance(each, str)}


class Findings(msgspec.Struct, kw_only=True):
    signer: str = ""
    """Public key, hexadecimal; empty without a valid signature."""
    findings: list[Finding] = []
    listing: tuple[Listed, ...] = ()
    """Every run that was opened for the published entries."""
    removed: tuple[Removed, ...] = ()
    runs: list[PublishedRun] = []
    claims: dict[str, list[str]] = {}
    """Fields that nobody can check, by file (`fields`)."""
    recorded: dict[str, dict[str, tuple[int, int]]] = {}
    """By run and `EpisodeGroup.part`: the episodes that have a recording, and all."""
    covered: dict[str, int] = {}
    """By part, the episodes that a replay played."""

    @property
    def failed(self) -> bool:
        return any(each.state == "failed" for each in self.findings)

    def state_of(self, kind: str) -> str:
        """`failed`, `open` or `ok`, the gravest of the kind's findings; empty when there are none."""
        states = {each.state for each in self.findings if each.kind == kind}
        return next((state for state in ("failed", "open", "ok") if state in states), "")

    def grouped(self) -> dict[tuple[str, State, str], str]:
        """The findings by kind, state and text, in the order of `KINDS`, with the run or the number of runs."""
        runs: dict[tuple[str, State, str], dict[str, None]] = {}
        order = {kind: place for place, kind in enumerate(KINDS)}
        for each in sorted(self.findings, key=lambda each: order[each.kind]):
            runs.setdefault((each.kind, each.state, each.text), {})[each.run] = None
        return {key: next(iter(of)) if len(of) == 1 else f"{len(of)} runs" for key, of in runs.items()}

    def coverage(self) -> str:
        """The episodes that a replay played of all, by part, such as `2 of 5 train, 0 of 3 held-out`."""
        total: dict[str, int] = {}
        for parts in self.recorded.values():
            for part, (_, of) in parts.items():
                total[part] = total.get(part, 0) + of
        return ", ".join(f"{self.covered.get(part, 0)} of {of} {part}" for part, of in total.items())

    def unrecorded(self, run: str) -> list[str]:
        """The parts of a run with episodes that have no recording, such as `0 of 6 held-out`."""
        return [f"{n} of {of} {part}" for part, (n, of) in self.recorded.get(run, {}).items() if n < of]

    def claim(self, file: str, names: Iterable[str]) -> None:
        if claims := list(names):
            self.claims.setdefault(file, []).extend(claims)

    def add(self, kind: str, state: State, text: str, run: str = "") -> None:
        self.findings.append(Finding(kind=kind, state=state, text=text, run=run))

    def conclude(self, kind: str, faults: Sequence[str], ok: str, run: str = "", undecided: str = "") -> None:
        """Adds the faults as failed, and `undecided` as open; without any, `ok`."""
        for text in faults:
            self.add(kind, "failed", text, run)
        if undecided:
            self.add(kind, "open", undecided, run)
        elif not faults:
            self.add(kind, "ok", ok, run)

    def refuse_unknown(self, name: str, value: object, run: str = "", told: bool = False) -> None:
        """Refuses fields that the table of `fields` does not name, and notes those that are claims."""
        unknown, claims = fields.unknown_and_claims(name, value, told)
        for field in unknown[:_SHOWN]:
            text = f"{name}: {field[:120]} is no field of published results: {UPDATE}"
            self.add("format", "failed", text, run)
        self.claim(name, claims)


class Flaw(NamedTuple):
    kind: str
    text: str


class History(NamedTuple):
    """The journal: its entries, and the head after each."""

    entries: list[journal.EpochEntry]
    heads: list[str]

    def entry(self, kind: type[OfRun], run: str) -> tuple[int, OfRun] | None:
        entries = enumerate(self.entries)
        return next(((n, one) for n, one in entries if isinstance(one, kind) and one.run == run), None)


def decoded(name: str, data: bytes, kind: Callable[..., T] | type[T]) -> T:
    with raised_as(ProtocolError, f"{name} is damaged", *DECODE_ERRORS, ValueError):
        content: T = msgspec.json.decode(data, type=kind)
    return content
