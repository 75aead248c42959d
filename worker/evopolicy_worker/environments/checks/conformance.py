"""Checks by playing whether environments follow the rules of the interface.

As a program, `python -m evopolicy_worker.environments.checks.conformance STEPS ID…` prints one line of JSON, a
`CheckResult`, for each id. It loads a family once and forks a process per id, so that a crash or hang affects only that
environment.
`evopolicy-worker check-env` runs two such programs with different hash seeds and compares the results.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import pickle
import resource
import select
import signal
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from ctypes.util import find_library
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from evopolicy_common.catalogue import Entry
from evopolicy_common.errors import EvopolicyError
from evopolicy_common.messages.environment import Case
from evopolicy_common.processes import proc
from evopolicy_common.processes.parent_death import end_with_parent
from evopolicy_common.processes.scratch import remove_tree
from evopolicy_common.records.episodes.npz import MAX_BYTES, read_arrays
from evopolicy_common.records.episodes.rendered import Renderer, decode
from evopolicy_worker.environments import registry
from evopolicy_worker.environments.interface import spaces
from evopolicy_worker.environments.interface.base import Environment, Step
from evopolicy_worker.environments.interface.trial import SEEDED

SEEDS = (20_011_117, 20_011_229)
"""Large, so that an occurrence in an observation or info is recognisable as a leak."""
TIMEOUT_S = 300.0
"""Most processor time that one environment may use, all its processes together, and longest time in which it may use
none, seconds. A short limit on time alone would also count what else the machine does."""
LONGEST_S = 3600.0
"""Longest time for one environment, seconds: one that polls for what never comes uses a little processor time for
days."""
_POLL_S = 1.0
_WORKS_S = 0.05
"""A process that has used so much more processor time since the last check has not hung, seconds."""
_REMOVALS, _REMOVAL_S = 20, 0.1
"""How often the removal of a process's temporary files is tried, and the pause between, seconds."""
_RENDERED_STEPS = 10
"""So many steps of an episode are also drawn."""
_NONSENSE: tuple[Any, ...] = (None, "nonsense", float("nan"), 10**400, [[[]]], {"a": 1}, np.full(3, np.inf))


class CheckResult(msgspec.Struct, kw_only=True):
    """Result of playing one environment in one process."""

    env: str
    faults: list[str] = []
    """Violations in words; empty when all checks passed."""
    steps: int = 0
    """Steps of the episode whose digests are compared."""
    limit: int = 0
    ended: str = ""
    """How that episode ended: `terminated`, `truncated`, or `going on` when the maximum of steps came first."""
    digest: str = ""
    """Digest of all its observations, rewards, end flags and infos."""
    fresh: bool = False
    """Whether a newly made environment played the same episode."""
    reused: bool = False
    """Whether the same environment, after another episode, played the same episode again."""
    repeats: bool = True
    """Whether its definition says that seed and actions determine an episode; otherwise none are compared."""
    rebuilt: bool = False
    """Whether it is made anew for each episode."""
    step_bytes: int = 0
    """Mean bytes per step in the feedback of a train episode."""
    memory_mb: int = 0
    """Peak memory of the process, MiB."""
    rendered: str = ""
    """`same`: an episode that is drawn is the same. `none`: it is never drawn. Empty: not tried,
    as this machine cannot draw."""

    def verdict(self, other: CheckResult | None) -> str:
        """`ok`, or all violations. `other`: the result in another process."""
        wrong = list(self.faults)
        if not wrong and self.repeats:
            wrong += [] if self.fresh else ["a fresh one plays another episode"]
            wrong += [] if self.reused else ["a reused one plays another episode"]
            if other is not None and other.digest != self.digest:
                wrong.append("another process plays another episode")
            wrong += [SEEDED] if wrong else []
        return "; ".join(wrong) or "ok"


def play_checked(env_id: str, steps: int) -> CheckResult:
    """Plays an environment in this process, at most `steps` steps per episode. Exceptions become faults."""
    played = CheckResult(env=env_id)
    try:
        _play(played, steps)
    except EvopolicyError as error:
        played.faults.append(str(error))
    except (Exception, SystemExit) as error:
        played.faults.append(f"it raised {type(error).__name__}: {error}")
    played.faults = [" ".join(each.split())[:300] for each in played.faults]
    played.memory_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss >> 10
    return played


