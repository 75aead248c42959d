"""Writes synthetic run directories: the real layout, real small policies and real edits, invented scores.

`write_run` writes one run from a list of `Version`s; `write_suite` a whole study in which every figure of a report has
something to show. Everything follows from its arguments and a seed.
"""

from __future__ import annotations

import hashlib
import json
import random
import struct
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from statistics import fmean, pstdev
from typing import Any

from evopolicy_common import catalogue
from evopolicy_common.run_record import (
    Agent,
    Artifacts,
    CheckpointMetrics,
    ExperimentDimensions,
    Outcome,
    ReferenceScore,
    RejectedSubmit,
    Replay,
    RunRecord,
    Timing,
    Tokens,
    Versions,
    encode_checkpoint_metrics,
    encode_run_record,
)
from evopolicy_common.summary import Summary, encode_summary, utc_text

START = 1_760_000_000.0

POLICY = '''"""A proportional controller with a filtered error."""

import numpy as np

{imports}GAIN = {gain}
BIAS = {bias}


class Policy:
    def __init__(self, obs_space, action_space, env_meta):
        self.action_space = action_space
        self.filtered = 0.0
{init}
    def reset(self, episode_index):
        self.filtered = 0.0

    def act(self, obs):
        values = np.asarray(obs, dtype=np.float64).ravel()
        error = float(values.sum()) + BIAS
        self.filtered = {mix} * self.filtered + (1.0 - {mix}) * error
        command = GAIN * self.filtered
{body}        if self.action_space["type"] == "Discrete":
            return int(command > 0.0)
        return np.clip(np.full(self.action_space["shape"], command), -1.0, 1.0)
'''


def policy(
    *, gain: float = 0.5, bias: float = 0.0, mix: float = 0.9, integral: bool = False, planner: bool = False
) -> dict[str, str]:
    """Source files of a policy: two optional mechanisms over three constants."""
    init = body = imports = ""
    files: dict[str, str] = {}
    if integral:
        init += "        self.total = 0.0\n"
        body += "        self.total = max(-5.0, min(5.0, self.total + error))\n        command += 0.05 * self.total\n"
    if planner:
        imports = "from planner import lookahead\n\n"
        body += "        if abs(error) > 1.0:\n            command += lookahead(values)\n"
        files["planner.py"] = (
            '"""Looks a few steps ahead."""\n\n\ndef lookahead(values):\n    best = 0.0\n    for step in range(3):\n'
            "        for value in values:\n            if value * step > best:\n                best = value * step\n"
            "    return best\n"
        )
    text = POLICY.format(gain=gain, bias=bias, mix=mix, init=init, body=body, imports=imports)
    return {"policy.py": text, **files}


@dataclass
class Version:
    """One submit: the policy and what came of it."""

    files: Mapping[str, str]
    returns: Sequence[float] = (0.0,)
    val: float | None = None
    status: str = "ok"
    failed: Sequence[int] = ()
    images: Mapping[str, bytes] = field(default_factory=dict)
    says: str = ""
    """What the agent says before it, for the log."""


