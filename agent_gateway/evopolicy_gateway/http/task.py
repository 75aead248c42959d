"""The markdown of `GET /task`: the environment's own text, then the rules of every run (`task.md`); pure."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Iterable
from pathlib import Path
from string import Template

import msgspec

from evopolicy_common.messages.environment import SpaceSchema
from evopolicy_common.messages.gateway import RunOpened
from evopolicy_gateway.submits.episode_files import episode_share

_TEXT = Template(Path(__file__).with_name("task.md").read_text(encoding="utf-8"))
_PARTS = tomllib.loads(Path(__file__).with_name("task.toml").read_text(encoding="utf-8"))
"""Parts of the text that differ from run to run."""


def task_markdown(run: RunOpened) -> str:
    """Everything that an agent needs to write a policy and to submit it."""
    env, limits = run.env, run.limits
    keeps_all = run.feedback == "trajectories" and env.obs_storage == "inline"
    kept = _PARTS["kept"]["pictures" if keeps_all else run.feedback]
    stored = _PARTS["stored"][env.obs_storage if run.profile == "own" else "published"]
    hidden = _PARTS["hidden"][run.hidden_evaluation]
    whole = f"\n| wall time of a whole submit | {limits.submit_wall_s:g} s |" if limits.submit_wall_s else ""
    known = {name: _shown(name, limit) for name, limit in msgspec.structs.asdict(limits).items()} | {
        "env_text": env.task_text.strip(),
        "env": env.env,
        "version": env.env_version,
        "form": _PARTS["form"][run.observations],
        "announced_steps": str(run.announced_steps),
        "obs_space": _schema(env.obs_space),
        "action_space": _schema(env.action_space),
        "kept": Template(kept).substitute(stored=stored),
        "last_id": str(run.n_env_instances - 1),
        "budget": str(run.episode_budget),
        "least": str(run.min_episodes_per_submit),
        "most": str(min(run.max_episodes_per_submit, run.episode_budget)),
        "scope": Template(_PARTS["scope"][run.policy_scope]).substitute(hidden=hidden),
        "fails": _PARTS["fails"][run.failed_episodes],
        "allowed": _listed(run.allowed_imports),
        "denied": _listed(run.denied_imports),
        "share": _size(episode_share(limits, run.episode_budget)),
        "submit_limit": whole,
        "randomness": _PARTS["randomness"]["deterministic" if env.deterministic else "not_deterministic"],
    }
    return _TEXT.substitute(known)


def _listed(names: Iterable[str]) -> str:
    return ", ".join(f"`{name}`" for name in names) or "none"


def _shown(name: str, limit: float | None) -> str:
    if limit is None:
        return "none"
    if name.endswith("_s"):
        return f"{limit:g} s"
    if name.endswith("_bytes"):
        return _size(int(limit))
    return f"{limit:,}" if name == "files" else str(limit)


def _schema(space: SpaceSchema, depth: int = 0) -> str:
    """JSON with one line per field, except that lists of numbers and short spaces stay on one line."""
    text = json.dumps(space)
    if len(text) < 90:
        return text
    pad = "  " * (depth + 1)
    lines = [
        f"{pad}{json.dumps(key)}: {_schema(value, depth + 1) if isinstance(value, dict) else json.dumps(value)}"
        for key, value in space.items()
    ]
    return "{\n" + ",\n".join(lines) + "\n" + "  " * depth + "}"


def _size(n_bytes: int) -> str:
    for unit, factor in (("GiB", 1 << 30), ("MiB", 1 << 20), ("KiB", 1 << 10)):
        if n_bytes >= factor:
            return f"{n_bytes / factor:g} {unit}"
    return f"{n_bytes} bytes"
