"""The markdown of `GET /task`: the environment's own text, then the rules of every run; pure."""

from __future__ import annotations

import json

from evopolicy_common.messages.environment import SpaceSchema
from evopolicy_common.messages.gateway import RunOpened
from evopolicy_gateway.submits.episode_files import episode_share


def task_markdown(run: RunOpened) -> str:
    """Everything that an agent needs to write a policy and to submit it."""
    parts = [run.env.task_text.strip(), f"This environment is `{run.env.env}`: {run.env.env_version}."]
    parts += [part(run) for part in (_policy, _cases, _scope, _failures, _limits, _randomness)]
    return "\n\n".join(parts) + "\n"


def _policy(run: RunOpened) -> str:
    form = "as plain numbers, strings, dicts and nested lists"
    if run.observations == "arrays":
        form = "as numpy arrays, ints, strings, dicts and tuples, as the space says"
    stored = {
        "inline": "in the rows of `trajectory.jsonl`",
        "npy": "in `observations.npy`, one array row a step (`obs` in `trajectory.jsonl` is null)",
        "npz": "in `observations.npz`, read with `numpy.load`: the array `observations`, or one for each part of the space, a row a"
        " step (`obs` in `trajectory.jsonl` is null)",
    }[run.env.obs_storage]
    if run.profile != "own":
        stored = (
            "in the rows of `trajectory.jsonl`, or, if those of an episode have more than 4,096 bytes as one array, in"
            " `observations.npy` (`observations.npz` for dictionaries; `obs` is null then)"
        )
    kept = f"Feedback keeps the observations {stored}."
    if run.feedback == "scores":
        kept = "Feedback is the summary of each submit; it has no trajectories."
    elif run.feedback == "trajectories" and run.env.obs_storage != "inline":
        kept = "Feedback has rewards and actions, and no observations (`obs` in `trajectory.jsonl` is null)."
    return f"""## The policy

`system/policy.py` holds a top-level `class Policy`:

```python
class Policy:
    def __init__(self, obs_space, action_space, env_meta): ...
    def reset(self, episode_index): ...      # before each episode; returns None
    def act(self, obs): ...                  # once a step; returns an action
```

`obs_space` and `action_space` are the dicts below. `env_meta` is a dict with `env`, `submit_index`,
`n_episodes_this_submit`, `remaining_budget_after`, `max_episode_steps`, `obs_space`, `action_space`, `obs_storage`.
Observations arrive {form}. Other files in `system/` can be imported and read: the working
directory and `sys.path[0]` are the policy's own copy of `system/`, writable and thrown away afterwards.
An episode ends by itself or after {run.announced_steps} steps.
An action outside the action space is repaired, and the step's `info.action_invalid` is true: numbers are clipped, shapes
broadcast, and an action that cannot be read counts as zeros (the lowest choice where there are choices).

Observation space:

```json
{_schema(run.env.obs_space)}
```

Action space:

```json
{_schema(run.env.action_space)}
```

{kept}"""


def _cases(run: RunOpened) -> str:
    most = min(run.max_episodes_per_submit, run.episode_budget)
    return f"""## Train cases and budget

Visible ids: 0 to {run.n_env_instances - 1}. Each is one fixed initial condition; the same id is the same episode start every time.
The run's budget is {run.episode_budget} episodes. A submit plays {run.min_episodes_per_submit} to {most} of them, in the order asked for; an id may
be repeated. Every episode asked for is charged, also where the policy fails.
The score is the mean return on hidden cases of the submit that does best on other hidden cases. Neither is shown."""


def _scope(run: RunOpened) -> str:
    if run.policy_scope == "episode":
        text = (
            "Policy scope `episode`: every episode gets a fresh process and a fresh `Policy`; nothing is kept from one\n"
            "episode to the next. Episodes of a submit run in parallel."
        )
    else:
        hidden = "One new `Policy` plays all validation cases, another one all held-out cases."
        if run.hidden_evaluation == "submit":
            hidden = "Hidden cases are played with a new `Policy` every `n_episodes_this_submit` cases."
        text = (
            "Policy scope `submit`: one `Policy` plays all episodes of a submit one after another, in the order asked for,\n"
            f"in one process. {hidden}"
        )
    return f"## Policy scope\n\n{text}"


_FAILS = {
    "play-on": """uniform random actions play the rest of that
episode; the episode's `error.txt` tells step, category and message, and later rows carry `info.policy_failed = true`.""",
    "end-submit": """the episode ends: after
one random action, whose row carries `info.policy_failed = true`, or at once if `act` was not called yet. The episode's
`error.txt` tells step, category and message. The submit's other episodes are played, its status is `rollout_timeout`, it
has no mean return, and it cannot be selected. The same holds for a submit whose policy fails on a hidden case.""",
}


def _failures(run: RunOpened) -> str:
    return f"""## A policy that fails

If `reset` or `act` raises, a limit is exceeded, or the process dies, {_FAILS[run.failed_episodes]}
If the code yields no `Policy` at all (missing file, import error, `__init__` raises), the submit's status says so and its
episodes are charged."""


def _limits(run: RunOpened) -> str:
    limits = run.limits
    rows = [
        ("wall time of the policy in one episode", f"{limits.episode_wall_s:g} s"),
        ("wall time of one `act` or `reset`", f"{limits.act_wall_s:g} s"),
        ("wall time of import and `__init__`", f"{limits.init_wall_s:g} s"),
        ("CPU time in one episode", f"{limits.cpu_s:g} s"),
        ("memory beside Python and the allowed packages", _size(limits.memory_bytes)),
        ("threads", str(limits.processes)),
        ("files written", f"{_size(limits.file_bytes)}, {limits.files:,} files"),
        ("open files", str(limits.open_files)),
        ("one action, beyond 16 bytes for each of its numbers", _size(limits.action_bytes)),
        ("what larger actions come to in one episode", _size(limits.episode_action_bytes)),
        ("kept of stdout and of stderr", f"{_size(limits.output_bytes)} each"),
        (
            "files of one episode; beyond it video, observations, rows are left out, in this order",
            _size(episode_share(limits, run.episode_budget)),
        ),
    ]
    if limits.submit_wall_s is not None:
        rows.append(("wall time of a whole submit", f"{limits.submit_wall_s:g} s"))
    table = "\n".join(f"| {limit} | {value} |" for limit, value in rows)
    allowed = ", ".join(f"`{name}`" for name in run.allowed_imports) or "none"
    denied = ", ".join(f"`{name}`" for name in run.denied_imports) or "none"
    return f"""## What a policy may do

- Import Python's standard library, your own modules in `system/`, and these packages: {allowed}. No other package is installed.
  A file that imports one of these gets the submit refused as `denied_import`: {denied}.
- Start threads. It may not start processes: `subprocess`, `os.fork`, `os.exec*` and `multiprocessing` fail.
- Read and write its own copy of `system/` and `/tmp`, both thrown away after the episode. It sees no other files.
- It has no network: sockets fail.

## Limits

| limit | value |
|---|---|
{table}"""


def _randomness(run: RunOpened) -> str:
    sentence = "This environment is **not** deterministic: the same case and the same actions may give another episode."
    if run.env.deterministic:
        sentence = (
            "This environment is deterministic: the same case and the same actions give the same episode."
        )
    return f"""## Randomness

{sentence}
The environment is seeded by its case. The policy's `random`, `numpy.random` and an unseeded `numpy.random.default_rng()`
are seeded too, differently for each submit and episode, and tell nothing of the case. Clocks, `os.urandom`, `secrets` and
the timing of threads are not seeded: a policy that uses them may play the same case differently."""


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
