"""Collects what is published of runs: from their directories and from the coordinator that made them.

Rules that this module owns:
- The coordinator is asked to disclose the runs' cases before anything of them is read: it refuses while it must.
- Its content depends on the runs and the journal alone, and is written in a fixed order: publishing again gives
  the same bytes.
- Every file goes through the searches of `scrub` before it is written. A secret stops the publication, before anything
  is disclosed if it is in a file of a run directory, unless its line is accepted or its file left out.
"""

from __future__ import annotations

import getpass
import hashlib
import os
import socket
from collections.abc import Callable, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import NamedTuple

import msgspec
import numpy as np

from evopolicy_common.errors import ConfigError, EvopolicyError, RefusedError
from evopolicy_common.messages.environment import Split
from evopolicy_common.messages.operator import RunResult, SubmitResult
from evopolicy_common.records import journal
from evopolicy_common.records.episodes.rendered import decode
from evopolicy_common.records.episodes.trajectory import Recorder, Trajectory
from evopolicy_common.records.policies.bundles import Bundle
from evopolicy_common.records.policies.checkpoints import bundle_of
from evopolicy_common.records.run_files import read_or_reason, run_folders
from evopolicy_common.records.run_record import RunRecord, decode_run_record, encode_run_record
from evopolicy_common.records.secrets import Passed, read_passed
from evopolicy_common.records.words import CANARY
from evopolicy_common.regular_files import read_regular
from evopolicy_common.wire.operator_client import TIMEOUT_S, OperatorClient
from evopolicy_common.wire.transport import Link
from evopolicy_results.publish import card as cards
from evopolicy_results.publish import contents, descriptions, scrub
from evopolicy_results.publish.archive import ArchiveWriter
from evopolicy_results.publish.contents import EpisodeGroup, Listed, Manifest, PublishedEpisode, Removed

Tell = Callable[[str], None]
_SHOWN = 20

_NEVER = {
    "trees/": "the agent's notes are its operator's; the policies are checkpoints, and digests stay",
    "workspace/": "feedback follows from the recorded actions; the final policy is a checkpoint",
    "replays/": "videos are not published",
    "notes, agent_host": "the operator's own labels and machines",
    "observations, stdout, stderr": "they follow from the recorded actions, or are free text",
}


class Published(msgspec.Struct, frozen=True, kw_only=True):
    path: str
    bytes: int
    runs: int
    signer: str
    journal_head: str
    removed: tuple[Removed, ...]
    left_out: tuple[Listed, ...]
    """Runs of the same entries that are not in the file."""
    folders_left_out: tuple[Removed, ...]
    """Run directories that are not in the file, with the reason."""
    completeness: str


class _GoneError(EvopolicyError):
    """The coordinator no longer has a run's episodes."""


def find_runs(paths: Sequence[Path]) -> tuple[list[tuple[Path, RunRecord]], list[Removed]]:
    """The finished runs in and below these folders, in the order of the coordinator's names, and the folders that are
    left out. ConfigError where no run is left."""
    runs: dict[str, tuple[Path, RunRecord]] = {}
    folders, without = run_folders(paths)
    left_out = [(path, "no run directory in it or below") for path in without]
    for folder in folders:
        record = read_or_reason(folder)
        if isinstance(record, str):
            why = record
        elif record.committed is None:
            why = "its run.json names no commitment"
        elif record.replay_of:
            why = f"it is a replay of run {record.replay_of}, and no run of its own"
        elif record.run in runs:
            why = f"it repeats the run in {runs[record.run][0]}"
        else:
            runs[record.run] = folder, record
            continue
        left_out.append((folder, why))
    attempts = [each for path in paths for each in path.rglob(".attempts") if each.is_dir()]
    left_out += [(each, "another attempt replaced it") for each in run_folders(attempts)[0]]
    removed = [Removed(what=str(folder), why=why) for folder, why in left_out]
    if not runs:
        listed = "; ".join(f"{each.what}: {each.why}" for each in removed[:8])
        raise ConfigError(f"no finished run to publish: {listed}")
    return [runs[run] for run in sorted(runs)], removed


class _Secret(NamedTuple):
    place: str
    """`FILE:LINE`; empty for a term of this machine."""
    what: str


class _Source(NamedTuple):
    folder: Path
    record: RunRecord
    passed: Passed | None


