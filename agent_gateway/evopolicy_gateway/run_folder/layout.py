"""Paths of a run's files: `runs/<entry>/<env with _ for / and :>/<exp-id>/`, with the contents listed in `protocol.md`.

While a run is open its folder also holds `.gateway/` (mode 0700): the gateway's credentials, its port and token, the
journal and the bundles. It lies outside the workspace and is removed when `run.json` is written.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import TypeVar

import msgspec

from evopolicy_common.catalogue import earlier_folder_name, folder_name
from evopolicy_common.errors import DECODE_ERRORS, ConfigError
from evopolicy_common.records import model_calls, model_record, open_run
from evopolicy_common.records.blobs import write_atomically
from evopolicy_common.records.policies.trees import HISTORY, TREES
from evopolicy_common.records.run_record import Artifacts
from evopolicy_common.records.secrets import PASSED
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
        """The rules for the agent."""
        return self.workspace / "AGENTS.md"

    @property
    def system(self) -> Path:
        """The policy that the agent edits."""
        return self.workspace / "system"

    @property
    def feedback(self) -> Path:
        """The results of its submits, one folder each."""
        return self.workspace / "feedback"

    @property
    def history(self) -> Path:
        """The feedback of the run that this one starts from, read-only."""
        return self.workspace / HISTORY

    @property
    def checkpoints(self) -> Path:
        """The submitted policies with their metrics, written at the end."""
        return self.root / "checkpoints"

    @property
    def trees(self) -> Path:
        """The workspace at each submit (`evopolicy_common.records.policies.trees`)."""
        return self.root / TREES

    @property
    def run_json(self) -> Path:
        """The run's record, written last."""
        return self.root / "run.json"

    @property
    def harness_log(self) -> Path:
        """The log of gateway and agent supervisor."""
        return self.root / "logs" / "harness.log"

    @property
    def agent_log(self) -> Path:
        """The prompts to the agent's programs and all their output."""
        return self.root / "logs" / "agent.jsonl"

    @property
    def model_requests(self) -> Path:
        """The relay's ledger: a line for each request to the agent's model."""
        return self.root / model_calls.LEDGER

    @property
    def model_record(self) -> Path:
        """The record of the calls of the agent's model; see `evopolicy_common/records/model_record.py`."""
        return self.root / model_record.FOLDER

    @property
    def env_log(self) -> Path:
        """Played episodes with their results, written at the end."""
        return self.root / "logs" / "env.log"

    @property
    def passed(self) -> Path:
        """Digests of values that the agent got; stays when the run ends, and is never published."""
        return self.root / PASSED

    @property
    def replay(self) -> Path:
        """`Recorded` (`run/recorded_agent.py`): what a replay of the agent needs; stays, and is never published."""
        return self.root / ".replay.json"

    def artifacts(self) -> Artifacts:
        """The existing files of a finished run, under their names in `run.json`."""
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
        return self.root / open_run.STATE

    @property
    def credentials(self) -> Path:
        """The gateway's credentials, with the run's capability."""
        return self.state / "credentials.json"

    @property
    def service(self) -> Path:
        """Port and token of the HTTP service, which a restarted gateway keeps."""
        return self.state / "service.json"

    @property
    def listener(self) -> Path:
        """The address that serves a remote agent: `Listener`. Missing for an agent that is started here."""
        return self.root / open_run.LISTENER

    @property
    def bearer(self) -> Path:
        """A remote agent's bearer token, as text."""
        return self.state / "bearer"

    @property
    def finish(self) -> Path:
        """Created when the operator reports the end of an agent that was not started here."""
        return self.state / "finish"

    @property
    def unwatched(self) -> Path:
        """Created by a gateway that was started by hand: only the operator knows the end of its unwatched agent."""
        return self.root / open_run.UNWATCHED

    @property
    def journal(self) -> Path:
        """The gateway's record of requests; see `journal.py`."""
        return self.root / open_run.JOURNAL

    @property
    def blobs(self) -> Path:
        """Submitted snapshots of `system/`."""
        return self.root / open_run.BUNDLES

    @property
    def opened_run(self) -> Path:
        """The id of the run that the folder belongs to: `OpenedRun`."""
        return self.root / open_run.OPENED

    @property
    def lock(self) -> Path:
        """Lock of the process that plays or replaces the run; beside the folder, which may be removed meanwhile."""
        return self.root.with_name(f".{self.root.name}.lock")

    @property
    def asked(self) -> Path:
        """`IntendedRun` of a run that is to take the place of the folder's; beside it, as the lock."""
        return self.root.with_name(f".{self.root.name}.asked")

    @property
    def supervisor_lock(self) -> Path:
        """Lock of the agent supervisor while the agent may be alive, even if the command that started it was killed."""
        return self.state / "keeper.lock"

    @property
    def intended(self) -> Path:
        """The request to open the run, written before it is sent: `IntendedRun`."""
        return self.root / open_run.INTENDED

    @property
    def session(self) -> Path:
        """A coding agent's session: `SessionState`."""
        return self.state / "session.json"

    @property
    def times(self) -> Path:
        """Time spent on its train side so far: `Times`."""
        return self.state / "times.json"

    @property
    def agent(self) -> Path:
        """A jailed agent's files outside its workspace: home and /tmp."""
        return self.state / "agent"

    @property
    def start(self) -> Path:
        """`Start` of a run whose workspace is that of an earlier submit."""
        return self.state / "start.json"

    @property
    def staged(self) -> Path:
        """Hashes and bounds of the staged workspace: `Staged`."""
        return self.state / "staged.json"


