"""Any Gymnasium environment as an `Environment`; what differs between families is a small hook.

A family subclasses `GymnasiumFamily`: which packages it needs, how an environment is made, whether a reused one gives
the same episode as a fresh one, what its `info` says about the reward. Simulators are imported when an environment of
their family is made, and not before: this module imports none.
"""

from __future__ import annotations

import contextlib
import copy
import difflib
import importlib
import io
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any, NamedTuple

import msgspec
import numpy as np

from evopolicy_common.catalogue import MAX_STEPS, USUAL_STEPS, Entry, Wrapper, is_shipped
from evopolicy_common.errors import EvopolicyError, WorkerError
from evopolicy_common.installation import add_extra
from evopolicy_common.messages.environment import Case, EnvironmentDescription, SpaceSchema
from evopolicy_worker.environments.accelerations import accelerate
from evopolicy_worker.environments.interface import rewards, settings, spaces, trial
from evopolicy_worker.environments.interface.actions import ActionCodec, compile_actions, copied
from evopolicy_worker.environments.interface.base import Environment, Frame, Observation, Step
from evopolicy_worker.environments.interface.calls import current as call
from evopolicy_worker.environments.interface.calls import described
from evopolicy_worker.environments.interface.fingerprint import adapter, versions
from evopolicy_worker.environments.interface.info import OURS, THEIRS, plain_info
from evopolicy_worker.environments.tasks import task_text
from evopolicy_worker.environments.tasks.template import About

if TYPE_CHECKING:
    import gymnasium

Convert = Callable[[Any], Any]


class Opaque(NamedTuple):
    """How a family encodes the values of one space of a kind that the protocol has no form for.

    The family names a space of a known kind, and how a value becomes one of that space and back
    (`GymnasiumFamily.encoding`). Policies, feedback and recordings have the encoded values only. The space may be a
    part of a Dict or Tuple.
    """

    space: gymnasium.Space[Any]
    """Of a known kind; what policies see."""
    encode: Convert
    """From a value of the opaque space to one of `space`."""
    decode: Convert
    """Back, for actions; gets repaired values."""


Hook = Callable[["gymnasium.Space[Any]"], Opaque | None]


def declared(space: gymnasium.Space[Any]) -> Opaque | None:
    """The encoding that a space declares itself by `encoded_space`, `encode` and `decode`; None without these."""
    parts: list[Any] = [getattr(space, name, None) for name in ("encoded_space", "encode", "decode")]
    return None if any(part is None for part in parts) else Opaque(*parts)


def visible(space: gymnasium.Space[Any], hook: Hook) -> gymnasium.Space[Any]:
    """The space with known kinds in place of opaque ones."""
    from gymnasium import spaces

    opaque = hook(space)
    if opaque is not None:
        return opaque.space
    if isinstance(space, spaces.Dict):
        # As pairs: of a dict, Gymnasium sorts the keys.
        return spaces.Dict([(key, visible(part, hook)) for key, part in space.spaces.items()])
    if isinstance(space, spaces.Tuple):
        return spaces.Tuple([visible(part, hook) for part in space.spaces])
    return space


def converter(space: gymnasium.Space[Any], hook: Hook, *, back: bool) -> Convert | None:
    """Encodes values of a space, or decodes them (`back`); None where nothing in it is opaque."""
    from gymnasium import spaces

    opaque = hook(space)
    if opaque is not None:
        return opaque.decode if back else opaque.encode
    if isinstance(space, spaces.Dict):
        named = {
            key: made for key, part in space.spaces.items() if (made := converter(part, hook, back=back))
        }
        if named:
            return lambda value: {**value, **{key: made(value[key]) for key, made in named.items()}}
    if isinstance(space, spaces.Tuple):
        parts = [converter(part, hook, back=back) for part in space.spaces]
        if any(parts):
            return lambda value: tuple(
                each if made is None else made(each) for made, each in zip(parts, value, strict=True)
            )
    return None


if TYPE_CHECKING:
    import gymnasium

