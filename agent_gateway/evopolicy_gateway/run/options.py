"""The options of a run, and how their values become settings. A wrong value is a ConfigError."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import msgspec

from evopolicy_common import catalogue
from evopolicy_common.errors import ConfigError, ProtocolError, RequestError
from evopolicy_common.messages.episode import LARGEST_LIMIT, LARGEST_LIMITS, ResourceLimits
from evopolicy_common.messages.run_settings import HIDDEN_COUNTS, PUBLISHED, RunSettings, episode_counts
from evopolicy_common.processes.packages import checked_names, packages_in, policy_versions
from evopolicy_common.records.run_files import read_record
from evopolicy_common.records.run_record import AgentLimits
from evopolicy_gateway.submits.submit_request import Bounds, ids_in

AGENT_LIMITS: dict[str, tuple[str, float, float]] = {
    "cpus": ("cpus", 0.1, 1e4),
    "memory": ("memory_bytes", 1e8, 1e15),
    "pids": ("pids", 16, 1 << 22),
    "disk": ("disk_bytes", 1e6, 1e18),
}
"""Options `--agent-NAME`: the field of `AgentLimits`, the least value with which programs still start, the
greatest."""
OWN = {
    "policy_scope": "episode",
    "observations": "arrays",
    "simulation": "forbidden",
    "finish": "early",
    "step_limit": "published",
    "hidden_cases": "shared",
    "feedback": "pictures",
    "failed_episodes": "play-on",
    "hidden_evaluation": "submit",
}
"""Defaults of settings that neither an option nor a profile gives."""


def settings_of(profile: str | None, **given: str | None) -> dict[str, str]:
    """The settings that a profile decides, and the profile. `given`: by name of `RunSettings`, None if not given.

    ConfigError for a profile that has another value than a given one.
    """
    chosen = profile or "own"
    usual = OWN if chosen == "own" else PUBLISHED
    for name, value in given.items():
        if chosen != "own" and value not in (None, usual[name]):
            raise ConfigError(
                f"profile {chosen} has {name} = {usual[name]}, but {value} was given: drop one of them"
            )
    return usual | {name: value for name, value in given.items() if value is not None} | {"profile": chosen}


def run_settings(given: Any, **named: Any) -> RunSettings:
    """The settings of one run. `given`: `RunOptions`. Raises ConfigError that names the invalid option."""
    names = (
        "policy_scope",
        "observations",
        "simulation",
        "finish",
        "step_limit",
        "feedback",
        "failed_episodes",
    )
    chosen: dict[str, Any] = settings_of(
        given.profile,
        hidden_cases=given.hidden_cases and given.hidden_cases.replace("-", "_"),
        **{name: getattr(given, name) for name in names},
    )
    if chosen["feedback"] != "pictures" and given.video != "off":
        raise ConfigError(
            f"feedback {chosen['feedback']} shows no videos, and video {given.video} is asked for: leave out one of"
            " them"
        )
    counts = {"n_validation": given.validation, "n_heldout": given.heldout}
    for (name, n), fixed in zip(counts.items(), HIDDEN_COUNTS.get(chosen["profile"], ()), strict=False):
        if n not in (None, fixed):
            raise ConfigError(
                f"profile {chosen['profile']} has {name} = {fixed}, but {n} was given: drop one of them"
            )
        counts[name] = fixed
    settings = RunSettings(
        budget=given.budget,
        min_episodes_per_submit=given.min_episodes,
        max_episodes_per_submit=given.max_episodes,
        **counts,
        sandbox_tier=given.tier,
        video=given.video,
        replays=given.replays,
        limits=given.limits,
        definition=catalogue.pinned(named["env"]),
        **chosen,
        **named,
    )
    episode_counts(settings, catalogue.suite_of(settings.env))
    return settings


def agent_limits(given: Any) -> AgentLimits:
    """Limits of the agent's use of its machine; `given` as for `run_settings`. Raises ConfigError that names
    the option."""
    chosen: dict[str, Any] = {}
    for name, (field, least, most) in AGENT_LIMITS.items():
        value = getattr(given, f"agent_{name}")
        if value is None:
            continue
        if not least <= value <= most:
            raise ConfigError(f"--agent-{name} {value:g}: give a number from {least:g} to {most:g}")
        chosen[field] = value if name == "cpus" else int(value)
    return AgentLimits(**chosen)


def default_exp_id() -> str:
    """From the time, so that every run has a folder of its own."""
    return time.strftime("%Y%m%d-%H%M%S")


def one_environment(env: str) -> str:
    """The suite id that `env` names. ConfigError when it names none or several."""
    env_ids = catalogue.resolve([env])
    if len(env_ids) != 1:
        raise ConfigError(f"--env {env} names {len(env_ids)} environments; this command takes one")
    return env_ids[0]


def limits_of(texts: Sequence[str]) -> ResourceLimits:
    """`NAME=VALUE` texts over the usual limits."""
    values: dict[str, float] = {}
    for text in texts:
        name, equals, value = text.partition("=")
        if not equals:
            raise ConfigError(f"--limit {text!r}: use the form NAME=VALUE")
        try:
            values[name] = float(value)
        except ValueError:
            raise ConfigError(f"--limit {text!r}: {value!r} is not a number") from None
    return limits_from(values, "--limit ")


def limits_from(values: Mapping[str, float], prefix: str) -> ResourceLimits:
    """Limits by their names over the usual ones. ConfigError for an impossible one; `prefix` begins the error."""
    usual = ResourceLimits()
    typed: dict[str, float | int] = {}
    for name, number in values.items():
        what = f"{prefix}{name}={number:g}"
        if name not in usual.__struct_fields__:
            raise ConfigError(f"{what}: unknown limit; the limits are {', '.join(usual.__struct_fields__)}")
        if not 0 < number < float("inf"):
            raise ConfigError(f"{what}: a limit must be a finite number above 0")
        if number > (most := LARGEST_LIMITS.get(name, LARGEST_LIMIT)):
            raise ConfigError(f"{what}: {name} can be {most:,} at most")
        typed[name] = int(number) if isinstance(getattr(usual, name), int) else number
    return msgspec.structs.replace(usual, **typed)


def cases_of(text: str) -> tuple[int, ...]:
    """Case ids of a text such as `0-3,7`."""
    # The coordinator knows the number of cases; these bounds only refuse nonsense.
    bounds = Bounds(n_env_instances=10**6, min_episodes=1, max_episodes=4096, remaining_budget=4096)
    try:
        ids = ids_in(text, bounds)
    except RequestError as error:
        raise ConfigError(f"--cases {text!r}: {error.message.replace('env_instances', 'it')}") from error
    if not ids:
        raise ConfigError(f"--cases {text!r} names no case; use a form such as 0-3,7")
    return ids


def packages_for(policy: Path, requested: Sequence[str] | None) -> tuple[str, ...]:
    """The packages of `--policy-package`; where it is not given, those of the run to whose directory the policy
    belongs.

    Raises ConfigError when policies cannot have one of those."""
    if requested:
        return checked_names(requested)
    folder = policy.absolute()
    for run in (folder, *list(folder.parents)[:2]):
        with contextlib.suppress(OSError, ProtocolError):
            packages = packages_in(read_record(run).versions.fingerprint)
            try:
                policy_versions(packages)
            except ConfigError as error:
                raise ConfigError(
                    f"{run / 'run.json'} names packages of its policies: {error}; --policy-package names others in"
                    " their place"
                ) from error
            return packages
    return ()
