"""Paths of a run's files: `runs/<entry>/<env with _ for / and :>/<exp-id>/`, with the contents listed in `protocol.md`.

An entry's folder has its name, and a digest where a folder cannot have the name (`entry_folder`).

While a run is open its folder also holds `.gateway/` (mode 0700): the gateway's credentials, its port and token, the
journal and the bundles. It lies outside the workspace and is removed when `run.json` is written.
"""

from __future__ import annotations

import hashlib
import unicodedata
from pathlib import Path
from typing import TypeVar

import msgspec

from evopolicy_common.catalogue import folder_name
from evopolicy_common.errors import DECODE_ERRORS, ConfigError, raised_as
from evopolicy_common.messages.operator import CreateRun
from evopolicy_common.records import model_calls, model_record, open_run
from evopolicy_common.records.blobs import write_atomically
from evopolicy_common.records.policies.trees import HISTORY, TREES
from evopolicy_common.records.run_record import Artifacts
from evopolicy_common.records.secrets import PASSED
from evopolicy_common.records.suite_folder import INDEX, PAUSED
from evopolicy_common.wire import keys

T = TypeVar("T")

_PLAIN = frozenset("._()+ -")
"""Characters of folder names besides letters, digits and their marks."""
_MAX_BYTES = 100
"""Of an entry's folder, without its digest."""


class Place:
    """A path below a run's folder, as an attribute of `RunFolder`."""

    def __init__(self, path: str) -> None:
        self._path = path

    def __get__(self, folder: RunFolder, kind: type[RunFolder]) -> Path:
        return folder.root / self._path


class RunFolder(msgspec.Struct, frozen=True):
    root: Path

    workspace = Place("workspace")
    """The agent's working directory."""
    agents_md = Place("workspace/AGENTS.md")
    system = Place("workspace/system")
    """The policy that the agent edits."""
    feedback = Place("workspace/feedback")
    """The results of its submits, one folder each."""
    history = Place(f"workspace/{HISTORY}")
    """The feedback of the run that this one starts from, read-only."""
    checkpoints = Place("checkpoints")
    """The submitted policies with their metrics, written at the end."""
    trees = Place(TREES)
    """The workspace at each submit (`evopolicy_common.records.policies.trees`)."""
    run_json = Place("run.json")
    """The run's record, written last."""
    harness_log = Place("logs/harness.log")
    """The log of gateway and agent supervisor."""
    agent_log = Place("logs/agent.jsonl")
    """The prompts to the agent's programs and all their output."""
    model_requests = Place(model_calls.LEDGER)
    """The relay's ledger: a line for each request to the agent's model."""
    model_record = Place(model_record.FOLDER)
    """The record of the calls of the agent's model; see `evopolicy_common/records/model_record.py`."""
    env_log = Place("logs/env.log")
    """Played episodes with their results, written at the end."""
    passed = Place(PASSED)
    """Digests of values that the agent got; stays when the run ends, and is never published."""
    replay = Place(".replay.json")
    """`Recorded` (`run/recorded_agent.py`): what a replay of the agent needs; stays, and is never published."""

    def artifacts(self) -> Artifacts:
        """The existing files of a finished run, under their names in `run.json`."""

        def named(path: Path) -> str | None:
            return path.relative_to(self.root).as_posix() if path.exists() else None

        return Artifacts(
            workspace=named(self.workspace),
            feedback=named(self.feedback),
            checkpoints=named(self.checkpoints),
            logs_harness=named(self.harness_log),
            logs_agent=named(self.agent_log),
            logs_env=named(self.env_log),
        )

    state = Place(open_run.STATE)
    """The gateway's own folder, while the run is open."""
    credentials = Place(f"{open_run.STATE}/credentials.json")
    """The gateway's credentials, with the run's capability."""
    service = Place(f"{open_run.STATE}/service.json")
    """Port and token of the HTTP service, which a restarted gateway keeps."""
    listener = Place(open_run.LISTENER)
    """The address that serves a remote agent: `Listener`. Missing for an agent that is started here."""
    bearer = Place(f"{open_run.STATE}/bearer")
    """A remote agent's bearer token, as text."""
    closing = Place(f"{open_run.STATE}/closing.json")
    """The order to close the run (`CloseRun`), given once its agent has ended: repeated until the coordinator has
    closed the run, also after it was started on an earlier backup."""
    finish = Place(f"{open_run.STATE}/finish")
    """Created when the operator reports the end of an agent that was not started here."""
    journal = Place(open_run.JOURNAL)
    """The gateway's record of requests; see `journal.py`."""
    blobs = Place(open_run.BUNDLES)
    """Submitted snapshots of `system/`."""
    given_agents_md = Place(f"{open_run.STATE}/AGENTS.md")
    """The operator's text in place of `AGENTS.md`; missing: the standard text."""

    @property
    def run(self) -> str:
        """The cluster's id of the open run in the folder; empty without one. ConfigError for a damaged file."""
        return saved(self.intended, CreateRun).run if self.intended.exists() else ""

    @property
    def lock(self) -> Path:
        """Lock of the process that plays or replaces the run; beside the folder, which may be removed meanwhile."""
        return self.root.with_name(f".{self.root.name}.lock")

    @property
    def asked(self) -> Path:
        """`CreateRun` of a run that is to take the place of the folder's; beside it, as the lock."""
        return self.root.with_name(f".{self.root.name}.asked")

    supervisor_lock = Place(f"{open_run.STATE}/keeper.lock")
    """Lock of the agent supervisor while the agent may be alive, even if the command that started it was killed."""
    intended = Place(open_run.INTENDED)
    """The request to open the run, written before it is sent, and again with the id of the run: `CreateRun`."""
    session = Place(f"{open_run.STATE}/session.json")
    """A coding agent's session: `SessionState`."""
    times = Place(f"{open_run.STATE}/times.json")
    """Time spent on its train side so far: `Times`."""
    left = Place(f"{open_run.STATE}/left.json")
    """How much of its time and its model's tokens the agent has left, for `/info`; none with a published profile."""
    agent = Place(f"{open_run.STATE}/agent")
    """A jailed agent's files outside its workspace: home and /tmp."""
    start = Place(f"{open_run.STATE}/start.json")
    """`Start` of a run whose workspace is that of an earlier submit."""
    staged = Place(f"{open_run.STATE}/staged.json")
    """Hashes of the staged workspace: `Staged`."""


