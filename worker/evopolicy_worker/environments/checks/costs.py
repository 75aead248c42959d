"""The processor time of a bare step, for the table of `evopolicy-worker check-env`.

As a program, `python -m evopolicy_worker.environments.checks.costs` reads a line of JSON with the definitions of
environments that do not ship, then an environment id a line, and answers each with a line of JSON, a `Stretch`. The
same id again plays the same stretch again, so that a slot can play it in turns.
"""

from __future__ import annotations

import os
import signal
import sys
import time
from typing import Any

import msgspec
import numpy as np

from evopolicy_common.catalogue import Entry
from evopolicy_common.messages.environment import Case
from evopolicy_common.processes import proc
from evopolicy_common.processes.parent_death import end_with_parent
from evopolicy_worker.environments import registry
from evopolicy_worker.environments.interface import settings
from evopolicy_worker.environments.interface.actions import copied
from evopolicy_worker.environments.interface.gymnasium_adapter import GymnasiumEnvironment

CASE = Case(seed=20_011_117)
STEPS, PICTURES = 1000, 100
"""Most steps of a stretch; with observations that have files of their own, whose recording has to fit a message."""
PROCESSOR_S, WALL_S = 0.5, 5.0
"""A stretch ends sooner after so much time of this process, or so much time in all, which counts for web pages."""


class Stretch(msgspec.Struct, frozen=True):
    """The begin of one episode with random actions."""

    cpu_s: float = 0.0
    """Processor time of its steps, in this process and all that it started, seconds."""
    actions: list[Any] = []
    """One a step, as literals."""
    fault: str = ""


def _stretch(environment: GymnasiumEnvironment) -> list[Any]:
    """The actions of a stretch."""
    rng = np.random.default_rng(0)
    obs = environment.reset(CASE)
    actions: list[Any] = []
    processor, wall = time.process_time() + PROCESSOR_S, time.monotonic() + WALL_S
    about = environment.description
    most = min(STEPS if about.obs_storage == "inline" else PICTURES, about.max_episode_steps)
    while len(actions) < most and time.process_time() < processor and time.monotonic() < wall:
        actions.append(environment.draw(rng, obs))
        step = environment.step(actions[-1])
        obs = step.obs
        if step.terminated or step.truncated:
            break
    return actions


def _play(environment: GymnasiumEnvironment, actions: list[Any]) -> Stretch:
    environment.reset(CASE)
    step, sent = environment.bare.step, list(map(copied, actions))
    below, began = proc.cpu_below_s(os.getpid()), time.process_time()
    for action in sent:
        step(action)
    own = time.process_time() - began
    return Stretch(own + proc.cpu_below_s(os.getpid()) - below, [literal(each) for each in actions])


def literal(value: Any) -> Any:
    """An action as a Python literal."""
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, dict):
        return {key: literal(part) for key, part in value.items()}
    if isinstance(value, tuple):
        return tuple(map(literal, value))
    return value


def main() -> None:
    """The program."""
    end_with_parent(signal.SIGKILL)
    registry.define(msgspec.json.decode(sys.stdin.buffer.readline(), type=list[Entry]))
    settings.apply()
    # Simulators print; the answers keep standard output for themselves.
    answers = os.fdopen(os.dup(1), "wb")
    null = os.open(os.devnull, os.O_WRONLY)
    os.dup2(null, 1)
    os.dup2(null, 2)
    environment: Any = None
    actions: list[Any] = []
    for line in sys.stdin.buffer:
        env_id = line.decode().strip()
        try:
            if environment is None or env_id != environment.description.env:
                if environment is not None:
                    environment.close()
                environment = registry.make(env_id)
                if not isinstance(environment, GymnasiumEnvironment):
                    raise TypeError("it is not a Gymnasium environment, and has no bare loop")
                actions = _stretch(environment)
            answer = _play(environment, actions)
        except Exception as error:
            environment, answer = None, Stretch(fault=f"{type(error).__name__}: {error}"[:300])
        answers.write(msgspec.json.encode(answer) + b"\n")
        answers.flush()


if __name__ == "__main__":
    main()