_step: Callable[..., Step] = tuple.__new__
"""A `Step` of its class and a tuple, without the Python function that a NamedTuple's own name calls."""
_MISSHAPEN = (TypeError, ValueError, OverflowError, AttributeError, LookupError)
"""Exceptions that values of a wrong form raise when they are read."""
_PLAIN_WRAPPERS = {"OrderEnforcing", "PassiveEnvChecker", "TimeLimit"}
"""Wrappers that change no value; the adapter counts the steps itself, and calls in order."""


Quantity = tuple[Any, str]
"""An object, and the name of its attribute: a number, a list of numbers, or an array."""


class GymnasiumFamily:
    """How the environments of one package are made and read. The defaults suit most."""

    distributions: tuple[str, ...] = ("gymnasium",)
    """Distributions whose versions determine the episodes; the first one registers the environments."""
    also: tuple[str, ...] = ()
    """Further distributions that determine the episodes; numpy and gymnasium always do."""
    modules: tuple[str, ...] = ("gymnasium",)
    """Packages to import; a family is offered where all of them are installed."""
    extra: str = "worker"
    """Of this software, that installs them."""
    revision: int = 1
    """Counts up when the hooks of this class change what an environment plays: scores of several are not compared."""
    solved_by: Mapping[str, str] = {}
    """By Gymnasium id, `Environment.solved_by`."""
    remembers = False
    """Whether its process may keep, from episode to episode, something that a policy can write and read."""
    measures = False
    """Whether `packages` measures something in an environment that has been made."""

    def installed(self) -> bool:
        """Whether all packages are installed, without importing them."""
        return all(find_spec(module) is not None for module in self.modules)

    def needs(self) -> str:
        """The packages to install, in words."""
        return f"{' and '.join(self.distributions)}: {add_extra(self.extra)}"

    def load(self) -> None:
        """Import the packages and register their environments."""
        import gymnasium

        for name in self.modules:
            module = importlib.import_module(name)
            if module is not gymnasium:
                gymnasium.register_envs(module)

    def make(self, entry: Entry, *, render: bool) -> gymnasium.Env[Any, Any]:
        """A fresh environment with Gymnasium's defaults."""
        import gymnasium

        assert entry.gymnasium_id is not None
        # Passed only when needed: not every environment accepts a render mode.
        mode: dict[str, Any] = {"render_mode": "rgb_array"} if render else {}
        options = {"disable_env_checker": True, **copy.deepcopy(entry.kwargs)}
        try:
            return gymnasium.make(entry.gymnasium_id, **mode, **options)
        except TypeError as error:
            if not render or "unexpected keyword argument 'render_mode'" not in str(error):
                raise
        # It renders, but its constructor does not take the mode (HighwayEnv's lane-keeping-v0): the attribute is all
        # that `Env.render` reads.
        env = gymnasium.make(entry.gymnasium_id, **options)
        env.unwrapped.render_mode = "rgb_array"
        return env

    def begin(self) -> None:
        """Called before each reset: undoes what earlier episodes have changed in the library itself."""

    def encoding(self, space: gymnasium.Space[Any]) -> Opaque | None:
        """How values of a space are encoded that the protocol has no form for; None for a space of a known kind."""
        return declared(space)

    def rebuilds(self, entry: Entry) -> bool:
        """True when a reused environment may play another episode than a fresh one of the same case."""
        return False

    def parameters(self, env: gymnasium.Env[Any, Any]) -> Mapping[str, Sequence[Quantity]]:
        """The quantities of a new environment's simulator that worlds alter, by name of a parameter."""
        return {}

    def altered(self, env: gymnasium.Env[Any, Any]) -> None:
        """Called after quantities were multiplied: computes again what follows from them."""

    def info(self, info: Mapping[str, Any]) -> dict[str, Any]:
        """The plain part of a step's `info`."""
        return plain_info(info)

    def draw(self, codec: ActionCodec, rng: np.random.Generator, obs: Any) -> Any:
        """A random action after an observation, for checks. Override where hardly one of the action space does
        anything."""
        return codec.sample(rng)

    def render(self, env: gymnasium.Env[Any, Any]) -> Any:
        """A picture of the current state, without changing it."""
        return env.render()

    def task_sections(self, entry: Entry, env: gymnasium.Env[Any, Any]) -> dict[str, str]:
        """Sections of the generated task text, by heading, in place of the documentation's; "" is what it is about."""
        return {}

    def decisive(self, entry: Entry) -> tuple[str, ...]:
        """The distributions whose versions name the environment, besides those of all."""
        return self.distributions

    def packages(self, entry: Entry) -> dict[str, str]:
        """Versions of the distributions that decide this environment's numbers."""
        return versions(("numpy", "gymnasium", *self.decisive(entry), *self.also))

    def version(self, entry: Entry) -> str:
        """The environment with the versions that determine its episodes: `Ant-v5 (gymnasium 1.4.0, mujoco 3.10.0)`."""
        packages = ", ".join(f"{name} {each}" for name, each in versions(self.decisive(entry)).items())
        return f"{entry.gymnasium_id} ({packages})"