class Publisher:
    def __init__(
        self,
        link: Link,
        tell: Tell,
        needles: Sequence[scrub.Needle],
        *,
        with_logs: bool = False,
        remove_findings: bool = False,
        accepted: Sequence[str] = (),
    ) -> None:
        """`with_logs`: publish agents' logs too, with everything replaced that the search finds. `remove_findings`:
        leave out policies and recordings with secrets. `accepted`: `FILE:LINE` of each secret to be published as it
        is."""
        self._remove_findings = remove_findings
        self._accepted = frozenset(map(os.path.abspath, accepted))
        self._with_logs = with_logs
        self._ask = OperatorClient(link)
        self._tell = tell
        self._needles = needles
        logs, whose = ("logs/, but agent.jsonl", "") if with_logs else ("logs/", "agents' and ")
        never = {logs: f"{whose}programs' logs name paths, hosts and variables", **_NEVER}
        self._removed = [Removed(what=what, why=why) for what, why in never.items()]
        self._written: dict[str, str] = {}
        """Digests of the files in the archive, by name."""

    async def publish(
        self,
        runs: Sequence[tuple[Path, RunRecord]],
        out: Path,
        left_out: Sequence[Removed] = (),
        *,
        licence: str = "",
        card: Path | None = None,
    ) -> Published:
        """Writes `out` atomically. Raises ConfigError when the coordinator refuses. `left_out`: folders that are not
        published. `licence`: of the file, for its card. `card`: a folder for copies of card and descriptions."""
        sources = [_Source(folder, record, read_passed(folder)) for folder, record in runs]
        secrets = [
            secret
            for each in sources
            for path in sorted((each.folder / "checkpoints").glob("submit_*"))
            if (bundle := _bundle(path)) is not None
            for secret in self._in_policy(path, bundle, each.passed)
        ]
        self._stop_at(secrets)
        try:
            await self._ask.disclose(tuple(record.run for _, record in runs))
        except RefusedError as error:
            named = [str(folder) for folder, record in runs if record.run in str(error)]
            named = named or [each.what for each in left_out if "did not finish" in each.why]
            where = f" ({', '.join(named[:8])})" if named else ""
            raise ConfigError(f"{error}{where}") from error
        entries = await self._ask.journal()
        folders_left_out, described = list(left_out), list[cards.CardSource]()
        partial = out.with_name(f".{out.name}.partial")
        self._writer = ArchiveWriter(partial)
        try:
            for number, source in enumerate(sources):
                record, before = source.record, len(self._removed)
                self._tell(f"{number + 1} of {len(runs)}: {record.agent.entry} on {record.env}")
                try:
                    described.append(await self._add_run(source, f"runs/{len(described):04d}"))
                except _GoneError as error:  # before the first file
                    del self._removed[before:]
                    folders_left_out.append(Removed(what=str(source.folder), why=str(error)))
            if not described:
                last = folders_left_out[-1]
                raise ConfigError(f"no run to publish: {last.what}: {last.why}")
            self._add_clean(contents.JOURNAL, contents.journal_lines(entries))
            self._add_clean(contents.REMOVED, contents.document(tuple(self._removed)))
            head, software = journal.heads(entries)[-1], version("evopolicy")
            # The card names the key, so it is asked for before the manifest can be signed.
            signer = (await self._ask.sign(head)).key
            made = cards.make(described, entries, signer=signer, software=software, licence=licence)
            digests = dict(self._written)
            for name, data in descriptions.files(made, digests).items():
                self._add_clean(name, data)
            manifest = contents.document(
                Manifest(
                    format=contents.FORMAT,
                    version=contents.VERSION,
                    canary=CANARY,
                    software=software,
                    journal_entries=len(entries),
                    journal_head=head,
                    files={
                        name: digest
                        for name, digest in self._written.items()
                        if "/" not in name or name.endswith(f"/{contents.DIGESTS}")
                    },
                )
            )
            signed = await self._ask.sign(contents.digest(manifest))
            self._add(contents.MANIFEST, manifest)
            signature = contents.Signature(key=signed.key, signature=signed.signature)
            self._add(contents.SIGNATURE, contents.document(signature))
            self._writer.close()
            partial.replace(out)
        finally:
            partial.unlink(missing_ok=True)
        if card is not None:
            with out.open("rb") as stream:
                sha256 = hashlib.file_digest(stream, "sha256").hexdigest()
            file = descriptions.ArchiveFile(out.name, sha256, out.stat().st_size)
            for name, data in descriptions.files(made, digests, file).items():
                (card / name).write_bytes(data)
        listed = contents.listing(map(journal.read_entry, entries), [each.result.run for each in described])
        return Published(
            path=str(out),
            bytes=out.stat().st_size,
            runs=len(described),
            signer=signed.key,
            journal_head=head,
            removed=tuple(self._removed),
            left_out=tuple(each for each in listed if each.state != "published"),
            folders_left_out=tuple(folders_left_out),
            completeness=contents.completeness(listed),
        )

    def _add(self, name: str, data: bytes) -> None:
        self._writer.add(name, data)
        self._written[name] = contents.digest(data)

    def _add_clean(self, name: str, data: bytes, passed: Passed | None = None) -> None:
        """Adds a file that cannot be left out: ConfigError where the search finds anything in it."""
        self._stop_at(self._secrets(name, data, passed), always=True)
        if kinds := scrub.search(data, self._needles):
            raise ConfigError(
                f"{name} would reveal {kinds[0]}; nothing is published. Names of entries, models and experiments are"
                " published as they are: use other names for the runs, or unset a variable whose value is such a name"
            )
        self._add(name, data)

    def _leave_out(self, what: str, why: str) -> None:
        self._removed.append(Removed(what=what, why=why))

    async def _add_run(self, source: _Source, place: str) -> cards.CardSource:
        opened = await self._ask.opening(source.record.run)
        result = msgspec.json.decode(opened.result, type=RunResult)
        kept, removed = scrub.record(source.record)
        for each in removed:
            self._leave_out(f"{place}/run.json: {each.what}", each.why)
        groups: list[EpisodeGroup] = []
        recorded: dict[str, bytes] = {}
        for split, index, n in contents.wanted_groups(result):
            group, recordings = await self._group(source, split, index, n, place)
            groups.append(group)
            if recordings is not None:
                recorded[f"{place}/actions/{group.name}"] = recordings
        run_json, before = encode_run_record(kept), len(self._written)
        for name, data in (
            (contents.RUN, run_json),
            (contents.OPENING, opened.opening),
            (contents.SALT, opened.salt.hex().encode()),
            (contents.RESULT, opened.result),
            (contents.EPISODES, contents.document(tuple(groups))),
        ):
            self._add_clean(f"{place}/{name}", data, source.passed)
        for name, data in recorded.items():
            self._add(name, data)
        for submit in result.submits:
            path = f"{place}/{contents.checkpoint_path(submit.submit_index)}"
            if submit.bundle is not None and (packed := self._checkpoint(source, submit, path)) is not None:
                self._add(path, packed)
        if self._with_logs:
            self._add_log(source, f"{place}/{contents.LOG}")
        own = list(self._written.items())[before:]
        digests = {name.removeprefix(f"{place}/"): digest for name, digest in own}
        self._add(f"{place}/{contents.DIGESTS}", contents.document(digests))
        return cards.CardSource(place, decode_run_record(run_json), result)

    async def _group(
        self, source: _Source, split: Split, index: int, n: int, place: str
    ) -> tuple[EpisodeGroup, bytes | None]:
        """A group's returns, and its recordings packed; None where something in them must not be published."""
        run, name = source.record.run, contents.group_name(split, index)
        recorded = self._ask.recorded(run, split, index, timeout_s=TIMEOUT_S)
        outcomes = {outcome.index: outcome async for outcome in recorded}
        if not outcomes or (n >= 0 and len(outcomes) < n):
            raise _GoneError(
                f"the coordinator no longer has the episodes of {name}: `evopolicy gc` removed them"
            )
        episodes, recordings = [], []
        finds: list[_Secret] = []
        for number, outcome in sorted(outcomes.items()):
            episodes.append(
                PublishedEpisode(
                    index=number,
                    episode_return=outcome.episode_return,
                    length=outcome.length,
                    failure="" if outcome.failure is None else outcome.failure.category,
                )
            )
            data = None
            if outcome.trajectory is not None:
                trajectory = decode(await self._ask.fetch(outcome.trajectory))
                texts = _texts(trajectory)
                finds += self._terms(texts)
                finds += self._secrets(f"{place}/actions/{name}/{number}", texts, source.passed)
                data = actions_only(trajectory)
            recordings.append(data)
        group = EpisodeGroup(split=split, submit_index=index, episodes=tuple(episodes))
        if finds:
            self._stop_at(finds)
            self._leave_out(f"run {run}: actions of {name}", f"they held {finds[0].what}")
            return group, None
        return group, contents.pack_recordings(recordings)

    def _checkpoint(self, source: _Source, submit: SubmitResult, what: str) -> bytes | None:
        matches = sorted((source.folder / "checkpoints").glob(f"submit_*{submit.submit_index:03d}"))
        bundle = _bundle(matches[0]) if matches else None
        if bundle is None or bundle.digest != submit.bundle:
            self._leave_out(what, "the run directory does not hold the policy that was submitted")
            return None
        # The files may have changed since the first search.
        finds = [*self._terms(bundle.packed), *self._in_policy(matches[0], bundle, source.passed)]
        self._stop_at(finds)
        if finds:
            self._leave_out(what, f"it holds {finds[0].what}")
            return None
        return bundle.packed

    def _in_policy(self, folder: Path, bundle: Bundle, passed: Passed | None) -> list[_Secret]:
        """Secrets in a run directory's policy. In its log they are replaced."""
        names = "\n".join(file.path for file in bundle.files).encode()
        secrets = self._secrets(f"{folder} (names of files)", names, passed)
        for file in bundle.files:
            secrets += self._secrets(str(folder / file.path), file.data, passed)
        return secrets

    def _terms(self, data: bytes) -> list[_Secret]:
        return [_Secret("", what) for what in scrub.search(data, self._needles)]

    def _secrets(self, name: str, data: bytes, passed: Passed | None) -> list[_Secret]:
        """Secrets whose lines are not accepted."""
        lines = sorted(scrub.secret_lines(data, passed).items())
        places = [_Secret(f"{name}:{line}", what) for line, what in lines]
        return [each for each in places if os.path.abspath(each.place) not in self._accepted]

    def _stop_at(self, finds: Sequence[_Secret], *, always: bool = False) -> None:
        """Raises ConfigError for secrets, unless the files that hold them are left out."""
        secrets = [each for each in finds if each.place]
        if not secrets or (self._remove_findings and not always):
            return
        here = f"{os.getcwd()}/"
        shown = "; ".join(f"{each.place.removeprefix(here)}: {each.what}" for each in secrets[:_SHOWN])
        more = f"; and {len(secrets) - _SHOWN} more" if len(secrets) > _SHOWN else ""
        left_out = "" if always else "leave out these policies and recordings with --remove-findings, or "
        raise ConfigError(
            f"nothing is published, as this looks like secrets: {shown}{more}. Revoke real keys; then"
            f" {left_out}publish a line as it is with --accept-finding FILE:LINE"
        )

    def _add_log(self, source: _Source, name: str) -> None:
        """Adds the agent's log, if there is one, without what the search finds."""
        path = source.folder / (source.record.artifacts.logs_agent or "logs/agent.jsonl")
        try:
            log = read_regular(path, contents.MAX_DOCUMENT_BYTES)
        except FileNotFoundError:
            return
        except OSError as error:
            self._leave_out(name, error.strerror or "it cannot be read")
            return
        data, counts = scrub.redact(log, self._needles, source.passed)
        for kind, n in sorted(counts.items()):
            self._leave_out(f"{name}: {n} places", f"they held {kind}")
        self._add_clean(name, data, source.passed)


