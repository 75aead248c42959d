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
from collections.abc import AsyncIterator, Callable, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import NamedTuple

import msgspec
import numpy as np

from evopolicy_common.errors import ConfigError, EvopolicyError, ProtocolError, RefusedError
from evopolicy_common.messages.environment import Split
from evopolicy_common.messages.episode import EpisodeOutcome
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

_LOGS = Removed(what="logs/", why="agents' and programs' logs name paths, hosts and variables")
_OTHER_LOGS = Removed(what="logs/, but agent.jsonl", why="programs' logs name paths, hosts and variables")
_NEVER = (
    Removed(
        what="trees/",
        why="the agent's notes are its operator's; the policies are checkpoints, and digests stay",
    ),
    Removed(
        what="workspace/", why="feedback follows from the recorded actions; the final policy is a checkpoint"
    ),
    Removed(what="replays/", why="videos are not published"),
    Removed(what="notes, agent_host", why="the operator's own labels and machines"),
    Removed(
        what="observations, stdout, stderr", why="they follow from the recorded actions, or are free text"
    ),
)


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
            left.append((folder, "the run did not finish: it has no run.json"))
        except OSError as error:
            left.append((folder, f"run.json cannot be read: {error.strerror}"))
        except ProtocolError as error:
            left.append((folder, str(error)))
        else:
            if record.committed is None:
                left.append(
                    (folder, "it has no commitment: its coordinator kept no journal when it opened the run")
                )
            elif record.replay_of:
                left.append((folder, f"it is a replay of run {record.replay_of}, and no run of its own"))
            elif record.run in found:
                left.append((folder, f"it repeats the run in {found[record.run][0]}"))
            else:
                found[record.run] = folder, record
    attempts = [each for path in paths for each in path.rglob(".attempts") if each.is_dir()]
    left += [(each, "another attempt replaced it") for each in run_folders(attempts)[0]]
    removed = [Removed(what=str(folder), why=why) for folder, why in left]
    if not found:
        listed = "; ".join(f"{each.what}: {each.why}" for each in removed[:8])
        raise ConfigError(f"no finished run to publish: {listed}")
    return [found[run] for run in sorted(found)], removed


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
        self._removed: list[Removed] = [_OTHER_LOGS if with_logs else _LOGS, *_NEVER]

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
        ids: list[str] = []
        passed = [read_passed(folder) for folder, _ in runs]
        self._stop_at(
            [
                secret
                for (folder, _), each in zip(runs, passed, strict=True)
                for secret in self._in_folder(folder, each)
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
        files: dict[str, str] = {}
        described: dict[str, str] = {}
        sources: list[cards.Source] = []
        partial = out.with_name(f".{out.name}.partial")
        writer = Writer(partial)
        try:
            for number, (folder, record) in enumerate(runs):
                self._tell(f"{number + 1} of {len(runs)}: {record.agent.entry} on {record.env}")
                place = contents.run_folder(len(ids))
                inner: dict[str, str] = {}
                documents: dict[str, bytes] = {}
                before = len(self._removed)
                try:
                    async for name, data in self._run_files(folder, record, place, passed[number]):
                        writer.add(f"{place}/{name}", data)
                        inner[name] = contents.digest(data)
                        if name in (contents.RUN, contents.RESULT):
                            documents[name] = data
                except _GoneError as error:  # before the first file
                    del self._removed[before:]
                    left.append(Removed(what=str(folder), why=str(error)))
                    continue
                digests = contents.document(inner)
                writer.add(f"{place}/{contents.DIGESTS}", digests)
                files[f"{place}/{contents.DIGESTS}"] = contents.digest(digests)
                described |= {f"{place}/{name}": each for name, each in inner.items()}
                result = msgspec.json.decode(documents[contents.RESULT], type=Result)
                sources.append(cards.Source(place, decode_run_record(documents[contents.RUN]), result))
                ids.append(record.run)
            if not ids:
                raise ConfigError(f"no run to publish: {left[-1].what}: {left[-1].why}")
            lines = contents.journal_lines(entries)
            for name, data in (
                (contents.JOURNAL, lines),
                (contents.REMOVED, contents.document(tuple(self._removed))),
            ):
                self._must_be_clean(name, data)
                writer.add(name, data)
                files[name] = contents.digest(data)
            heads = journal.heads(entries)
            made = cards.make(
                sources,
                entries,
                # The card names the key, so it is asked for before the manifest can be signed.
                signer=(await self._ask.sign(heads[-1])).key,
                software=version("evopolicy"),
                licence=licence,
            )
            described |= files
            for name, data in descriptions.files(made, described).items():
                self._must_be_clean(name, data)
                writer.add(name, data)
                files[name] = contents.digest(data)
            manifest = contents.document(
                Manifest(
                    format=contents.FORMAT,
                    version=contents.VERSION,
                    canary=CANARY,
                    software=version("evopolicy"),
                    journal_entries=len(entries),
                    journal_head=heads[-1],
                    files=files,
                )
            )
            signed = await self._ask.sign(contents.digest(manifest))
            writer.add(contents.MANIFEST, manifest)
            signature = contents.Signature(key=signed.key, signature=signed.signature)
            writer.add(contents.SIGNATURE, contents.document(signature))
            writer.close()
            partial.replace(out)
            if card is not None:
                with out.open("rb") as stream:
                    sha256 = hashlib.file_digest(stream, "sha256").hexdigest()
                file = descriptions.File(out.name, sha256, out.stat().st_size)
                for name, data in descriptions.files(made, described, file).items():
                    (card / name).write_bytes(data)
        finally:
            partial.unlink(missing_ok=True)
        listed = contents.listing(map(journal.read_entry, entries), ids)
        return Published(
            path=str(out),
            bytes=out.stat().st_size,
            runs=len(ids),
            signer=signed.key,
            journal_head=heads[-1],
            removed=tuple(self._removed),
            left_out=tuple(each for each in listed if each.state != "published"),
            folders_left_out=tuple(left),
            completeness=contents.completeness(listed),
        )

    async def _run_files(
        self, folder: Path, record: RunRecord, place: str, passed: Passed | None
    ) -> AsyncIterator[tuple[str, bytes]]:
        opened = await self._ask.opening(record.run)
        result = msgspec.json.decode(opened.result, type=Result)
        kept, removed = scrub.record(record)
        self._removed += [Removed(what=f"{place}/run.json: {each.what}", why=each.why) for each in removed]
        groups: list[Group] = []
        recorded: list[tuple[str, bytes]] = []
        for split, index, n in contents.wanted_groups(result):
            group, recordings = await self._group(record.run, split, index, n, place, passed)
            groups.append(group)
            if recordings is not None:
                recorded.append((f"actions/{group.name}", recordings))
        for name, data in (
            (contents.RUN, encode_run_record(kept)),
            (contents.OPENING, opened.opening),
            (contents.SALT, opened.salt.hex().encode()),
            (contents.RESULT, opened.result),
            (contents.EPISODES, contents.document(tuple(groups))),
        ):
            self._must_be_clean(f"{place}/{name}", data, passed)
            yield name, data
        for name, data in recorded:
            yield name, data
        for submit in result.submits:
            packed = self._checkpoint(folder, submit, place, passed)
            if packed is not None:
                yield contents.checkpoint_path(submit.submit_index), packed
        if self._with_logs and (log := self._log(folder, record, place, passed)) is not None:
            yield contents.LOG, log

    async def _group(
        self, run: str, split: Split, index: int, n: int, place: str, passed: Passed | None
    ) -> tuple[Group, bytes | None]:
        """A group's returns, and its recordings packed; None where something in them must not be published."""
        outcomes: dict[int, EpisodeOutcome] = {}
        async for outcome in self._ask.recorded(run, split, index, timeout_s=TIMEOUT_S):
            outcomes[outcome.index] = outcome
        name = contents.group_name(split, index)
        if not outcomes or (n >= 0 and len(outcomes) < n):
            raise _GoneError(
                f"the coordinator no longer has the episodes of {name}: `evopolicy gc` removed them"
            )
        episodes = []
        recordings: list[bytes | None] = []
        found: list[str | _Secret] = []
        for number in sorted(outcomes):
            outcome = outcomes[number]
            episodes.append(
                Episode(
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
                found += scrub.search(texts, self._needles)
                found += self._secrets(f"{place}/actions/{name}/{number}", texts, passed)
                data = actions_only(trajectory)
            recordings.append(data)
        group = Group(split=split, submit_index=index, episodes=tuple(episodes))
        if found:
            self._stop_at([each for each in found if isinstance(each, _Secret)])
            self._removed.append(
                Removed(what=f"run {run}: actions of {name}", why=f"they held {_kind(found[0])}")
            )
            return group, None
        return group, contents.pack_recordings(recordings)

    def _checkpoint(
        self, folder: Path, submit: SubmitResult, place: str, passed: Passed | None
    ) -> bytes | None:
        if submit.bundle is None:
            return None
        what = f"{place}/{contents.checkpoint_path(submit.submit_index)}"
        matches = sorted((folder / "checkpoints").glob(f"submit_*{submit.submit_index:03d}"))
        bundle = _bundle(matches[0]) if matches else None
        if bundle is None or bundle.digest != submit.bundle:
            why = "the run directory does not hold the policy that was submitted"
            self._removed.append(Removed(what=what, why=why))
            return None
        kept_back = self._in_policy(matches[0], bundle, passed)
        # Of files that have changed since the first look.
        self._stop_at(kept_back)
        found: list[str | _Secret] = [*scrub.search(bundle.packed, self._needles), *kept_back]
        if found:
            self._removed.append(Removed(what=what, why=f"it holds {_kind(found[0])}"))
            return None
        return bundle.packed

    def _in_folder(self, folder: Path, passed: Passed | None) -> list[_Secret]:
        """Secrets in a run directory's files, apart from the log, in which they are replaced."""
        found: list[_Secret] = []
        for path in sorted((folder / "checkpoints").glob("submit_*")):
            if (bundle := _bundle(path)) is not None:
                found += self._in_policy(path, bundle, passed)
        return found

    def _in_policy(self, folder: Path, bundle: Bundle, passed: Passed | None) -> list[_Secret]:
        names = "\n".join(file.path for file in bundle.files).encode()
        found = self._secrets(f"{folder} (names of files)", names, passed)
        for file in bundle.files:
            found += self._secrets(str(folder / file.path), file.data, passed)
        return found

    def _secrets(self, name: str, data: bytes, passed: Passed | None) -> list[_Secret]:
        """Secrets whose lines are not accepted."""
        lines = scrub.secret_lines(data, passed)
        found = [_Secret(f"{name}:{line}", what) for line, what in sorted(lines.items())]
        return [each for each in found if os.path.abspath(each.place) not in self._accepted]

    def _stop_at(self, found: Sequence[_Secret], *, always: bool = False) -> None:
        """Raises ConfigError for secrets, unless what holds them is left out."""
        if not found or (self._remove_findings and not always):
            return
        here = f"{os.getcwd()}/"
        shown = "; ".join(f"{each.place.removeprefix(here)}: {each.what}" for each in found[:_SHOWN])
        more = f"; and {len(found) - _SHOWN} more" if len(found) > _SHOWN else ""
        left_out = "" if always else "leave out these policies and recordings with --remove-findings, or "
        raise ConfigError(
            f"nothing is published, as this looks like secrets: {shown}{more}. Revoke real keys; then {left_out}publish"
            " a line as it is with --accept-finding FILE:LINE"
        )

    def _log(self, folder: Path, record: RunRecord, place: str, passed: Passed | None) -> bytes | None:
        """The agent's log without what the search finds; None where there is none to publish."""
        path = folder / (record.artifacts.logs_agent or "logs/agent.jsonl")
        what = f"{place}/{contents.LOG}"
        try:
            log = read_regular(path, contents.MAX_DOCUMENT_BYTES)
            data, counts = scrub.redact(log, self._needles, passed)
        except FileNotFoundError:
            return None
        except OSError as error:
            self._removed.append(Removed(what=what, why=error.strerror or "it cannot be read"))
            return None
        for found, n in sorted(counts.items()):
            self._removed.append(Removed(what=f"{what}: {n} places", why=f"they held {found}"))
        self._must_be_clean(what, data, passed)
        return data

    def _must_be_clean(self, name: str, data: bytes, passed: Passed | None = None) -> None:
        self._stop_at(self._secrets(name, data, passed), always=True)
        if found := scrub.search(data, self._needles):
            raise ConfigError(
                f"{name} would reveal {found[0]}; nothing is published. Names of entries, models and experiments are"
                " published as they are: use other names for the runs, or unset a variable whose value is such a name"
            )


class _Secret(NamedTuple):
    place: str
    """`FILE:LINE`."""
    what: str


def _kind(found: str | _Secret) -> str:
    return found.what if isinstance(found, _Secret) else found


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
