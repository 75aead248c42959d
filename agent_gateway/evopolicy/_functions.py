"""Python functions as agents and as policies: sent by value to the process that calls them, by cloudpickle.

Only the jail and the sandbox unpickle them. Pickled code is of one Python version; a policy says so where another one
runs.
"""

from __future__ import annotations

import shlex
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from evopolicy_common.errors import BundleError, ConfigError, raised_as
from evopolicy_common.processes.preflight import check_installed
from evopolicy_common.records.policies import bundles

_POLICY = '''"""Plays the function of `evopolicy.evaluate`."""
import pathlib
import pickle
import sys

if sys.version_info[:2] != {version}:
    raise RuntimeError(
        "the function comes from Python {version[0]}.{version[1]}, and policies run in Python %d.%d here:"
        " evaluate a folder with a policy.py" % sys.version_info[:2]
    )
PICKLED = (pathlib.Path(__file__).parent / "function.pickle").read_bytes()


class Policy:
    def __init__(self, obs_space, action_space, env_meta):
        self.act = pickle.loads(PICKLED)

    def reset(self, episode_index):
        pass
'''


def name_of(function: Callable[..., Any]) -> str:
    """The function's name, or its class's."""
    name = getattr(function, "__name__", type(function).__name__)
    return name if name.isidentifier() else "function"


def agent_of(function: Callable[..., Any], file: Path) -> str:
    """Writes the function to `file` for the jail. Returns the agent that calls it there, in the form of `--agent`."""
    file.write_bytes(_pickled(function, "agent", "its jail"))
    file.chmod(0o644)
    words = (sys.executable, "-P", "-m", "evopolicy_gateway.agents.function", str(file))
    return f"command:{shlex.join(words)}"


def policy_of(function: Callable[..., Any]) -> bundles.Bundle:
    """The policy whose actions are the function's, with cloudpickle, which unpickles it in the sandbox."""
    code = {
        "policy.py": _POLICY.format(version=sys.version_info[:2]).encode(),
        "function.pickle": _pickled(function, "policy", "the sandbox"),
    }
    import cloudpickle

    for path in Path(cloudpickle.__file__).parent.glob("*.py"):
        code[f"cloudpickle/{path.name}"] = path.read_bytes()
    bundle = bundles.pack([bundles.BundleFile(name, False, data) for name, data in code.items()])
    with raised_as(ConfigError, f"policy {name_of(function)}, with the values that it uses", BundleError):
        return bundles.load(bundle.packed, bundle.digest)


def _pickled(function: Callable[..., Any], role: str, place: str) -> bytes:
    check_installed("gateway")
    import cloudpickle

    # The place cannot import modules from outside site-packages, so the function's module is pickled with it.
    module = sys.modules.get(getattr(function, "__module__", None) or "")
    # Neither part of Python nor of a package in site-packages.
    parts = Path(getattr(module, "__file__", None) or "").parts
    own = parts and not {"site-packages", "dist-packages"} & set(parts)
    by_value = module is not None and module.__name__ != "__main__" and own
    if by_value:
        cloudpickle.register_pickle_by_value(module)
    try:
        return bytes(cloudpickle.dumps(function))
    except Exception as error:
        raise ConfigError(f"{role} {name_of(function)} cannot be sent to {place}: {error}") from error
    finally:
        if by_value:
            cloudpickle.unregister_pickle_by_value(module)
