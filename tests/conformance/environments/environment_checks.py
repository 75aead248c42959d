"""What the conformance tests of environments share: playing an episode to a digest, reading spaces and task tables.

Also a program, so that an episode can be played in another process: `python environment_checks.py play` or `render`
prints one JSON object, id to digests, of all ids given or of Core16 and the toys.
"""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
import sys
from typing import Any

from evopolicy_common.catalogue import suites
from evopolicy_worker.environments import Environment, make, process_environment
from evopolicy_worker.environments.checks.conformance import add, rollout

IDS = [*suites()["core16"].environments, *suites()["toy"].environments]
"""Those with a text and numbers of their own; `test_families.py` looks at the others."""
SEED = 20_011
STEPS = {"gym/racing": 25, "gymnasium/parking-v0": 30, "gymnasium/roundabout-v0": 11}
"""Steps played per episode where a step is slow; 80 elsewhere."""
FRAMES = 4


def play(
    environment: Environment, seed: int = SEED, *, steps: int | None = None, frames: bool = False
) -> list[str]:
    """Digests of the first observation and of each step of an episode under keyed uniform random actions.

    With `frames`, every step is also rendered, and FRAMES steps are played.
    """
    limit = steps or (FRAMES if frames else STEPS.get(environment.description.env, 80))
    episode = rollout(environment, seed, limit, drawn=frames)
    return [value_digest(tuple(step) if n else step.obs) for n, (_, step) in enumerate(episode)]


def value_digest(value: Any) -> str:
    """Digest of an observation, of a step, or of a simulator's state."""
    state = hashlib.sha256()
    add(state, value)
    return state.hexdigest()[:16]


def elsewhere(mode: str, *ids: str) -> dict[str, list[str]]:
    """The digests that this program prints, played in another process, as its environment is at its start."""
    result = subprocess.run(
        [sys.executable, __file__, mode, *ids],
        env={"PATH": os.environ["PATH"], **process_environment(render=mode == "render")},
        capture_output=True,
        text=True,
        timeout=170,
        check=False,
    )
    assert result.returncode == 0, result.stderr
    assert mode == "render" or result.stderr == ""
    played: dict[str, list[str]] = json.loads(result.stdout)
    return played


def main(mode: str, ids: list[str]) -> None:
    digests = {}
    # Reversed, and all of them alive together: what came before must not matter.
    environments = [make(env_id, render=mode == "render") for env_id in reversed(ids or IDS)]
    for environment in environments:
        digests[environment.description.env] = play(environment, frames=mode == "render")
        if mode == "render":
            frame = environment.render()
            shape = [*frame.shape, int(frame.min()), int(frame.max())]
            digests[environment.description.env + " frame"] = [json.dumps(shape)]
    for environment in environments:
        environment.close()
    print(json.dumps(digests))


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2:])
