"""What the conformance tests of environments share: playing an episode to a digest, reading spaces and task tables.

Also a program, so that an episode can be played in another process: `python environment_checks.py play` or `render`
prints one JSON object, id to digests, of all ids given or of Core16 and the toys.
"""

from __future__ import annotations

import hashlib
import itertools
import json
import re
import sys
from collections.abc import Iterator
from typing import Any

import numpy as np

from evopolicy_common.catalogue import suites
from evopolicy_common.messages.environment import SpaceSchema
from evopolicy_worker.environments import Environment, make
from evopolicy_worker.environments.checks.episodes import add, rollout

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


def leaves(schema: SpaceSchema, path: str = "") -> Iterator[tuple[str, SpaceSchema]]:
    """Path and schema of every leaf space; the path of a space that is no Dict is empty."""
    if schema["type"] == "Dict":
        for key, part in schema["spaces"].items():
            yield from leaves(part, f"{path}.{key}" if path else key)
    elif schema["type"] == "Tuple":
        for index, part in enumerate(schema["spaces"]):
            yield from leaves(part, f"{path}.{index}" if path else f"{index}")
    else:
        yield path, schema


def components(schema: SpaceSchema) -> set[tuple[str, tuple[int, ...]]]:
    """Every flat component of an observation or action: path of its leaf and index in it."""
    found: set[tuple[str, tuple[int, ...]]] = set()
    for path, leaf in leaves(schema):
        shape: tuple[int, ...] = ()
        if leaf["type"] in ("Box", "Image"):
            shape = tuple(leaf["shape"])
        elif leaf["type"] == "MultiDiscrete":
            shape = np.shape(leaf["nvec"])
        elif leaf["type"] == "MultiBinary":
            shape = tuple(np.atleast_1d(leaf["n"]).tolist())
        # The parts of a tuple are told by a first index, and a lone number is component 0.
        name, first = ("", (int(path),)) if path.isdigit() else (path, ())
        shape = shape or ((1,) if not path else ())
        found.update((name, (*first, *index)) for index in itertools.product(*map(range, shape)))
    return found


_SELECTOR = re.compile(r"^(?:(?P<path>[A-Za-z_][\w. ]*)(?:\[(?P<inner>[^\]]*)\])?|(?P<bare>[\d–, ]+))$")


def selected(selector: str) -> Iterator[tuple[str, tuple[int, ...]]]:
    """Components that the first cell of a row names: `3`, `0–4`, `0–83, 0–2`, `image[0–6, 0]`, `direction`."""
    match = _SELECTOR.match(selector)
    assert match, f"cannot read the component {selector!r}"
    spans = match["bare"] or match["inner"] or ""
    ranges = []
    for span in filter(None, (part.strip() for part in spans.split(","))):
        first, _, last = span.partition("–")
        ranges.append(range(int(first), int(last or first) + 1))
    for index in itertools.product(*ranges):
        yield match["path"] or "", index


def table(text: str, heading: str) -> list[list[str]]:
    """Cells of the first table under `## heading`, without its head."""
    match = re.search(rf"^## {heading}\n(.*?)(?=^## |\Z)", text, re.MULTILINE | re.DOTALL)
    assert match, f"no section {heading!r}"
    lines = [line for line in match[1].splitlines() if line.startswith("|")]
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
    widths = {len(row) for row in rows}
    assert len(widths) == 1, f"rows of different widths under {heading!r}: {widths}"
    return rows[2:]


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
