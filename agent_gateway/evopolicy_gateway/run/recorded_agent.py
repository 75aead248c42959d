"""The plan and the addresses of a recorded run, which `evopolicy replay` needs besides its record of model calls.

`.replay.json` in the run's folder (mode 0600) has both. It is never published: it names paths, and tokens that were
valid while the run was open. A replay runs the programs that the plan names, some of them without a jail. So a file
that was not written by this user on this machine is refused: its authentication code needs this user's key.
"""

from __future__ import annotations

import contextlib
import hmac
import os
import secrets
from pathlib import Path
from typing import Any

import msgspec

from evopolicy_common.errors import DECODE_ERRORS, ConfigError
from evopolicy_common.processes.preflight import LOOPBACK
from evopolicy_common.records import model_record
from evopolicy_common.records.blobs import write_atomically
from evopolicy_common.records.run_difference import differences
from evopolicy_common.records.secrets import without_keys
from evopolicy_common.regular_files import read_regular
from evopolicy_common.wire.credentials import state_home
from evopolicy_common.wire.http import bound
from evopolicy_gateway.relay.recording import DIFFERENCE
from evopolicy_gateway.run.plan import Plan, Replays
from evopolicy_gateway.run_folder.layout import RunFolder

_MAX_BYTES = 4 << 20
_KEYS = {"codex": ("OPENAI_API_KEY",), "claude-code": ("ANTHROPIC_API_KEY",)}
_NO_KEY = "no-key-is-needed-to-replay"
_OWN = tuple(f"run.json: agent.{name}" for name in ("model_use.", "settings.agent: ", "settings.program: "))
"""Values of a replay's own, or of its machine."""
_VERSIONS = tuple(
    f"run.json: {name}"
    for name in (
        "record_version:",
        "versions.harness:",
        "versions.env:",
        "versions.fingerprint",
        "agent.cli_version:",
    )
)
"""They may explain a difference, and are none."""


class Recorded(msgspec.Struct, frozen=True, kw_only=True):
    """The content of `.replay.json`."""

    plan: dict[str, Any]
    replays: dict[str, Any]
    code: str = ""
    """HMAC-SHA256 of plan and replays, hex."""


def keep(folder: RunFolder, plan: Plan, replays: Replays) -> None:
    """Writes `.replay.json`. Raises StorageError."""
    whole = msgspec.structs.replace(plan, config=plan.known_config, prices=None)
    kept = Recorded(plan=without_keys(_plain(whole)), replays=_plain(replays))
    kept = msgspec.structs.replace(kept, code=_code(kept))
    write_atomically(folder.replay, msgspec.json.encode(kept), mode=0o600)


def plan_of(run: Path, runs: Path, *, trusted: bool = False) -> Plan:
    """The plan that plays the run's agent again. `trusted`: recorded anywhere. Raises ConfigError."""
    folder = RunFolder(run.absolute())
    try:
        kept = msgspec.json.decode(read_regular(folder.replay, _MAX_BYTES), type=Recorded)
        plan = msgspec.convert(kept.plan, Plan, dec_hook=_path, strict=False)
        replays = msgspec.convert(kept.replays, Replays, dec_hook=_path)
    except FileNotFoundError as error:
        raise ConfigError(
            f"{run} has no record to replay; play runs in the jail, with --record-model full"
        ) from error
    except (OSError, *DECODE_ERRORS) as error:
        raise ConfigError(f"{folder.replay} cannot be read: {error}") from error
    if not trusted and not (kept.code and hmac.compare_digest(kept.code, _code(kept))):
        raise ConfigError(
            f"{run} was not recorded by you on this machine, and a replay runs the programs that it names: read"
            f" {folder.replay}, then repeat with --trust"
        )
    if not folder.run_json.exists():
        raise ConfigError(f"{run} is not finished; finish it with --resume, or name a finished run")
    if why := model_record.stopped(folder.root):
        raise ConfigError(f"the record of {run} is not whole, and cannot be replayed: {why}")
    if (config := plan.config) is not None:
        # The variables from which the agent's settings take a key.
        for name in (*config.secret, *(() if config.api else _KEYS.get(config.harness, ()))):
            os.environ.setdefault(name, _NO_KEY)
    for port in (replays.port, replays.model_port):
        try:
            bound(LOOPBACK, port).close()
        except OSError as error:
            raise ConfigError(
                f"port {port} on {LOOPBACK}, at which the recorded agent found a service, cannot be used:"
                f" {error.strerror}; end what listens there (`ss -ltnp` shows it), then replay again"
            ) from error
    replays = msgspec.structs.replace(replays, folder=folder.model_record)
    settings = msgspec.structs.replace(plan.settings, replay_of=replays.run)
    plan = msgspec.structs.replace(plan, runs=runs, settings=settings, replays=replays)
    plan = msgspec.structs.replace(plan, overwrite=True, resume=False, record_model="digests")
    if plan.folder.root.resolve() == folder.root.resolve():
        raise ConfigError(f"a replay in {runs} would take the place of {run}; choose another --runs")
    return plan


def outcome(run: Path, plan: Plan) -> str:
    """The first difference between replay and run, with versions that differ; empty without one."""
    lines = differences(run, plan.folder.root)
    others = (line for line in lines if not line.startswith((*_OWN, *_VERSIONS)))
    first = _different_request(run, plan.folder) or next(others, "")
    explained = [f"other versions: {line}" for line in lines if line.startswith(_VERSIONS)]
    return "\n".join([first, *explained]) if first else ""


def _different_request(run: Path, again: RunFolder) -> str:
    with contextlib.suppress(FileNotFoundError):
        return (again.model_record / DIFFERENCE).read_text().strip()
    again_asked = [call.digest for call in model_record.read_calls(again.model_record)]
    for call in model_record.read_calls(RunFolder(run.absolute()).model_record):
        if call.digest not in again_asked:
            return f"request {call.n} to {call.api} did not come again"
        again_asked.remove(call.digest)
    return ""


def _code(kept: Recorded) -> str:
    """The code with this user's key; empty where no key can be kept."""
    path = state_home() / "replay.key"
    try:
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        with contextlib.suppress(FileExistsError):
            file = os.open(path, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o600)
            os.write(file, secrets.token_bytes(32))
            os.close(file)
        key = path.read_bytes()
    except OSError:
        return ""
    data = msgspec.json.encode((kept.plan, kept.replays), order="sorted")
    return hmac.new(key, data, "sha256").hexdigest() if len(key) == 32 else ""


def _plain(value: object) -> Any:
    return msgspec.to_builtins(value, enc_hook=str)


def _path(kind: type, value: Any) -> Any:
    return Path(value)