def write_run(
    runs: Path,
    versions: Sequence[Version],
    *,
    entry: str = "Agent A",
    harness: str = "claude-code",
    env: str = "gym/acrobot",
    exp_id: str = "exp",
    repeat: int = 0,
    budget: int = 128,
    heldout: Sequence[float] | None = None,
    random_mean: float | None = -500.0,
    tokens: Tokens | None = None,
    log: str | None = "claude",
    rejected: int = 0,
    replays: Mapping[str, bytes] | None = None,
    scope: str = "episode",
    jail: str = "bwrap",
    split: str = "split-1",
    fingerprint: Mapping[str, str] | None = None,
    status: str | None = None,
) -> Path:
    """Writes one run directory under `runs` and returns it. `heldout` defaults to the best validation score alone."""
    folder = (
        runs / entry.replace(" ", "-") / env.replace("/", "_") / (exp_id + (f"-{repeat}" if repeat else ""))
    )
    remaining, first, clock = budget, 0, START
    val_scores: dict[str, float] = {}
    for index, version in enumerate(versions):
        clock += 60.0
        remaining -= len(version.returns)
        _write_submit(folder, index, version, env, budget, remaining, first, clock)
        first += len(version.returns)
        clock += 20.0
        if version.status == "ok" and version.val is not None:
            val_scores[str(index)] = version.val
    best = max(val_scores, key=lambda key: (val_scores[key], int(key))) if val_scores else None
    if heldout is None:
        heldout = [val_scores[best]] if best is not None else []
    replay_records = _write_replays(folder, replays or {}, int(best or 0))
    record = RunRecord(
        model=entry,
        env=env,
        exp_id=exp_id,
        repeat=repeat,
        agent=Agent(
            entry=entry, harness=harness, model_string=entry.lower(), turns=len(versions), tokens=tokens
        ),
        sandbox_tier="bwrap",
        jail=jail,
        experiment_dimensions=ExperimentDimensions(
            episode_budget=budget,
            min_episodes_per_submit=1,
            max_episodes_per_submit=budget,
            policy_scope=scope,  # type: ignore[arg-type]
            observations="arrays",
            n_train=64,
            n_validation=16,
            n_heldout=32,
        ),
        timing=Timing(
            started_at=utc_text(START),
            finished_at=utc_text(clock + 90.0),
            wall_s=clock + 90.0 - START,
            agent_s=60.0 * len(versions),
            queue_s=1.5 * len(versions),
            rollout_s=16.0 * len(versions),
            feedback_s=2.5 * len(versions),
            finalise_s=90.0,
        ),
        outcome=Outcome(
            status=status or ("completed" if best is not None else "no_ok_submit"),  # type: ignore[arg-type]
            error="worker lost" if status == "error" else None,
            final_score=fmean(heldout) if heldout else None,
            best_submit_index=int(best) if best is not None else None,
            val_scores=val_scores,
            heldout_mean_return=fmean(heldout) if heldout else None,
            heldout_std_return=pstdev(heldout) if heldout else None,
            heldout_returns=tuple(heldout),
            random_reference=(
                ReferenceScore(mean_return=random_mean, std_return=1.0) if random_mean is not None else None
            ),
            closed_reason="budget_spent" if remaining == 0 else "agent_stopped",
            budget_used=budget - remaining,
        ),
        rejected_submits=tuple(
            RejectedSubmit(status="budget_invalid", message="asks for 200 of 128 episodes", after_submits=i)
            for i in range(rejected)
        ),
        artifacts=Artifacts(replays=replay_records),
        versions=Versions(
            harness="0.1.0",
            env=f"{env} (test)",
            agents_md_hash=_sha("agents"),
            data_train_hash=_sha(f"{split} train {env}"),
            data_valid_hash=_sha(f"{split} valid {env}"),
            data_heldout_hash=_sha(f"{split} heldout {env}"),
            fingerprint=dict(fingerprint or {"numpy": "2.4.6"}),
        ),
    )
    (folder / "logs").mkdir(parents=True, exist_ok=True)
    (folder / "logs" / "harness.log").write_text(json.dumps({"event": "run_opened"}) + "\n")
    if log is not None:
        lines = LOGS[log](versions, budget)
        (folder / "logs" / "agent.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    (folder / "run.json").write_bytes(encode_run_record(record))
    return folder


def _write_submit(
    folder: Path,
    index: int,
    version: Version,
    env: str,
    budget: int,
    remaining: int,
    first: int,
    clock: float,
) -> None:
    ok = version.status == "ok"
    returns = tuple(float(value) for value in version.returns)
    summary = Summary(
        schema_version=1,
        submit_index=index,
        env=env,
        status=version.status,  # type: ignore[arg-type]
        n_episodes=len(returns),
        first_global_episode=first,
        env_instances=tuple(range(len(returns))) if ok else None,
        remaining_budget=remaining,
        submit_started_at=utc_text(clock),
        submit_completed_at=utc_text(clock + 20.0),
        wall_time_seconds=20.0,
        returns=returns if ok else None,
        mean_return=fmean(returns) if ok else None,
        std_return=pstdev(returns) if ok else None,
        min_return=min(returns) if ok else None,
        max_return=max(returns) if ok else None,
        episode_lengths=(100,) * len(returns) if ok else None,
        mean_episode_length=100.0 if ok else None,
        timeouts=() if ok else None,
        errors=tuple(version.failed) if ok else None,
    )
    feedback = folder / "workspace" / "feedback" / f"submit_{index:03d}"
    feedback.mkdir(parents=True)
    (feedback / "summary.json").write_bytes(encode_summary(summary))
    checkpoint = folder / "checkpoints" / f"submit_{index:03d}"
    digest = hashlib.sha256()
    for name, data in sorted({**{k: v.encode() for k, v in version.files.items()}, **version.images}.items()):
        path = checkpoint / "system" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data)
        digest.update(name.encode() + b"\0" + data)
    checkpoint.mkdir(parents=True, exist_ok=True)
    metrics = CheckpointMetrics(
        submit_index=index,
        status=version.status,  # type: ignore[arg-type]
        digest=digest.hexdigest(),
        n_episodes=len(returns),
        consumed_budget=budget - remaining,
        mean_return=summary.mean_return,
        val_mean=version.val,
        policy_files=len(version.files),
        policy_bytes=sum(len(text) for text in version.files.values()),
    )
    (checkpoint / "metrics.json").write_bytes(encode_checkpoint_metrics(metrics))