class Adapted:
    """The adapter's part of Gymnasium's interface, for an environment of another one. `raw`: the environment to which
    it leaves its steps and pictures, if it has one."""

    metadata: Mapping[str, Any] = {"render_modes": ["rgb_array"]}
    spec: Any = None
    raw: Any = None

    @property
    def unwrapped(self) -> Any:
        return self

    def step(self, action: Any) -> Any:
        return self.raw.step(action)

    def render(self) -> Any:
        return self.raw.render()

    def close(self) -> None:
        if self.raw is not None:
            self.raw.close()


class GymnasiumEnvironment(Environment):
    """One Gymnasium environment of a family. Made fresh again for a case where reuse could show."""

    def __init__(
        self, entry: Entry, family: GymnasiumFamily, *, render: bool = False, accelerations: bool = False
    ) -> None:
        self._entry, self._family, self._info = entry, family, family.info
        self._render, self._accelerate = render, accelerations
        self.accelerations: tuple[str, ...] = ()
        """Names of those in use."""
        self._factors: dict[str, float] = {}
        settings.apply(render=render)
        with quiet():
            family.load()
        call.begin(entry.id, "make")
        self.bare: gymnasium.Env[Any, Any]
        """The environment of the current episode, without the adapter."""
        self.rebuilds = family.rebuilds(entry)
        self._used = self._options_used = False
        self._steps = 0
        self._build()
        self.parameters = tuple(sorted(family.parameters(self.bare)))
        obs_schema, action_schema = self._schema("observation_space"), self._schema("action_space")
        self._observe = spaces.compile_observation(obs_schema)
        self._encode = converter(self.bare.observation_space, family.encoding, back=False)
        self._decode = converter(self.bare.action_space, family.encoding, back=True)
        self._promises = None if is_shipped(entry.id) else trial.Promises(self._schema, entry.success)
        self.action_codec = compile_actions(action_schema)
        components: Mapping[str, str] = entry.reward_components
        self._rewards = rewards.Scalarisation.of(entry, self.bare)
        if self._rewards is not None:
            components = self._rewards.texts(components)
        words, spec = family.task_sections(entry, self.bare), self.bare.spec
        about = About(entry, self.bare, obs_schema, action_schema, components, self._limit, words)
        made: dict[str, Any] = {"gymnasium_id": entry.gymnasium_id, "kwargs": entry.kwargs}
        made["reset_options"] = entry.reset_options
        made["wrappers"] = [{"wrapper": each.wrapper, "kwargs": each.kwargs} for each in entry.wrappers]
        self.solved_by = family.solved_by.get(entry.gymnasium_id or "", "")
        self.description = EnvironmentDescription(
            env=entry.id,
            env_version=family.version(entry),
            title=entry.title,
            family=entry.family,
            definition={name: value for name, value in made.items() if value},
            reward_weights={} if self._rewards is None else self._rewards.weights,
            success=entry.success,
            success_at=entry.success_at,
            obs_space=obs_schema,
            action_space=action_schema,
            obs_storage=spaces.obs_storage(obs_schema),
            max_episode_steps=self._limit,
            reward_components=tuple(components),
            reward_texts=dict(components),
            task_text=task_text(about),
            deterministic=entry.deterministic and not (spec is not None and spec.nondeterministic),
            renders="rgb_array" in ((self.bare.metadata or {}).get("render_modes") or ()),
            adapter=adapter(type(family), family.revision, entry.gymnasium_id or ""),
            packages=family.packages(entry),
        )
        try:
            msgspec.msgpack.encode(self.description)
        except (TypeError, ValueError, OverflowError) as error:
            raise WorkerError(
                f"{call}: its spaces and texts cannot be sent ({described(error)}); let them have valid Unicode and"
                " numbers of 64 bits at most"
            ) from error
        call.done()

    def alter(self, factors: dict[str, float]) -> None:
        if factors != self._factors:
            self._factors = factors
            self.bare.close()
            self._build()

    def reset(self, case: Case) -> Observation:
        # `reset(options=…)` may reconfigure an environment for good (highway-env does), so none is reused after it.
        env_id = self._entry.id
        if self._used and (self.rebuilds or self._options_used):
            call.begin(env_id, "close")
            self.bare.close()
            call.begin(env_id, "make")
            self._build()
        self._family.begin()
        self._used = True
        given = {**self._entry.reset_options, **(case.options or {})}
        self._options_used, self._steps = bool(given) or case.options is not None, 0
        call.begin(env_id, "reset")
        options = copy.deepcopy(given) if self._options_used else None
        returned = self.bare.reset(seed=case.seed, options=options)
        if self._promises is not None:
            self._promises.after_reset(returned)
        obs, _ = returned
        try:
            if self._encode is not None:
                obs = self._encode(obs)
            plain = self._observe(obs)
        except _MISSHAPEN as error:
            raise WorkerError(f"{call}, {trial.no_observation(obs, error)}") from error
        if self._promises is not None:
            self._promises.observation(plain, obs)
        call.done()
        return plain

    def step(self, action: Any) -> Step:
        steps = call.step = self._steps
        call.what = "step"
        if type(action) is not int:
            action = copied(action)
        if self._decode is not None:
            action = self._decode(action)
        returned = self.bare.step(action)
        self._steps = steps = steps + 1
        try:
            obs, reward, terminated, truncated, info = returned
            if self._encode is not None:
                obs = self._encode(obs)
            plain = self._info(info) if info else {}
            if plain and not OURS.isdisjoint(plain):
                plain = {f"{THEIRS}{key}" if key in OURS else key: value for key, value in plain.items()}
            plain["steps"] = steps
            if self._rewards is not None:
                reward = self._rewards.scalar(reward, plain)
            truncated = bool(truncated) or steps >= self._limit
            seen = obs if self._fresh else self._observe(obs)
            step = _step(Step, (seen, float(reward), bool(terminated), truncated, plain))
        except _MISSHAPEN as error:
            fault = trial.misshapen(returned, error, vector=self._rewards is not None)
            raise WorkerError(f"{call}, {fault}") from error
        if self._promises is not None:
            self._promises.after_step(step, obs, reward, *returned[2:4])
        call.done()
        return step

    def draw(self, rng: np.random.Generator, obs: Observation) -> Any:
        return self._family.draw(self.action_codec, rng, obs)

    def render(self) -> Frame:
        if not self._render:
            return super().render()
        frame = np.asarray(self._family.render(self.bare))
        if frame.ndim != 3 or frame.shape[2] != 3 or frame.dtype != np.uint8:
            raise WorkerError(f"{self._entry.id} rendered {frame.dtype} {frame.shape}, not uint8 H x W x 3")
        return np.array(frame, order="C")

    def close(self) -> None:
        call.begin(self._entry.id, "close")
        self.bare.close()
        call.done()

    def _build(self) -> None:
        entry = self._entry
        try:
            with quiet():
                env = self._family.make(entry, render=self._render)
        except Exception as error:
            if is_shipped(entry.id) or isinstance(error, EvopolicyError):
                raise
            where = f"kwargs {entry.kwargs} of its file" if entry.kwargs else "its gymnasium_id"
            made = f"{call}: gymnasium.make({entry.gymnasium_id!r})"
            raise WorkerError(
                f"{made} raised {described(error)}; correct {where}, or the environment"
            ) from error
        limits = [entry.max_episode_steps]
        while type(env).__name__ in _PLAIN_WRAPPERS:
            limits.append(getattr(env, "_max_episode_steps", None) or 0)
            env = env.env  # type: ignore[attr-defined]
        self._limit = min(MAX_STEPS, min(filter(None, limits), default=USUAL_STEPS))
        self.accelerations = ()
        if self._factors:  # No acceleration is proved for other parameters.
            self._multiply(env)
        elif self._accelerate and not entry.kwargs:
            self.accelerations = tuple(accelerate(str(entry.gymnasium_id), env))
        self._fresh = bool(self.accelerations) and not entry.wrappers and getattr(type(env), "fresh", False)
        for wrapper in entry.wrappers:
            env = _wrapped(entry.id, env, wrapper)
        self.bare = env

    def _multiply(self, env: gymnasium.Env[Any, Any]) -> None:
        for name, quantities in self._family.parameters(env).items():
            for owner, attribute in quantities:
                value, factor = getattr(owner, attribute), self._factors.get(name, 1.0)
                if isinstance(value, list):
                    setattr(owner, attribute, [each * factor for each in value])
                elif isinstance(value, np.ndarray):
                    value *= factor  # MuJoCo's arrays are views of its model.
                else:
                    setattr(owner, attribute, value * factor)
        self._family.altered(env)

    def _schema(self, name: str) -> SpaceSchema:
        try:
            return spaces.to_schema(visible(getattr(self.bare, name), self._family.encoding))
        except (TypeError, ValueError) as error:
            raise WorkerError(f"environment {self._entry.id}, {name}: {error}") from error

    def try_out(self) -> None:
        """Plays a few random steps. WorkerError that names the environment, the field and the remedy where an
        observation, a reward or an info is not as the environment's spaces promise."""
        if self._promises is not None:
            self._promises.strict = True
        trial.play_trial(self)