def _play(played: CheckResult, steps: int) -> None:
    environment = registry.make(played.env)
    description = environment.description
    played.limit, played.rebuilt = description.max_episode_steps, environment.rebuilds
    played.repeats = description.deterministic
    with _no_pickles(played):
        first = digest_of(_checked(played, environment, steps))
    played.digest = first
    digest(environment, SEEDS[1], steps)
    played.reused = digest(environment, SEEDS[0], steps) == first
    _nonsense(environment)
    environment.close()
    again = registry.make(played.env)
    played.fresh = digest(again, SEEDS[0], steps) == first
    played.rendered = _rendered(played, again, min(steps, _RENDERED_STEPS)) if description.renders else "none"
    again.close()


def _rendered(played: CheckResult, plain: Environment, steps: int) -> str:
    """Plays an episode that is drawn at each step, and one that is not."""
    if find_library("EGL") is None:
        return ""
    drawn = registry.make(played.env, render=True)
    there = digest(drawn, SEEDS[0], steps, drawn=True)
    drawn.close()
    if there == digest(plain, SEEDS[0], steps):
        return "same"
    if not played.repeats:
        return "differs"
    played.faults.append("an episode that is drawn is another one")
    return "differs"


def _checked(played: CheckResult, environment: Environment, steps: int) -> Iterator[tuple[Any, Step]]:
    description, seed = environment.description, SEEDS[0]
    recorder = Renderer("arrays", description.obs_storage)
    obs: Any = None
    check = spaces.compile_checker(description.obs_space)
    for n, (action, step) in enumerate(rollout(environment, seed, steps)):
        if n:
            recorder.append(obs, action, step.reward, step.terminated, step.truncated, step.info)
            if not np.isfinite(step.reward):
                played.faults.append(f"step {n}: the reward is {step.reward}")
            if seed in _numbers(step.info) or any("seed" in key for key in step.info):
                played.faults.append(f"step {n}: info names the seed")
        obs = step.obs
        if len(played.faults) < 3:
            if fault := check(obs):
                played.faults.append(f"step {n}: the observation is outside its space: {fault}")
            if {float(each) for each in SEEDS} & _numbers(obs):
                played.faults.append(f"step {n}: the observation names the seed")
        yield action, step
    played.steps = n
    played.ended = "terminated" if step.terminated else "truncated" if step.truncated else "going on"
    limit = description.max_episode_steps
    if (played.ended == "truncated" and n > limit) or (played.ended == "going on" and n >= limit):
        played.faults.append(f"its limit of {limit} steps is not kept")
    files = decode(recorder.finish()).files
    played.step_bytes = round(sum(map(len, files.values())) / n)
    for name, data in files.items():
        try:
            if name.endswith(".npz"):
                read_arrays(data, MAX_BYTES)
        except ValueError as error:
            played.faults.append(f"{name} cannot be read without pickle: {error}")


