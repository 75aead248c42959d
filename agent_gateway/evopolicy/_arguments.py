"""What each argument of the public functions may be. A wrong one is refused before anything starts."""

from __future__ import annotations

import difflib
import math
import os
import reprlib
from collections.abc import Callable, Iterable, Mapping
from operator import index
from pathlib import Path
from typing import Any, NamedTuple, get_args

from evopolicy_common.errors import ConfigError
from evopolicy_common.messages.episode import Tier
from evopolicy_common.messages.gateway import FeedbackDetail, VideoOption


class Rule(NamedTuple):
    take: Callable[[Any], Any]
    """Returns the value as it is used. Raises TypeError or ValueError for one that cannot be."""
    words: str
    """Completes the sentence "give …"."""


def _text(value: Any) -> str:
    if not isinstance(value, str):
        raise TypeError
    if not value:
        raise ValueError
    return value


def _path(value: Any) -> Path:
    return Path(_text(os.fspath(value)))


def _whole(least: int) -> Callable[[Any], int]:
    def take(value: Any) -> int:
        number = index(value)  # numpy's integers too
        if isinstance(value, bool) or number < least:
            raise ValueError
        return number

    return take


def _least(least: float) -> Callable[[Any], float]:
    def take(value: Any) -> float:
        number = float(value)
        if isinstance(value, str | bool) or not least <= number < math.inf:
            raise ValueError
        return number

    return take


def _flag(value: Any) -> bool:
    if not isinstance(value, bool):
        raise TypeError
    return value


def _agent(value: Any) -> Any:
    return value if callable(value) else _text(value)


def _cases(value: Any) -> tuple[int, ...]:
    return tuple(map(index, value))


def _names(value: Any) -> tuple[str, ...]:
    if isinstance(value, str):
        raise TypeError
    return tuple(sorted({_text(name) for name in value}))


def _limits(value: Any) -> dict[str, float]:
    if not isinstance(value, Mapping):
        raise TypeError
    if any(isinstance(number, str | bool) for number in value.values()):
        raise ValueError
    return {_text(name): float(number) for name, number in value.items()}


def _choice(kind: Any, *, optional: bool = False) -> Rule:
    allowed = get_args(kind)

    def take(value: Any) -> Any:
        if value not in allowed:
            raise ValueError
        return value

    rule = Rule(take, " or ".join(map(repr, allowed)))
    return _or_none(rule) if optional else rule


def _or_none(rule: Rule) -> Rule:
    return Rule(lambda value: None if value is None else rule.take(value), f"{rule.words}, or None")


_FILE = Rule(_path, "the path of a file")
_FOLDER = Rule(_path, "the path of a folder")
_NAME = Rule(_text, "a text")
_NUMBER = Rule(_least(0.0), "a number")
_COUNT = Rule(_whole(1), "a whole number of at least 1")

RULES: dict[str, Rule] = {
    "agent": Rule(_agent, "a function of one Workspace, or a text as for --agent, such as 'evolve'"),
    "agent_cpus": _or_none(_NUMBER),
    "agent_disk": _or_none(_NUMBER),
    "agent_memory": _or_none(_NUMBER),
    "agent_pids": _or_none(_COUNT),
    "agent_wall_s": Rule(_least(1.0), "a number of seconds, at least 1"),
    "agents_md": _or_none(_FILE),
    "budget": _or_none(_COUNT),
    "cases": Rule(_cases, "train ids, such as range(8) or [0, 3]"),
    "credentials": _or_none(_FOLDER),
    "data": _or_none(_FOLDER),
    "endpoint": Rule(_text, "a text such as 'tls/host:7447'"),
    "entry": _or_none(_NAME),
    "env": Rule(_text, "the id of an environment, such as 'gym/acrobot'"),
    "exp_id": _or_none(_NAME),
    "feedback": _choice(FeedbackDetail, optional=True),
    "folder": _FOLDER,
    "fresh": Rule(_flag, "True or False"),
    "heldout": _or_none(_COUNT),
    "limits": _or_none(Rule(_limits, "a mapping of names to numbers, such as {'act_wall_s': 5}")),
    "model": _or_none(_NAME),
    "overwrite": Rule(_flag, "True or False"),
    "policy": _FOLDER,
    "policy_packages": Rule(_names, "a sequence of names, such as ('scipy',)"),
    "profile": _or_none(Rule(_text, "'published' or 'published-data'")),
    "progress": Rule(_flag, "True or False"),
    "prices": _or_none(_FILE),
    "prompts": _or_none(_FILE),
    "repeat": Rule(_whole(0), "a whole number of at least 0"),
    "replays": _choice(VideoOption, optional=True),
    "runs": _FOLDER,
    "slots": _COUNT,
    "state": _or_none(_FOLDER),
    "tier": _choice(Tier),
    "validation": _or_none(_COUNT),
}
"""By the name of the argument."""


def taken(**given: Any) -> dict[str, Any]:
    """The arguments as they are used. Raises ConfigError that names the first wrong one."""
    return {name: take(name, value) for name, value in given.items()}


def take(name: str, value: Any) -> Any:
    """As `taken`, for one argument."""
    rule = RULES[name]
    try:
        return rule.take(value)
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