def _wrapped(env_id: str, env: gymnasium.Env[Any, Any], wrapper: Wrapper) -> gymnasium.Env[Any, Any]:
    """`env` in that wrapper. Raises WorkerError, naming environment and wrapper, when the wrapper is unknown or cannot
    be applied with its arguments."""
    where = f"environment {env_id}, wrapper {wrapper.wrapper!r}"
    path, colon, name = wrapper.wrapper.rpartition(":")
    try:
        module = importlib.import_module(path if colon else "gymnasium.wrappers")
        make = getattr(module, name)
    except (ImportError, AttributeError, ValueError) as error:
        near = [] if colon else difflib.get_close_matches(name, dir(module), n=3)
        hint = f"near: {', '.join(near)}" if near else "say a class of gymnasium.wrappers, or module:Class"
        raise WorkerError(f"{where}: no wrapper has this name; {hint}") from error
    except Exception as error:
        raise WorkerError(
            f"{where}: its module {path!r} raised {type(error).__name__}: {error} on import; correct the module"
        ) from error
    try:
        made: gymnasium.Env[Any, Any] = make(env, **copy.deepcopy(wrapper.kwargs))
    except Exception as error:
        raise WorkerError(
            f"{where}, kwargs {wrapper.kwargs}: it cannot be put around the environment: {type(error).__name__}:"
            f" {error}"
        ) from error
    return made


@contextlib.contextmanager
def quiet() -> Iterator[None]:
    """Nothing that a library has to say at import or make: deprecations, notices, greetings."""
    sink = io.StringIO()
    with warnings.catch_warnings(), contextlib.redirect_stdout(sink), contextlib.redirect_stderr(sink):
        warnings.simplefilter("ignore")
        yield