@contextlib.contextmanager
def _no_pickles(played: CheckResult) -> Iterator[None]:
    """Notes whether something is pickled meanwhile: that would be code of the environment's in what others read."""

    def noting(name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        def call(*given: Any, **named: Any) -> Any:
            fault = f"an episode needs pickle.{name}"
            if fault not in played.faults:
                played.faults.append(fault)
            return function(*given, **named)

        return call

    with contextlib.ExitStack() as restored:
        for name in ("dump", "dumps", "load", "loads"):
            usual = getattr(pickle, name)
            restored.callback(setattr, pickle, name, usual)
            setattr(pickle, name, noting(name, usual))
        yield


def _nonsense(environment: Environment) -> None:
    environment.reset(Case(seed=SEEDS[0]))
    for raw in _NONSENSE:
        action, invalid = environment.action_codec.repair(raw)
        if not invalid:
            continue
        step = environment.step(action)
        if step.terminated or step.truncated:
            environment.reset(Case(seed=SEEDS[0]))


def _numbers(value: Any) -> set[float]:
    """All numbers in a value, except those in large arrays, where a seed could occur by chance."""
    if isinstance(value, np.ndarray):
        return set(np.ravel(value).astype(float).tolist()) if value.size <= 4096 else set()
    if isinstance(value, dict | list | tuple):
        return set().union(*map(_numbers, value.values() if isinstance(value, dict) else value))
    return {float(value)} if isinstance(value, int | float) and abs(value) < 2**53 else set()


def play_all(env_ids: list[str], steps: int) -> Iterator[CheckResult]:
    """Plays each environment in a process forked for it."""
    for env_id in env_ids:
        registry.load(env_id)
        yield _in_child(env_id, steps)


def _in_child(env_id: str, steps: int) -> CheckResult:
    temporary = Path(tempfile.mkdtemp(prefix="check-"))
    reading, writing = os.pipe()
    pid = os.fork()
    if pid == 0:
        try:
            end_with_parent(signal.SIGKILL)
            os.environ["TMPDIR"] = tempfile.tempdir = str(temporary)
            os.close(reading)
            with os.fdopen(writing, "wb") as out:
                null = os.open(os.devnull, os.O_WRONLY)
                os.dup2(null, 1)
                os.dup2(null, 2)
                out.write(msgspec.json.encode(play_checked(env_id, steps)))
        finally:
            try:
                _kill(proc.descendants(os.getpid()))  # fails if the environment allows no more files
            finally:
                os._exit(0)
    os.close(writing)
    data, why = b"", ""
    try:
        with os.fdopen(reading, "rb") as answer:
            for why in _passed_limits(pid):
                if why:
                    break
                if select.select([answer], [], [], _POLL_S)[0]:
                    part = os.read(answer.fileno(), 1 << 16)
                    if not part:
                        break
                    data += part
        if why:
            _kill([each.pid for each in proc.family(pid)])
        status = os.waitpid(pid, 0)[1]
    finally:
        # The process never gets to tidy up, and a program that it has started may write until it has ended.
        for _ in range(_REMOVALS):
            remove_tree(temporary)
            if not temporary.exists():
                break
            time.sleep(_REMOVAL_S)
    if data and not why:
        return msgspec.json.decode(data, type=CheckResult)
    return CheckResult(env=env_id, faults=[why or f"its process ended with status {status}"])


def _passed_limits(pid: int) -> Iterator[str]:
    """Again and again, why a process is to be ended, in words; empty while it may go on. See `TIMEOUT_S` and
    `LONGEST_S`."""
    worked_s, began = 0.0, time.monotonic()
    worked_at = began
    while True:
        # Of the process and of those that it has started.
        used_s, now = sum(each.cpu_s for each in proc.family(pid)), time.monotonic()
        if used_s > worked_s + _WORKS_S:
            worked_s, worked_at = used_s, now
        if worked_s > TIMEOUT_S:
            yield f"it was not done within {TIMEOUT_S:g} s of processor time"
        elif now - worked_at > TIMEOUT_S:
            yield f"it hangs: it has used no processor time for {TIMEOUT_S:g} s"
        elif now - began > LONGEST_S:
            yield (
                f"it was not done within {LONGEST_S:g} s, of which it computed for {used_s:.0f} s: it waits, or the"
                " machine is too busy; correct the environment, or play it on an idle machine"
            )
        else:
            yield ""


def _kill(pids: list[int]) -> None:
    for pid in pids:
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)


def main() -> None:
    """The program. Reads a line of JSON, the definitions of environments that do not ship, from standard input."""
    end_with_parent(signal.SIGKILL)
    registry.define(msgspec.json.decode(sys.stdin.buffer.readline() or b"[]", type=list[Entry]))
    for played in play_all(sys.argv[2:], int(sys.argv[1])):
        sys.stdout.buffer.write(msgspec.json.encode(played) + b"\n")
        sys.stdout.buffer.flush()


def rollout(
    environment: Environment, seed: int, steps: int, *, drawn: bool = False
) -> Iterator[tuple[Any, Step]]:
    """Plays at most `steps` steps with random actions drawn from `seed` (`Environment.draw`). Yields each action with
    its step; the first item is None with the first observation. `drawn`: draws each state before the action."""
    rng = np.random.default_rng(seed)
    step = Step(environment.reset(Case(seed=seed)), 0.0, False, False, {})
    yield None, step
    for _ in range(steps):
        if drawn:
            environment.render()
        action = environment.draw(rng, step.obs)
        step = environment.step(action)
        yield action, step
        if step.terminated or step.truncated:
            return


def digest(environment: Environment, seed: int, steps: int, *, drawn: bool = False) -> str:
    """Plays an episode, and returns the digest of all its observations, rewards, end flags, and infos."""
    return digest_of(rollout(environment, seed, steps, drawn=drawn))


def digest_of(episode: Iterator[tuple[Any, Step]]) -> str:
    state = hashlib.sha256()
    for n, (_, step) in enumerate(episode):
        add(state, tuple(step) if n else step.obs)
    return state.hexdigest()[:16]


def add(state: Any, value: Any) -> None:
    """Adds a value to a hash, so that any difference shows, including types and signs of zero."""
    if isinstance(value, np.ndarray):
        state.update(f"{value.dtype.str}{value.shape}".encode())
        state.update(value.tobytes())
    elif isinstance(value, dict):
        for key, item in value.items():
            state.update(str(key).encode())
            add(state, item)
    elif isinstance(value, list | tuple):
        state.update(f"{len(value)}".encode())
        for item in value:
            add(state, item)
    else:
        exact = value.hex() if isinstance(value, float) else value
        state.update(f"{type(value).__name__}:{exact!r}".encode())


if __name__ == "__main__":
    main()
