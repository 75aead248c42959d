"""Collects what is published of runs: from their directories and from the coordinator that made them.

Rules that this module owns:
- The coordinator is asked to disclose the runs' cases before anything of them is read: it refuses while it must.
- What is collected depends on the runs and the journal alone, and is written in a fixed order: publishing again gives
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

from evopolicy_common.errors import ConfigError, EvopolicyError, ProtocolError, RefusedError
from evopolicy_common.messages.environment import Split
from evopolicy_common.records import journal
from evopolicy_common.records.canary import CANARY
from evopolicy_common.records.episodes.rendered import decode
from evopolicy_common.records.episodes.trajectory import Recorder, Trajectory
from evopolicy_common.records.journal import Result, SubmitResult
from evopolicy_common.records.policies.bundles import Bundle
from evopolicy_common.records.policies.checkpoints import bundle_of
from evopolicy_common.records.run_files import read_record, run_folders
from evopolicy_common.records.run_record import RunRecord, decode_run_record, encode_run_record
from evopolicy_common.records.secrets import Passed, read_passed
from evopolicy_common.regular_files import read_regular
from evopolicy_common.wire.operator_client import TIMEOUT_S, OperatorClient
from evopolicy_common.wire.transport import Link
from evopolicy_results.publish import card as cards
from evopolicy_results.publish import contents, descriptions, scrub
from evopolicy_results.publish.archive import Writer
from evopolicy_results.publish.contents import Episode, Group, Listed, Manifest, Removed

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
    """The published runs."""

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
    found: dict[str, tuple[Path, RunRecord]] = {}
    folders, without = run_folders(paths)
    left = [(path, "no run directory in it or below") for path in without]
    for folder in folders:
        try:
            record = read_record(folder)
        except FileNotFoundError:
            why = "the run did not finish: it has no run.json"
        except OSError as error:
            why = f"run.json cannot be read: {error.strerror}"
        except ProtocolError as error:
            why = str(error)
        else:
            if record.committed is None:
                why = "it has no commitment: its coordinator kept no journal when it opened the run"
            elif record.replay_of:
                why = f"it is a replay of run {record.replay_of}, and no run of its own"
            elif record.run in found:
                why = f"it repeats the run in {found[record.run][0]}"
            else:
                found[record.run] = folder, record
                continue
        left.append((folder, why))
    attempts = [each for path in paths for each in path.rglob(".attempts") if each.is_dir()]
    left += [(each, "another attempt replaced it") for each in run_folders(attempts)[0]]
    removed = [Removed(what=str(folder), why=why) for folder, why in left]
    if not found:
        listed = "; ".join(f"{each.what}: {each.why}" for each in removed[:8])
        raise ConfigError(f"no finished run to publish: {listed}")
    return [found[run] for run in sorted(found)], removed


class _Secret(NamedTuple):
    place: str
    """`FILE:LINE`; empty for a term of this machine."""
    what: str


class _Source(NamedTuple):
    """A run that is published."""

    folder: Path
    record: RunRecord
    passed: Passed | None


class Publisher:
    """One publication."""

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
        left: Sequence[Removed] = (),
        *,
        licence: str = "",
        card: Path | None = None,
    ) -> Published:
        """Writes `out` atomically. Raises ConfigError when the coordinator refuses. `left`: folders that are
        left out. `licence`: of the file, for its card. `card`: a folder for copies of card and descriptions."""
        left = list(left)
        sources = [_Source(folder, record, read_passed(folder)) for folder, record in runs]
        self._stop_at(
            [
                secret
                for each in sources
                for path in sorted((each.folder / "checkpoints").glob("submit_*"))
                if (bundle := _bundle(path)) is not None
                for secret in self._in_policy(path, bundle, each.passed)
            ]
        )
        try:
            await self._ask.disclose(tuple(record.run for _, record in runs))
        except RefusedError as error:
            named = [str(folder) for folder, record in runs if record.run in str(error)]
            named = named or [each.what for each in left if "did not finish" in each.why]
            where = f" ({', '.join(named[:8])})" if named else ""
            raise ConfigError(f"{error}{where}") from error
        entries = await self._ask.journal()
        described: list[cards.Source] = []
        partial = out.with_name(f".{out.name}.partial")
        writer = self._writer = Writer(partial)
        try:
            for number, source in enumerate(sources):
                record = source.record
                self._tell(f"{number + 1} of {len(runs)}: {record.agent.entry} on {record.env}")
                before = len(self._removed)
                try:
                    described.append(await self._add_run(source, f"runs/{len(described):04d}"))
                except _GoneError as error:  # before the first file
                    del self._removed[before:]
                    left.append(Removed(what=str(source.folder), why=str(error)))
            if not described:
                raise ConfigError(f"no run to publish: {left[-1].what}: {left[-1].why}")
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
            writer.close()
            partial.replace(out)
            if card is not None:
                with out.open("rb") as stream:
                    sha256 = hashlib.file_digest(stream, "sha256").hexdigest()
                file = descriptions.File(out.name, sha256, out.stat().st_size)
                for name, data in descriptions.files(made, digests, file).items():
                    (card / name).write_bytes(data)
        finally:
            partial.unlink(missing_ok=True)
        ids = [each.result.run for each in described]
        listed = contents.listing(map(journal.read_entry, entries), ids)
        return Published(
            path=str(out),
            bytes=out.stat().st_size,
            runs=len(ids),
            signer=signed.key,
            journal_head=head,
            removed=tuple(self._removed),
            left_out=tuple(each for each in listed if each.state != "published"),
            folders_left_out=tuple(left),
            completeness=contents.completeness(listed),
        )

    def _add(self, name: str, data: bytes) -> None:
        self._writer.add(name, data)
        self._written[name] = contents.digest(data)

    def _add_clean(self, name: str, data: bytes, passed: Passed | None = None) -> None:
        self._must_be_clean(name, data, passed)
        self._add(name, data)

    def _leave_out(self, what: str, why: str) -> None:
        self._removed.append(Removed(what=what, why=why))

    async def _add_run(self, source: _Source, place: str) -> cards.Source:
        record = source.record
        opened = await self._ask.opening(record.run)
        result = msgspec.json.decode(opened.result, type=Result)
        kept, removed = scrub.record(record)
        for each in removed:
            self._leave_out(f"{place}/run.json: {each.what}", each.why)
        groups: list[Group] = []
        recorded: dict[str, bytes] = {}
        for split, index, n in contents.wanted_groups(result):
            group, recordings = await self._group(source, split, index, n, place)
            groups.append(group)
            if recordings is not None:
                recorded[f"{place}/actions/{group.name}"] = recordings
        run_json = encode_run_record(kept)
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
        if self._with_logs and (log := self._log(source, f"{place}/{contents.LOG}")) is not None:
            self._add(f"{place}/{contents.LOG}", log)
        own = {
            name.removeprefix(f"{place}/"): digest
            for name, digest in self._written.items()
            if name.startswith(f"{place}/")
        }
        self._add(f"{place}/{contents.DIGESTS}", contents.document(own))
        return cards.Source(place, decode_run_record(run_json), result)

    async def _group(
        self, source: _Source, split: Split, index: int, n: int, place: str
    ) -> tuple[Group, bytes | None]:
        """A group's returns, and its recordings packed; None where something in them must not be published."""
        run, name = source.record.run, contents.group_name(split, index)
        recorded = self._ask.recorded(run, split, index, timeout_s=TIMEOUT_S)
        outcomes = {outcome.index: outcome async for outcome in recorded}
        if not outcomes or (n >= 0 and len(outcomes) < n):
            raise _GoneError(
                f"the coordinator no longer has the episodes of {name}: `evopolicy gc` removed them"
            )
        episodes = []
        recordings: list[bytes | None] = []
        found: list[_Secret] = []
        for number, outcome in sorted(outcomes.items()):
            failure = "" if outcome.failure is None else outcome.failure.category
            episodes.append(
                Episode(
                    index=number,
                    episode_return=outcome.episode_return,
                    length=outcome.length,
                    failure=failure,
                )
            )
            data = None
            if outcome.trajectory is not None:
                trajectory = decode(await self._ask.fetch(outcome.trajectory))
                texts = _texts(trajectory)
                found += self._terms(texts)
                found += self._secrets(f"{place}/actions/{name}/{number}", texts, source.passed)
                data = actions_only(trajectory)
            recordings.append(data)
        group = Group(split=split, submit_index=index, episodes=tuple(episodes))
        if found:
            self._stop_at(found)
            self._leave_out(f"run {run}: actions of {name}", f"they held {found[0].what}")
            return group, None
        return group, contents.pack_recordings(recordings)

    def _checkpoint(self, source: _Source, submit: SubmitResult, what: str) -> bytes | None:
        matches = sorted((source.folder / "checkpoints").glob(f"submit_*{submit.submit_index:03d}"))
        bundle = _bundle(matches[0]) if matches else None
        if bundle is None or bundle.digest != submit.bundle:
            self._leave_out(what, "the run directory does not hold the policy that was submitted")
            return None
        # Of files that have changed since the first look.
        found = [*self._terms(bundle.packed), *self._in_policy(matches[0], bundle, source.passed)]
        self._stop_at(found)
        if found:
            self._leave_out(what, f"it holds {found[0].what}")
            return None
        return bundle.packed

    def _in_policy(self, folder: Path, bundle: Bundle, passed: Passed | None) -> list[_Secret]:
        """Secrets in a run directory's policy. In its log they are replaced."""
        names = "\n".join(file.path for file in bundle.files).encode()
        found = self._secrets(f"{folder} (names of files)", names, passed)
        for file in bundle.files:
            found += self._secrets(str(folder / file.path), file.data, passed)
        return found

    def _terms(self, data: bytes) -> list[_Secret]:
        return [_Secret("", what) for what in scrub.search(data, self._needles)]

    def _secrets(self, name: str, data: bytes, passed: Passed | None) -> list[_Secret]:
        """Secrets whose lines are not accepted."""
        lines = scrub.secret_lines(data, passed)
        found = [_Secret(f"{name}:{line}", what) for line, what in sorted(lines.items())]
        return [each for each in found if os.path.abspath(each.place) not in self._accepted]

    def _stop_at(self, found: Sequence[_Secret], *, always: bool = False) -> None:
        """Raises ConfigError for secrets, unless what holds them is left out."""
        found = [each for each in found if each.place]
        if not found or (self._remove_findings and not always):
            return
        here = f"{os.getcwd()}/"
        shown = "; ".join(f"{each.place.removeprefix(here)}: {each.what}" for each in found[:_SHOWN])
        more = f"; and {len(found) - _SHOWN} more" if len(found) > _SHOWN else ""
        left_out = "" if always else "leave out these policies and recordings with --remove-findings, or "
        raise ConfigError(
            f"nothing is published, as this looks like secrets: {shown}{more}. Revoke real keys; then"
            f" {left_out}publish a line as it is with --accept-finding FILE:LINE"
        )

    def _log(self, source: _Source, what: str) -> bytes | None:
        """The agent's log without what the search finds; None where there is none to publish."""
        path = source.folder / (source.record.artifacts.logs_agent or "logs/agent.jsonl")
        try:
            log = read_regular(path, contents.MAX_DOCUMENT_BYTES)
        except FileNotFoundError:
            return None
        except OSError as error:
            self._leave_out(what, error.strerror or "it cannot be read")
            return None
        data, counts = scrub.redact(log, self._needles, source.passed)
        for found, n in sorted(counts.items()):
            self._leave_out(f"{what}: {n} places", f"they held {found}")
        self._must_be_clean(what, data, source.passed)
        return data

    def _must_be_clean(self, name: str, data: bytes, passed: Passed | None = None) -> None:
        self._stop_at(self._secrets(name, data, passed), always=True)
        if found := scrub.search(data, self._needles):
            raise ConfigError(
                f"{name} would reveal {found[0]}; nothing is published. Names of entries, models and experiments are"
                " published as they are: use other names for the runs, or unset a variable whose value is such a name"
            )


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
