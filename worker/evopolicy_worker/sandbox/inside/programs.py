"""Policies of the newest published form (`policy/v2`): `make_policy(context)` returns an object with
`act(observation)`.

- Such a policy plays unchanged in place of a `Policy`: each episode has a new one.
- Arrays reach it as `TensorValue`, and its actions may be `TensorValue`. An action that the published software refuses
  is refused here too.
- The module `evopolicygym.policy` that it imports is made here; a module of that name in the bundle comes first.

Standard library and numpy only: the sandbox shows nothing else. Loaded by the zygote, before any policy.
"""

import dataclasses
import hashlib
import math
import sys
import types
from collections.abc import Callable, Mapping
from importlib import machinery
from typing import Any, Protocol

import numpy as np

MODULE = "evopolicygym.policy"
POLICY_ABI_VERSION = "policy/v2"
DTYPES = {"bool", "float16", "float32", "float64"}
DTYPES |= {f"{sign}int{n}" for sign in ("", "u") for n in (8, 16, 32, 64)}
MAX_DEPTH = 32
MAX_NODES = 65_536


@dataclasses.dataclass(frozen=True)
class TensorValue:
    """An array as plain values: data in C order, little-endian."""

    dtype: str
    shape: tuple[int, ...]
    data: bytes

    def __post_init__(self) -> None:
        if self.dtype not in DTYPES:
            raise ValueError(f"a tensor of dtype {self.dtype!r}")
        if type(self.shape) is not tuple or any(type(n) is not int or n < 0 for n in self.shape):
            raise TypeError("a tensor's shape must be a tuple of whole numbers")
        if type(self.data) is not bytes:
            raise TypeError("a tensor's data must be bytes")
        dtype = np.dtype(self.dtype)
        if len(self.data) != math.prod(self.shape) * dtype.itemsize:
            raise ValueError(
                f"a tensor of shape {self.shape} and dtype {self.dtype} with {len(self.data)} bytes"
            )
        if dtype.kind == "f" and not np.isfinite(array_of(self)).all():
            raise ValueError("a tensor's numbers must be finite")
        if dtype.kind == "b" and not set(self.data) <= {0, 1}:
            raise ValueError("a tensor of truth values must have the bytes 0 and 1")


PolicyScalar = None | bool | int | float | str | bytes
PolicyValue = PolicyScalar | TensorValue | list[Any] | tuple[Any, ...] | dict[str, Any]


@dataclasses.dataclass(frozen=True)
class PolicyContext:
    """The argument of `make_policy`."""

    observation_space: Any
    action_space: Any
    metadata: Mapping[str, Any]
    environment_parameters: Mapping[str, Any]
    policy_seed: int


class Policy(Protocol):
    """The result of `make_policy`."""

    def act(self, observation: Any) -> Any: ...


def copy_policy_value(value: Any) -> Any:
    """A copy. Raises TypeError or ValueError for what is no PolicyValue."""
    return converted(value, lambda tensor: tensor)


def converted(value: Any, of_tensor: Callable[[TensorValue], Any]) -> Any:
    """A copy with `of_tensor` applied to tensors. Raises TypeError or ValueError for what is no PolicyValue."""
    n_parts = 0

    def copy(value: Any, depth: int) -> Any:
        nonlocal n_parts
        n_parts += 1
        if n_parts > MAX_NODES or depth > MAX_DEPTH:
            raise ValueError(f"a value of more than {MAX_NODES:,} parts, or nested deeper than {MAX_DEPTH}")
        kind = type(value)
        if value is None or kind in (bool, str, bytes):
            return value
        if kind is int and -(1 << 63) <= value < 1 << 64:
            return value
        if kind is float and math.isfinite(value):
            return value
        if kind is TensorValue:
            return of_tensor(value)
        if kind in (list, tuple):
            return kind([copy(part, depth + 1) for part in value])
        if kind is dict and all(type(key) is str for key in value):
            return {key: copy(part, depth + 1) for key, part in value.items()}
        raise (ValueError if kind in (int, float) else TypeError)(
            f"{kind.__name__} {str(value)[:40]!r} is no value that a policy may return"
        )

    return copy(value, 0)