def _write_replays(folder: Path, replays: Mapping[str, bytes], best: int) -> tuple[Replay, ...]:
    out: list[Replay] = []
    for number, (name, data) in enumerate(replays.items()):
        path = folder / "replays" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data)
        out.append(
            Replay(
                path=f"replays/{name}",
                split="heldout",
                episode=number,
                submit_index=best,
                episode_return=-80.0 - number,
                length=100,
            )
        )
    return tuple(out)


def _sha(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()


def claude_log(versions: Sequence[Version], budget: int) -> list[dict[str, Any]]:
    """A stream of the `stream-json` kind: assistant messages with text and tool calls, tool results as user messages."""
    lines: list[dict[str, Any]] = [{"type": "system", "subtype": "init", "model": "test"}]
    for index, version in enumerate(versions):
        content: list[dict[str, Any]] = []
        if index:
            read = f"/workspace/feedback/submit_{index - 1:03d}/summary.json"
            content.append(
                {"type": "tool_use", "id": f"r{index}", "name": "Read", "input": {"file_path": read}}
            )
        if version.says:
            content.append({"type": "text", "text": version.says})
        content.append(
            {
                "type": "tool_use",
                "id": f"e{index}",
                "name": "Edit",
                "input": {"file_path": "/workspace/system/policy.py"},
            }
        )
        for name in version.images:
            plot = f"python plot.py --out system/{name}"
            content.append(
                {"type": "tool_use", "id": f"p{index}", "name": "Bash", "input": {"command": plot}}
            )
        submit = 'curl -s -X POST "$EVOPOLICYGYM_SUBMIT_URL" -d \'{"env_instances": "0-3"}\''
        content.append({"type": "tool_use", "id": f"s{index}", "name": "Bash", "input": {"command": submit}})
        lines.append({"type": "assistant", "message": {"role": "assistant", "content": content}})
        reply = json.dumps(
            {"submit_id": f"submit_{index:03d}", "status": version.status, "summary": {"submit_index": index}}
        )
        result = [{"type": "tool_result", "tool_use_id": f"s{index}", "content": reply}]
        lines.append({"type": "user", "message": {"role": "user", "content": result}})
    lines.append({"type": "result", "subtype": "success", "result": "done"})
    return lines


def codex_log(versions: Sequence[Version], budget: int) -> list[dict[str, Any]]:
    """A stream of the `exec --json` kind: completed items."""
    lines: list[dict[str, Any]] = [{"type": "thread.started", "thread_id": "t"}]
    for index, version in enumerate(versions):
        if index:
            command = f"cat feedback/submit_{index - 1:03d}/summary.json && head feedback/submit_{index - 1:03d}/episodes/ep_000/trajectory.jsonl"
            lines.append(_item({"type": "command_execution", "command": command, "aggregated_output": "{}"}))
        if version.says:
            lines.append(_item({"type": "agent_message", "text": version.says}))
        lines.append(
            _item({"type": "file_change", "changes": [{"path": "system/policy.py", "kind": "update"}]})
        )
        reply = json.dumps({"submit_id": f"submit_{index:03d}", "status": version.status})
        submit = "curl -X POST $EVOPOLICYGYM_SUBMIT_URL -d @request.json"
        lines.append(_item({"type": "command_execution", "command": submit, "aggregated_output": reply}))
    return lines


def _item(item: dict[str, Any]) -> dict[str, Any]:
    return {"type": "item.completed", "item": item}


def turn_log(versions: Sequence[Version], budget: int) -> list[dict[str, Any]]:
    """The turn protocol of command agents."""
    lines: list[dict[str, Any]] = []
    for index, version in enumerate(versions):
        lines.append({"type": "prompt", "turn": index, "message": "Go on."})
        lines.append(
            {"turn": index, "text": version.says or f"submit {index}", "stop": index + 1 == len(versions)}
        )
    return lines


LOGS = {"claude": claude_log, "codex": codex_log, "turns": turn_log}


def png(width: int = 48, height: int = 32, seed: int = 0) -> bytes:
    """A small valid RGB image."""
    generator = random.Random(seed)
    base = [generator.randrange(256) for _ in range(3)]
    rows = b"".join(
        b"\0" + b"".join(bytes(((c + 3 * x + 2 * y) % 256) for c in base) for x in range(width))
        for y in range(height)
    )

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    return (
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", header)
        + chunk(b"IDAT", zlib.compress(rows))
        + chunk(b"IEND", b"")
    )


AGENTS: Mapping[str, tuple[str, str, float]] = {
    "Northwind": ("codex", "codex", 0.9),
    "Kestrel": ("claude-code", "claude", 0.75),
    "Tern": ("claude-code", "claude", 0.5),
    "evolve": ("evolve", "turns", 0.35),
}
"""Invented entries: harness, log form, skill in [0, 1]."""

RANDOM = {
    "gym/acrobot": (-499.0, -80.0), "gym/continuouscar": (-33.0, 98.0), "gym/bipedal": (-100.0, 260.0),
    "gym/racing": (-30.0, 640.0), "gym/reacher5": (-43.0, -3.4), "gym/halfcheetah5": (-291.0, 620.0),
    "gym/ant5": (-34.0, 995.0), "gym/pusher5": (-147.0, -36.0),
    "gymnasium/MiniGrid-DoorKey-16x16-v0": (0.0, 0.98), "gymnasium/MiniGrid-KeyCorridorS4R3-v0": (0.0, 0.93),
    "gymnasium/MiniGrid-FourRooms-v0": (0.04, 0.7), "gymnasium/MiniGrid-ObstructedMaze-1Q-v1": (0.0, 0.91),
    "gymnasium/parking-v0": (-47.0, -30.0), "gymnasium/roundabout-v0": (7.2, 10.2),
    "gymnasium/FetchPush-v4": (-46.0, -18.0), "gymnasium/FetchPickAndPlace-v4": (-43.0, -11.0),
}  # fmt: skip
"""Random and good return of each Core16 environment, for plausible scales."""


def evolution(generator: random.Random, env: str, skill: float, n_submits: int, budget: int) -> list[Version]:
    """A run's versions: every edit type, some failures, scores that rise with skill."""
    low, high = RANDOM.get(env, (0.0, 1.0))
    per_submit = max(1, budget // n_submits)
    gain, bias, mix, integral, planner = 0.5, 0.0, 0.9, False, False
    history: list[Version] = []
    level = 0.05
    for index in range(n_submits):
        kind = (
            "first"
            if not index
            else generator.choices(
                ("parametric", "synthesis", "rollback", "retest", "broken"), (5, 3, 1, 1, 0.6)
            )[0]
        )
        says = ""
        if kind == "synthesis":
            integral, planner = (
                (not integral, planner) if generator.random() < 0.5 else (integral, not planner)
            )
            says = "The summary shows a steady error at the end of the episodes, so the controller needs another mechanism."
        elif kind in ("parametric", "first"):
            gain, mix = round(generator.uniform(0.1, 3.0), 3), round(generator.uniform(0.5, 0.99), 3)
            bias = round(generator.gauss(0.0, 0.2), 3)
            says = f"Episodes 1 and 3 overshoot; I set the gain to {gain}."
        files = policy(gain=gain, bias=bias, mix=mix, integral=integral, planner=planner)
        if kind == "rollback":
            files = dict(generator.choice([v for v in history if v.status == "ok"] or [Version(files)]).files)
            says = "The last change made it worse: back to the earlier policy."
        elif kind == "retest" and history:
            files = dict(history[-1].files)
        if kind == "broken":
            history.append(
                Version(
                    {"policy.py": "import nothing_like_this\n"}, (0.0,) * per_submit, None, "import_error"
                )
            )
            continue
        if kind != "retest":
            level = min(1.0, max(0.0, level + generator.gauss(0.12 * skill, 0.12)))
        val = low + (high - low) * level * skill
        same = next((v.val for v in history if v.files == files and v.val is not None), None)
        val = val if same is None else same  # hidden validation of equal bytes is equal
        noise = abs(high - low) * 0.05
        returns = [val + generator.gauss(0.0, noise) for _ in range(per_submit)]
        images = {"probe.png": png(seed=index)} if index == 2 else {}
        history.append(
            Version(files, returns, val, images=images, says=says, failed=(0,) if index == 1 else ())
        )
    return history


def write_suite(
    runs: Path,
    *,
    environments: Sequence[str] | None = None,
    agents: Mapping[str, tuple[str, str, float]] = AGENTS,
    repeats: int = 1,
    n_submits: int = 9,
    budget: int = 128,
    seed: int = 0,
) -> list[Path]:
    """One run of every agent on every environment (Core16 by default), `repeats` times."""
    environments = environments or catalogue.suites()["core16"].environments
    out: list[Path] = []
    for env in environments:
        low, high = RANDOM.get(env, (0.0, 1.0))
        for entry, (harness, log, skill) in agents.items():
            for repeat in range(repeats):
                generator = random.Random(f"{seed} {env} {entry} {repeat}")
                versions = evolution(generator, env, skill * generator.uniform(0.6, 1.1), n_submits, budget)
                best = max((v.val for v in versions if v.val is not None), default=low)
                heldout = [best + generator.gauss(0.0, abs(high - low) * 0.04) for _ in range(32)]
                tokens = Tokens(
                    input_noncached=generator.randrange(50_000, 500_000),
                    cache_read=generator.randrange(500_000, 20_000_000),
                    cache_creation=generator.randrange(10_000, 500_000),
                    output=generator.randrange(20_000, 300_000),
                    cost=round(generator.uniform(0.5, 9.0), 2),
                )
                folder = write_run(
                    runs,
                    versions,
                    entry=entry,
                    harness=harness,
                    env=env,
                    repeat=repeat,
                    budget=budget,
                    heldout=heldout if any(v.val is not None for v in versions) else None,
                    random_mean=low,
                    tokens=tokens if log != "turns" else None,
                    log=log,
                    rejected=generator.randrange(3),
                )
                out.append(folder)
    return out