class Staged(msgspec.Struct, frozen=True, kw_only=True):
    """The initial contents of a workspace, for `run.json`. Hashes are SHA-256, hex."""

    agents_md_hash: str
    """Of `AGENTS.md`."""
    rules_hash: str
    """Of `AGENTS.md` with placeholders for the URLs: equal for runs with equal rules."""
    initial_policy_hash: str
    """Of `system/policy.py`."""


def entry_folder(entry: str) -> str:
    """The name of an entry's folder: the entry in NFC, 100 bytes at most, with `_` for each character that is not a
    letter, mark, digit or `._()+ -`, and without spaces and dots at its ends.

    Where that is not the whole name, or names a file of a sweep, 8 hexadecimal digits of the name's SHA-256 follow.
    Raises ConfigError for a name of spaces and dots alone.
    """
    text = unicodedata.normalize("NFC", entry)
    kept = (one if one in _PLAIN or unicodedata.category(one)[0] in "LMN" else "_" for one in text)
    name = "".join(kept).encode()[:_MAX_BYTES].decode(errors="ignore").strip(" .")
    if not name:
        raise ConfigError(f"entry {entry!r}: a name of more than spaces and dots is needed")
    if name == text and name.casefold() not in (INDEX, PAUSED):
        return name
    return f"{name}-{hashlib.sha256(text.encode(errors='backslashreplace')).hexdigest()[:8]}"


def run_folder(runs: Path, entry: str, env: str, exp_id: str) -> RunFolder:
    """Returns the folder of a run. Raises ConfigError for names that cannot be a folder's."""
    if not keys.valid_name(exp_id):
        raise ConfigError(f"--exp-id {exp_id!r}: letters, digits, '.', '_' and '-' only, 63 at most")
    above = runs.absolute() / entry_folder(entry)
    return RunFolder(above / folder_name(env) / exp_id)


def save(path: Path, value: msgspec.Struct) -> None:
    """Writes a small private file (mode 0600) of the gateway's folder."""
    write_atomically(path, msgspec.json.encode(value), mode=0o600)


def saved(path: Path, kind: type[T]) -> T:
    """Reads a file written by `save`. Raises FileNotFoundError when it is missing, ConfigError when it is damaged."""
    remedy = "restore it from a backup, or restart the run with --overwrite"
    with raised_as(ConfigError, f"{path} is damaged", *DECODE_ERRORS, remedy=remedy):
        return msgspec.json.decode(path.read_bytes(), type=kind)


def folder_of(path: Path) -> RunFolder:
    """Returns the run folder at `path`. Raises ConfigError when there is no such folder."""
    if not path.is_dir():
        raise ConfigError(
            f"{path} is not a folder; name a run directory such as runs/evolve/gym_acrobot/first"
        )
    return RunFolder(path.absolute())


def submit_id(index: int, episode_budget: int, prefix: str = "submit") -> str:
    """`submit_NNN`: the name of a submit in answers, and of its folder."""
    return f"{prefix}_{index:0{max(3, len(str(episode_budget)))}d}"


def episode_name(global_index: int, episode_budget: int) -> str:
    """`ep_XXX`: the name of an episode, counted over all attempted episodes of the run."""
    return submit_id(global_index, episode_budget, "ep")
