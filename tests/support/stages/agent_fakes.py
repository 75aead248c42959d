"""A gateway for agents under test: speaks the HTTP protocol on loopback and plays the staged policy in process."""

from __future__ import annotations

import importlib
import json
import shutil
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from stages.loopback import serving_json

Play = Callable[[Any, int], tuple[float, list[dict[str, Any]]]]
"""(policy after reset, case id) → return and trajectory rows."""


def load_policy(system: Path) -> Any:
    """The Policy class of a staged bundle, imported as the runner would: with the bundle first on the path."""
    for name in [n for n in sys.modules if n == "policy"]:
        del sys.modules[name]
    sys.path.insert(0, str(system))
    importlib.invalidate_caches()
    try:
        return importlib.import_module("policy").Policy
    finally:
        sys.path.remove(str(system))


@dataclass
class FakeGateway:
    """One run. `script` holds answers (status, body) that are given to POSTs before any submit is accepted."""

    workspace: Path
    obs_space: dict[str, Any]
    action_space: dict[str, Any]
    play: Play
    budget: int
    min_per_submit: int = 1
    max_per_submit: int = 128
    n_cases: int = 64
    script: list[tuple[int, dict[str, Any]]] = field(default_factory=list)
    statuses: list[str] = field(default_factory=list)
    """Verdicts of the first submits; `ok` after those."""
    submits: list[dict[str, Any]] = field(default_factory=list)
    keys: dict[str, str] = field(default_factory=dict)
    url: str = ""
    n_asked: int = 0

    @property
    def left(self) -> int:
        return self.budget - sum(len(s["env_instances"]) for s in self.submits)

    def info(self) -> dict[str, Any]:
        meta = {"env": "toy/fake", "obs_space": self.obs_space, "action_space": self.action_space}
        return {
            "state": {"remaining_budget": self.left, "n_submits": len(self.submits), "is_finalized": False},
            "env_meta": meta | {"n_env_instances": self.n_cases, "max_episode_steps": 50},
            "episode_budget": self.budget,
            "min_episodes_per_submit": self.min_per_submit,
            "max_episodes_per_submit": self.max_per_submit,
        }

    def post(self, key: str, env_instances: list[int]) -> tuple[int, dict[str, Any]]:
        if self.script:
            return self.script.pop(0)
        if key not in self.keys:
            n = len(env_instances)
            if not max(1, self.min_per_submit) <= n <= min(self.max_per_submit, self.left):
                message = f"{n} episodes, {self.left} left"
                return 400, {"status": "budget_invalid", "error": {"message": message}}
            self.keys[key] = self._evaluate(env_instances)
        return 202, {"submit_id": int(self.keys[key][-3:]), "status": "running"}

    def get_submit(self, submit_id: str) -> tuple[int, dict[str, Any]]:
        self.n_asked += 1
        if self.n_asked % 2:  # the first question after a submit always comes too early
            return 202, {"submit_id": int(submit_id), "status": "running"}
        summary, folder = self.submits[int(submit_id)], f"feedback/submit_{int(submit_id):03d}"
        known = {"submit_id": int(submit_id), "status": summary["status"]}
        return 200, known | {"summary": summary, "feedback": folder}

    def _evaluate(self, env_instances: list[int]) -> str:
        index = len(self.submits)
        submit_id = f"submit_{index:03d}"
        bundle = self.workspace / "snapshots" / submit_id
        shutil.copytree(self.workspace / "system", bundle)
        status = self.statuses.pop(0) if self.statuses else "ok"
        first = self.budget - self.left
        returns: list[float] = []
        for i, case in enumerate(env_instances if status == "ok" else ()):
            policy = load_policy(bundle)(self.obs_space, self.action_space, {})
            policy.reset(i)
            value, rows = self.play(policy, case)
            returns.append(value)
            folder = self.workspace / "feedback" / submit_id / "episodes" / f"ep_{first + i:03d}"
            folder.mkdir(parents=True)
            (folder / "trajectory.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
        summary = {
            "status": status,
            "returns": returns if status == "ok" else None,
            "mean_return": sum(returns) / len(returns) if status == "ok" else None,
            "env_instances": env_instances,
            "n_episodes": len(env_instances),
            "first_global_episode": first,
            "errors": [] if status == "ok" else None,
            "timeouts": [] if status == "ok" else None,
            "remaining_budget": self.left - len(env_instances),
        }
        self.submits.append(summary)
        folder = self.workspace / "feedback" / submit_id
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "summary.json").write_text(json.dumps(summary))
        return submit_id


@contextmanager
def serving(gateway: FakeGateway) -> Iterator[FakeGateway]:
    """Serve `gateway` on an ephemeral loopback port, its URL in `gateway.url`."""

    def answer(path: str, headers: Mapping[str, str], body: Any) -> tuple[int, Any]:
        if body is not None:
            assert path == "/submit?wait=false"
            return gateway.post(headers["Idempotency-Key"], body["env_instances"])
        if path == "/info":
            return 200, gateway.info()
        return (200, "# Task") if path == "/task" else gateway.get_submit(path.removeprefix("/submit/"))

    with serving_json(answer) as gateway.url:
        yield gateway
