"""How texts of options are read. A wrong one is a ConfigError."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

import msgspec

from evopolicy_common import catalogue
from evopolicy_common.errors import ConfigError, ProtocolError, RequestError
from evopolicy_common.messages.episode import LARGEST_LIMIT, LARGEST_LIMITS, ResourceLimits
from evopolicy_common.processes.packages import checked_names, packages_in, policy_versions
from evopolicy_common.records.run_files import read_record
from evopolicy_gateway.submits.submit_request import Bounds, ids_in


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