def _bundle(checkpoint: Path) -> Bundle | None:
    try:
        return bundle_of(checkpoint)
    except EvopolicyError:
        return None


def actions_only(trajectory: Trajectory) -> bytes:
    """A recording with its actions, rewards and ends, and nothing else."""
    recorder = Recorder("actions", trajectory.observations)
    for row in trajectory.rows():
        action = row.action
        kept = np.asarray(action) if isinstance(action, np.generic) else action
        recorder.append(None, kept, row.reward, row.terminated, row.truncated, {})
    return recorder.finish()


def _texts(trajectory: Trajectory) -> bytes:
    """The texts among the actions: arrays of numbers hold none."""
    actions = trajectory.actions
    if isinstance(actions, np.ndarray):
        return b"" if actions.dtype.kind in "biuf" else repr(actions.tolist()).encode()
    return "\n".join(repr(action) for action in actions if not isinstance(action, np.ndarray)).encode()


def needles_of_this_machine(link: Link, *folders: Path) -> tuple[scrub.Needle, ...]:
    """The search's terms: this process's environment, user, host and folders, and its credentials."""
    names = {getpass.getuser(): "the user's name", socket.gethostname(): "the host's name"}
    names.setdefault(socket.getfqdn(), "the host's full name")
    credentials = link.credentials
    paths = [str(Path.home()), os.getcwd(), *(str(folder.absolute()) for folder in folders)]
    return scrub.needles(os.environ, names, paths, (credentials.token, credentials.password))
