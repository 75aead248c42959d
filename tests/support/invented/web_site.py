"""A live view over invented run folders, and a client that has signed in or has not."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import msgspec
from starlette.testclient import TestClient

from evopolicy_common.messages.gateway import Submit, SubmitAccepted
from evopolicy_common.messages.run_settings import RunSettings
from evopolicy_common.messages.status import RunStatus, StatusReply, WorkerStatus
from evopolicy_common.records.open_run import SubmitRequested
from evopolicy_common.records.policies.bundles import BundleFile, pack
from evopolicy_common.wire.credentials import Credentials
from evopolicy_coordinator.web.access import Access
from evopolicy_coordinator.web.app import Site
from invented.policies import Version
from invented.run_dirs import write_run

HOST = "127.0.0.1:8765"
ORIGIN = f"http://{HOST}"
TOKEN = "r" * 43
NOBODY = Credentials(
    cluster="c", role="operator", endpoints=("tcp/127.0.0.1:1",), user="u", password="p", token="t"
)
"""A cluster that is never connected to: its status is told to `Site.cluster.take_status`."""


def site_of(*roots: Path, cluster: StatusReply | None = None, **more: Any) -> Site:
    """A view of these folders; `cluster` is what its coordinator has just answered."""
    known = None if cluster is None else NOBODY
    site = Site(list(roots), Access(TOKEN, cookie="evopolicy_8765"), credentials=known, **more)
    if cluster is not None:
        site.cluster.take_status(cluster)
    return site


def client(site: Site, *, signed_in: bool = True) -> TestClient:
    """A browser, which has signed in."""
    made = TestClient(site.app(), base_url=ORIGIN, follow_redirects=False)
    if signed_in:
        answer = made.post("/login", content=f"token={TOKEN}", headers={"origin": ORIGIN})
        assert answer.status_code == 303, answer.text
    return made


def status(*runs: RunStatus, workers: tuple[WorkerStatus, ...] = (), **more: Any) -> StatusReply:
    """A status as a coordinator may send it."""
    more |= {"cluster": "c", "version": "1", "uptime_s": 60.0, "episodes_done": 1, "episodes_per_s": 0.5}
    return StatusReply(workers=workers, runs=runs, **more)


def open_status(run: str, env: str = "gym/acrobot", **more: Any) -> RunStatus:
    """An open run whose agent is alive."""
    usual: dict[str, Any] = {
        "entry": "Agent B", "phase": "open", "budget": 128, "remaining_budget": 100, "n_submits": 1,
        "queued": 2, "running": 1, "done": 28, "agent_host": "lab",
    }  # fmt: skip
    return RunStatus(run=run, env=env, **{**usual, **more})


def open_run(
    runs: Path,
    *,
    entry: str = "Agent B",
    env: str = "gym/acrobot",
    exp_id: str = "open",
    run: str = "r-open",
    files: dict[str, bytes] | None = None,
    log: list[dict[str, Any]] | None = None,
    settings: dict[str, Any] | None = None,
) -> Path:
    """The folder of a run that is going on, with one committed submit whose code the gateway keeps."""
    folder = runs / entry / env.replace("/", "_") / exp_id
    usual = RunSettings(env=env, entry=entry, model="m", exp_id=exp_id, budget=128)
    wanted = msgspec.structs.replace(usual, **(settings or {}))
    kept = sorted((files or {"policy.py": b"x = 1\n"}).items())
    bundle = pack([BundleFile(path, False, data) for path, data in kept])
    state = folder / ".gateway"
    (state / "bundles" / bundle.digest[:2]).mkdir(parents=True)
    (state / "bundles" / bundle.digest[:2] / bundle.digest).write_bytes(bundle.packed)
    (state / "intended.json").write_bytes(msgspec.json.encode({"key": "k", "settings": wanted, "run": run}))
    submit = Submit(key="one", env_instances=(0,), bundle=bundle.digest)
    accepted = SubmitAccepted(submit_index=0, first_global_episode=0, remaining_budget=127)
    lines = [SubmitRequested(submit=submit, client_key=None, body_digest="d"), accepted]
    (state / "journal.jsonl").write_bytes(b"".join(msgspec.json.encode(line) + b"\n" for line in lines))
    (folder / "logs").mkdir()
    (folder / "logs" / "agent.jsonl").write_text("".join(json.dumps(line) + "\n" for line in log or []))
    episode = folder / "workspace" / "feedback" / "submit_000" / "episodes" / "ep_000"
    episode.mkdir(parents=True)
    row = {"obs": [0.5, 1.0], "action": [1.0], "reward": -1.0, "terminated": False, "truncated": False}
    rows = "".join(json.dumps({"t": t, **row}) + "\n" for t in (0, 1))
    (episode / "trajectory.jsonl").write_text(rows)
    summary = {
        "schema_version": "0.1", "submit_index": 0, "env": env, "status": "ok", "n_episodes": 1,
        "first_global_episode": 0,
        "env_instances": [7], "remaining_budget": 127, "submit_started_at": "2026-01-01T00:00:00.000000Z",
        "submit_completed_at": "2026-01-01T00:00:01.000000Z", "wall_time_seconds": 1.0, "returns": [-2.0],
        "mean_return": -2.0, "std_return": 0.0, "min_return": -2.0, "max_return": -2.0, "episode_lengths": [2],
        "mean_episode_length": 2.0, "timeouts": [], "errors": [],
    }  # fmt: skip
    (episode.parents[1] / "summary.json").write_text(json.dumps(summary))
    return folder


def finished_run(runs: Path, **more: Any) -> Path:
    """A finished run whose held-out score is a number that stands nowhere else."""
    version = Version(files={"policy.py": "x = 1\n"}, returns=(-100.0,) * 4, val=-111.25)
    return write_run(runs, [version], heldout=[4242.5], random_mean=-4322.5, **more)
