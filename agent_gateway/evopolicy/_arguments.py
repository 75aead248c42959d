"""The rules for each argument of the public functions. A wrong one is refused before anything starts."""

from __future__ import annotations

import difflib
import math
import os
import re
import reprlib
from collections.abc import Callable, Iterable, Mapping
from operator import index
from pathlib import Path
from typing import Any, Literal, NamedTuple, TypedDict, get_args, get_origin

from evopolicy_common.errors import ConfigError
from evopolicy_common.messages.environment import FailedEpisodes, ObservationForm, PolicyScope, StepLimit
from evopolicy_common.messages.episode import ResourceLimits, Tier
from evopolicy_common.messages.gateway import (
    FeedbackDetail,
    FinishRule,
    Profile,
    SimulationRule,
    VideoOption,
)
from evopolicy_gateway.declared import Declared, declared
from evopolicy_gateway.run import run_options
from evopolicy_gateway.run.run_options import limits_from

AnyPath = str | os.PathLike[str]


class RunKeywords(TypedDict, total=False):
    """Further keywords of `evopolicy.run`, as the options of `evopolicy run` with these names:"""

    # For type checkers and editors, which cannot see the declarations in `run_options`. A test compares them.
    budget: int | None
    profile: Profile | None
    runs: AnyPath
    exp_id: str | None
    overwrite: bool
    entry: str | None
    model: str | None
    repeat: int
    validation: int | None
    heldout: int | None
    hidden_cases: Literal["shared", "per-run"] | None
    replays: VideoOption | None
    min_episodes: int | None
    max_episodes: int | None
    policy_scope: PolicyScope | None
    observations: ObservationForm | None
    step_limit: StepLimit | None
    failed_episodes: FailedEpisodes | None
    tier: Tier
    limits: Mapping[str, float] | None
    video: VideoOption
    feedback: FeedbackDetail | None
    start_from: str | None
    agents_md: AnyPath | None
    prompts: AnyPath | None
    prices: AnyPath | None
    simulation: SimulationRule | None
    finish: FinishRule | None
    record_model: Literal["off", "digests", "full"]
    agent_wall_s: float
    agent_silence_s: float
    agent_cpus: float | None
    agent_memory: float | None
    agent_pids: int | None
    agent_disk: float | None


class Rule(NamedTuple):
    checked: Callable[[Any], Any]
    """Returns the value as it is used. Raises TypeError or ValueError for one that cannot be."""
    words: str
    """Completes the sentence "give …"."""


def _checked(kind: type[object], *, filled: bool = False) -> Callable[[Any], Any]:
    """Takes values of a type; `filled`: not an empty one."""

    def checked(value: object) -> Any:
        if not isinstance(value, kind) or (filled and not value):
            raise TypeError
        return value

    return checked


_text = _checked(str, filled=True)


def _path(value: Any) -> Path:
    return Path(_text(os.fspath(value)))


def _whole(least: int) -> Callable[[Any], int]:
    def checked(value: Any) -> int:
        number = index(value)  # numpy's integers too
        if isinstance(value, bool) or number < least:
            raise ValueError
        return number

    return checked


def _least(least: float) -> Callable[[Any], float]:
    def checked(value: Any) -> float:
        number = float(value)
        if isinstance(value, str | bool) or not least <= number < math.inf:
            raise ValueError
        return number

    return checked


def _agent(value: object) -> Any:
    return value if callable(value) else _text(value)


def _policy(value: object) -> Any:
    if isinstance(value, type):
        raise TypeError
    return value if callable(value) else _path(value)


def _cases(value: Any) -> tuple[int, ...]:
    return tuple(map(index, value))


def _names(value: Any) -> tuple[str, ...]:
    if isinstance(value, str):
        raise TypeError
    return tuple(sorted({_text(name) for name in value}))


def _limits(value: object) -> ResourceLimits:
    if not isinstance(value, Mapping) or any(isinstance(number, str | bool) for number in value.values()):
        raise TypeError
    return limits_from({_text(name): float(number) for name, number in value.items()}, "limits: ")


def _choice(kind: object) -> Rule:
    allowed = get_args(kind)

    def checked(value: object) -> Any:
        if value not in allowed:
            raise ValueError
        return value

    return Rule(checked, " or ".join(map(repr, allowed)))