class Staged(msgspec.Struct, frozen=True, kw_only=True):
    """The initial contents of a workspace, for `run.json`. Hashes are SHA-256, hex."""

    agents_md_hash: str
    """Of the rules, with placeholders for the URLs: equal for runs with equal rules."""
    agents_md_file_hash: str = ""
    """Of `AGENTS.md`; empty in a workspace of an earlier version."""
    initial_policy_hash: str
    """Of `system/policy.py`."""
    n_train: int
    """Number of train cases."""
    min_episodes_per_submit: int
    max_episodes_per_submit: int


def run_folder(runs: Path, entry: str, env: str, exp_id: str) -> RunFolder:
    """Returns the folder of a run. Raises ConfigError for names that cannot be a folder's."""
    if not keys.valid_name(exp_id):
        raise ConfigError(f"--exp-id {exp_id!r}: letters, digits, '.', '_' and '-' only, 63 at most")
    name = _ODD.sub("_", entry).strip(" .")
    if not name or len(name) > 100:
        raise ConfigError(f"entry {entry!r}: a name of 1 to 100 characters is needed")
    above = runs.absolute() / name
    earlier = RunFolder(above / earlier_folder_name(env) / exp_id)
    # Also while a run is replaced, whose folder is missing for moments: the lock is beside it.
    if any(path.exists() for path in (earlier.root, earlier.lock, earlier.asked)):
        return earlier
    return RunFolder(above / folder_name(env) / exp_id)


def save(path: Path, value: msgspec.Struct) -> None:
    """Writes a small private file (mode 0600) of the gateway's folder."""
    write_atomically(path, msgspec.json.encode(value), mode=0o600)


def saved(path: Path, kind: type[T]) -> T:
    """Reads a file written by `save`. Raises FileNotFoundError when it is missing, ConfigError when it is damaged."""
    try:
        return msgspec.json.decode(path.read_bytes(), type=kind)
    except DECODE_ERRORS as error:
        raise ConfigError(
            f"{path} is damaged: {error}; restore it from a backup, or restart the run with --overwrite"
        ) from error


def folder_of(path: Path) -> RunFolder:
    """Returns the run folder at `path`. Raises ConfigError when there is no such folder."""
    if not path.is_dir():
        raise ConfigError(
            f"{path} is not a folder; name a run directory such as runs/evolve/gym_acrobot/first"
        )
    return RunFolder(path.absolute())