class MissingParameterError(KeyError):
    """A policy has read an environment parameter."""

    def __str__(self) -> str:
        name = repr(self.args[0])[:100]
        return f"there is no environment parameter {name}: environments are played with Gymnasium's defaults here"


class NoParameters(dict[str, Any]):
    def __missing__(self, name: str) -> Any:
        raise MissingParameterError(name)


def needs_newer(error: BaseException, source: bytes) -> str:
    """A remark on an error of the import of a policy of this form that an earlier Python may cause; "" without one."""
    odd = isinstance(error, SyntaxError | ImportError) and b"make_policy" in source
    if not odd or sys.version_info[:2] >= (3, 12):
        return ""
    own = f"{sys.version_info[0]}.{sys.version_info[1]}"
    return f" (this worker has Python {own}; policies of this form are written for Python 3.12)"


def array_of(tensor: TensorValue) -> Any:
    return np.frombuffer(tensor.data, np.dtype(tensor.dtype).newbyteorder("<")).reshape(tensor.shape)


def given(value: Any) -> Any:
    """An observation as a PolicyValue."""
    if isinstance(value, np.ndarray):
        data = value.astype(value.dtype.newbyteorder("<"), copy=False).tobytes()
        return TensorValue(value.dtype.name, value.shape, data)
    if isinstance(value, dict):
        return {key: given(part) for key, part in value.items()}
    if isinstance(value, list | tuple):
        return type(value)(map(given, value))
    return value


def is_program(module: types.ModuleType) -> bool:
    """Whether the module is a policy of this form. One of the earlier form has a class `Policy` with `reset`."""
    earlier = getattr(module, "Policy", None)
    return callable(getattr(module, "make_policy", None)) and not hasattr(earlier, "reset")


class Program:
    """Plays such a module as a `Policy`."""

    def __init__(
        self, module: types.ModuleType, spaces: tuple[Any, Any], env_meta: dict[str, Any], seed: bytes
    ) -> None:
        self._make = vars(module)["make_policy"]
        self._spaces = spaces
        self._metadata = {name: value for name, value in env_meta.items() if not name.endswith("_space")}
        self._seed = seed
        # Made before the first episode, so that a fault in it is the whole submit's.
        self._next = self._made(0)
        self._act = self._next.act
        self._n = 0

    def _made(self, number: int) -> Any:
        seed = hashlib.sha256(self._seed + number.to_bytes(8, "big")).digest()
        observation_space, action_space = self._spaces
        return self._make(
            PolicyContext(
                observation_space=copy_policy_value(observation_space),
                action_space=copy_policy_value(action_space),
                metadata=copy_policy_value(self._metadata),
                environment_parameters=NoParameters(),
                policy_seed=int.from_bytes(seed[:8], "big"),
            )
        )

    def reset(self, episode_index: int) -> None:
        if self._n:
            self._next = self._made(self._n)
            self._act = self._next.act
        self._n += 1

    def act(self, obs: Any) -> Any:
        return converted(self._act(given(obs)), array_of)


class Finder:
    """Finds `evopolicygym.policy` where nothing else does."""

    @staticmethod
    def find_spec(name: str, path: Any = None, target: Any = None) -> machinery.ModuleSpec | None:
        if name not in (MODULE, MODULE.partition(".")[0]):
            return None
        return machinery.ModuleSpec(name, Finder, is_package=name != MODULE)  # type: ignore[arg-type]

    @staticmethod
    def create_module(spec: machinery.ModuleSpec) -> None:
        return None

    @staticmethod
    def exec_module(module: types.ModuleType) -> None:
        if module.__name__ == MODULE:
            vars(module).update({name: globals()[name] for name in EXPORTED})


EXPORTED = (
    *("PolicyContext", "PolicyValue", "PolicyScalar", "TensorValue", "Policy"),
    *("copy_policy_value", "POLICY_ABI_VERSION"),
)
for _name in EXPORTED:
    if isinstance(globals()[_name], type | types.FunctionType):
        globals()[_name].__module__ = MODULE
sys.meta_path.append(Finder)