def _or_none(rule: Rule) -> Rule:
    return Rule(lambda value: None if value is None else rule.checked(value), f"{rule.words}, or None")


_FOLDER = Rule(_path, "the path of a folder")
_FLAG = Rule(_checked(bool), "True or False")
_KINDS = {
    bool: _FLAG,
    ResourceLimits: Rule(_limits, "a mapping of names to numbers, such as {'act_wall_s': 5}"),
    str: Rule(_text, "a text"),
}


def _rule(one: Declared) -> Rule:
    """The rule of an option of a run."""
    optional = type(None) in get_args(one.type)
    kind = get_args(one.type)[0] if optional else one.type
    if get_origin(kind) is Literal:
        rule = _choice(kind)
    elif kind is int:
        least = 1 if one.bounds.ge is None else int(one.bounds.ge)
        rule = Rule(_whole(least), f"a whole number of at least {least}")
    elif kind is float:
        words = "a number" if one.bounds.ge is None else "a number of seconds, at least 1"
        rule = Rule(_least(one.bounds.ge or 0.0), words)
    elif kind is Path:
        rule = Rule(_path, "the path of a file") if one.option.metavar else _FOLDER
    else:
        rule = _KINDS[kind]
    return _or_none(rule) if optional or kind is ResourceLimits else rule


OPTIONS = {one.name: one for one in declared(run_options.RunOptions).values() if one.option.python}
_HELPS = (f"`{one.name}`: {one.help}" for one in OPTIONS.values() if one.name != "agent")
RunKeywords.__doc__ = "\n".join([f"{RunKeywords.__doc__}\n", *_HELPS])
RULES: dict[str, Rule] = {
    **{name: _rule(one) for name, one in OPTIONS.items()},
    "agent": Rule(_agent, "a function of one Workspace, or a text as for --agent, such as 'evolve'"),
    "cases": Rule(_cases, "train ids, such as range(8) or [0, 3]"),
    "credentials": _or_none(_FOLDER),
    "data": _or_none(_FOLDER),
    "endpoint": Rule(_text, "a text such as 'tls/host:7447'"),
    "env": Rule(_text, "the id of an environment, such as 'gym/acrobot'"),
    "folder": _FOLDER,
    "fresh": _FLAG,
    "policy": Rule(_policy, "the path of a folder, or a function of an observation"),
    "policy_packages": Rule(_names, "a sequence of names, such as ('scipy',)"),
    "progress": _FLAG,
    "slots": Rule(_whole(1), "a whole number of at least 1"),
    "state": _or_none(_FOLDER),
}
"""By the name of the argument."""


def taken(**given: object) -> dict[str, Any]:
    """The arguments as they are used. Raises ConfigError that names the first wrong one."""
    return {name: check_argument(name, value) for name, value in given.items()}


def check_argument(name: str, value: object) -> Any:
    """As `taken`, for one argument."""
    rule = RULES[name]
    try:
        return rule.checked(value)
    except (TypeError, ValueError, OverflowError):
        raise ConfigError(f"{name} is {reprlib.repr(value)}: give {rule.words}") from None


def check_names(given: Iterable[str], allowed: Iterable[str]) -> None:
    """Raises ConfigError for an argument that there is not."""
    known = sorted(allowed)
    for name in given:
        if name not in known:
            near = difflib.get_close_matches(name, known, 1)
            advice = f"did you mean {near[0]}?" if near else f"there are {', '.join(known)}"
            raise ConfigError(f"unknown argument {name}: {advice}")


_KEYWORDS = {
    one.flag: f"{one.name}=True" if one.type is bool else one.name
    for one in (*OPTIONS.values(), *declared(run_options.ClusterOptions).values())
} | {"--policy-package": "policy_packages", "--cases": "cases", "--env": "env"}


def in_python(text: str) -> str:
    """An error's text with keywords in place of options, such as `overwrite=True` for `--overwrite`. Commands in
    backticks stay."""
    parts = text.split("`")
    for n in range(0, len(parts), 2):
        parts[n] = re.sub(r"(?<![\w-])--[a-z][a-z-]*", lambda flag: _KEYWORDS.get(flag[0], flag[0]), parts[n])
    return "`".join(parts)
