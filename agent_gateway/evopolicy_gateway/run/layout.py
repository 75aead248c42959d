"""Where a run's files are: `runs/<entry>/<env with / as _>/<exp-id>/`, and in it what `protocol.md` lists.

While a run is open its folder also holds `.gateway/` (mode 0700): the gateway's credentials, its port and token, the
journal and the bundles. It lies outside the workspace and is removed when `run.json` is written.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import TypeVar

import msgspec

from evopolicy_common.errors import DECODE_ERRORS, ConfigError
from evopolicy_common.messages.operator import RunSettings
from evopolicy_common.records.blobs import write_atomically
from evopolicy_common.records.run_record import Artifacts
from evopolicy_common.wire import keys

T = TypeVar("T")

_ODD = re.compile(r"[^A-Za-z0-9._()+ -]")


class RunFolder(msgspec.Struct, frozen=True):
    """Paths of one run."""

    root: Path

    @property
    def workspace(self) -> Path:
        """The agent's working directory."""
        return self.root / "workspace"

    @property
    def agents_md(self) -> Path:
        """The rules."""
        return self.workspace / "AGENTS.md"

    @property
    def system(self) -> Path:
        """The policy that the agent edits."""
        return self.workspace / "system"

    @property
    def feedback(self) -> Path:
        """What came of its submits, a folder each."""
        return self.workspace / "feedback"

    @property
    def checkpoints(self) -> Path:
        """The submitted policies with their metrics, written at the end."""
        return self.root / "checkpoints"

    @property
    def run_json(self) -> Path:
        """The run's record, written last."""
        return self.root / "run.json"

    @property
    def harness_log(self) -> Path:
        """What gateway and agent supervisor say."""
        return self.root / "logs" / "harness.log"

    @property
    def agent_log(self) -> Path:
        """All that the agent's programs say, and what they were told."""
        return self.root / "logs" / "agent.jsonl"

    @property
    def env_log(self) -> Path:
        """What was played and what came of it, written at the end."""
        return self.root / "logs" / "env.log"

    def artifacts(self) -> Artifacts:
        """What there is of a finished run, as `run.json` names it."""
        places = {
            "workspace": self.workspace,
            "feedback": self.feedback,
            "checkpoints": self.checkpoints,
            "logs_harness": self.harness_log,
            "logs_agent": self.agent_log,
            "logs_env": self.env_log,
        }
        found = {name: path for name, path in places.items() if path.exists()}
        return Artifacts(**{name: path.relative_to(self.root).as_posix() for name, path in found.items()})

    @property
    def state(self) -> Path:
        """The gateway's own folder, while the run is open."""
        return self.root / ".gateway"

    @property
    def credentials(self) -> Path:
        """The gateway's own, with the run's capability."""
        return self.state / "credentials.json"

    @property
    def service(self) -> Path:
        """Port and token of the HTTP service, so that a restarted gateway has the same."""
        return self.state / "service.json"

    @property
    def listener(self) -> Path:
        """Where a remote agent is served: `Listener`. Not there for an agent that is started here."""
        return self.state / "door.json"

    @property
    def bearer(self) -> Path:
        """A remote agent's bearer token, as text."""
        return self.state / "bearer"

    @property
    def finish(self) -> Path:
        """Made when the operator says that an agent that is not in our hands has ended."""
        return self.state / "finish"

    @property
    def unwatched(self) -> Path:
        """Made by a gateway that was started by hand: nobody watches the agent, so only the operator knows its end."""
        return self.state / "unwatched"

    @property
    def journal(self) -> Path:
        """What the gateway has begun; see `journal.py`."""
        return self.state / "journal.jsonl"

    @property
    def blobs(self) -> Path:
        """Snapshots of `system/` that were submitted."""
        return self.state / "bundles"

    @property
    def opened(self) -> Path:
        """Which run this is: `OpenedRun`."""
        return self.state / "run.json"

    @property
    def lock(self) -> Path:
        """Held by the process that plays the run, or replaces it: beside the folder, which may be removed meanwhile."""
        return self.root.with_name(f".{self.root.name}.lock")

    @property
    def supervisor_lock(self) -> Path:
        """Held by the agent supervisor as long as the agent may be alive, also when the command that started it was killed."""
        return self.state / "keeper.lock"

    @property
    def intended(self) -> Path:
        """What the coordinator is asked to open, written before it is asked: `IntendedRun`."""
        return self.state / "intended.json"

    @property
    def session(self) -> Path:
        """A coding agent's session: `SessionState`."""
        return self.state / "session.json"

    @property
    def times(self) -> Path:
        """How long its train side has taken so far: `Times`."""
        return self.state / "times.json"

    @property
    def agent(self) -> Path:
        """What a jailed agent has outside its workspace: home and /tmp."""
        return self.state / "agent"

    @property
    def staged(self) -> Path:
        """What was put into the workspace: `Staged`."""
        return self.state / "staged.json"


class OpenedRun(msgspec.Struct, frozen=True, kw_only=True):
    """Which run of the cluster a folder is for."""

    run: str


class IntendedRun(msgspec.Struct, frozen=True, kw_only=True):
    """What a command that is killed in between must ask again, word for word, to come to the same run."""

    key: str
    settings: RunSettings


class Staged(msgspec.Struct, frozen=True, kw_only=True):
    """What a workspace started with, for `run.json`. Hashes are SHA-256, hex."""

    agents_md_hash: str
    """Of the rules, with placeholders for the URLs: equal for runs with equal rules."""
    agents_md_file_hash: str = ""
    """Of `AGENTS.md`; empty in a workspace of an earlier version."""
    initial_policy_hash: str
    """Of `system/policy.py`."""
    n_train: int
    """Train cases."""
    min_episodes_per_submit: int
    max_episodes_per_submit: int


def run_folder(runs: Path, entry: str, env: str, exp_id: str) -> RunFolder:
    """The folder of a run. ConfigError for names that cannot be a folder's."""
    if not keys.valid_name(exp_id):
        raise ConfigError(f"--exp-id {exp_id!r}: letters, digits, '.', '_' and '-' only, 63 at most")
    name = _ODD.sub("_", entry).strip(" .")
    if not name or len(name) > 100:
        raise ConfigError(f"entry {entry!r}: a name of 1 to 100 characters is needed")
    return RunFolder((runs / name / env.replace("/", "_") / exp_id).absolute())


def save(path: Path, value: msgspec.Struct) -> None:
    """Writes a small private file of the gateway's folder."""
    write_atomically(path, msgspec.json.encode(value), mode=0o600)


def saved(path: Path, kind: type[T]) -> T:
    """What `save` wrote. FileNotFoundError where there is nothing, ConfigError where a disk has damaged it."""
    try:
        return msgspec.json.decode(path.read_bytes(), type=kind)
    except DECODE_ERRORS as error:
        raise ConfigError(
            f"{path} is damaged: {error}; restore it from a backup, or begin the run anew with --overwrite"
        ) from error


def folder_of(path: Path) -> RunFolder:
    """The run folder at `path`; ConfigError when there is no such folder."""
    if not path.is_dir():
        raise ConfigError(
            f"{path} is not a folder; name a run directory such as runs/evolve/gym_acrobot/first"
        )
    return RunFolder(path.absolute())
