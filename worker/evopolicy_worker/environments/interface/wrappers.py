"""Wrappers that an environment file requests."""

from __future__ import annotations

import difflib
import importlib
from typing import TYPE_CHECKING, Any

from evopolicy_common.catalogue import Wrapper
from evopolicy_common.errors import WorkerError

if TYPE_CHECKING:
    import gymnasium


def wrapped(env_id: str, env: gymnasium.Env[Any, Any], wrapper: Wrapper) -> gymnasium.Env[Any, Any]:
    """`env` in that wrapper. Raises WorkerError, naming environment and wrapper, when the wrapper is unknown or cannot
    be applied with its arguments."""
    where = f"environment {env_id}, wrapper {wrapper.wrapper!r}"
    module, colon, name = wrapper.wrapper.rpartition(":")
    try:
        module_found = importlib.import_module(module if colon else "gymnasium.wrappers")
        make = getattr(module_found, name)
    except (ImportError, AttributeError, ValueError) as error:
        near = [] if colon else difflib.get_close_matches(name, dir(module_found), n=3)
        hint = f"near: {', '.join(near)}" if near else "say a class of gymnasium.wrappers, or module:Class"
        raise WorkerError(f"{where}: no wrapper has this name; {hint}") from error
    except Exception as error:
        raise WorkerError(
            f"{where}: its module {module!r} raised {type(error).__name__}: {error} on import; correct the module"
        ) from error
    try:
        made: gymnasium.Env[Any, Any] = make(env, **wrapper.kwargs)
    except Exception as error:
        raise WorkerError(
            f"{where}, kwargs {wrapper.kwargs}: it cannot be put around the environment: {type(error).__name__}:"
            f" {error}"
        ) from error
    return made
