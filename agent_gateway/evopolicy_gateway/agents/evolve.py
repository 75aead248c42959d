"""`evolve`: the cross-entropy method over a linear policy, an agent without a language model.

Draw a population from a normal distribution with a diagonal covariance, keep the elite by return, fit the distribution
to the elite, and add a decreasing deviation: Rubinstein and Kroese (2004), *The Cross-Entropy Method*, with the noise
of Szita and Lőrincz (2006), *Learning Tetris Using the Noisy Cross-Entropy Method*. The policy is `outputs = weights @
[features, 1]`. A feature is a number of the observation, one component of a discrete value's one-hot vector, or the
mean of a cell of a picture, normalised by mean and standard deviation of the visible observations, as in augmented
random search (Mania, Guy and Recht, 2018, version V2).

One submit plays a population, a candidate an episode, since the policy gets the episode's index. A second submit plays
the distribution's mean: the checkpoint of that iteration.

All random numbers follow from the run's identity (entry, environment, experiment id), so that repeats differ. An agent
that is started again computes the finished submits anew from their feedback, and continues as if it had not stopped.

It uses only what every agent may use. Run as `python -m evopolicy_gateway.agents.evolve` in the workspace, with the
`EVOPOLICYGYM_*` URLs set.
"""

from __future__ import annotations

import hashlib
import inspect
import json
import math
import sys
import uuid
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evopolicy_gateway.agents.client import Client, GatewayError, RefusedSubmit, exit_after

Schema = dict[str, Any]
Vector = NDArray[np.float64]

ELITE_SHARE = 0.25
FIRST_DEVIATION = 0.3
ADDED_DEVIATION = 0.1
"""Added to the elite's standard deviation in the first iteration; it decreases linearly to 0."""
PARAMETERS = "parameters.json"
MAX_OBSERVATIONS = 200
"""Observations of an episode that count for the normalisation, spread evenly."""
CLOSED = ("run_closed", "cancelled")


# ---- the policy: the source of these functions and this class is `system/policy.py` ----


def features(space: Schema) -> tuple[int, Callable[[Any], Any]]:
    """The number of features of an observation space, and the function from an observation to a float64 vector of
    that size. Texts give none. ValueError for a type that it cannot read."""
    kind = space["type"]
    if kind in ("Box", "Image"):
        shape = tuple(space["shape"])
        size = math.prod(shape)
        if size <= 512 or len(shape) < 2:
            return size, lambda obs: np.asarray(obs, dtype=float).reshape(-1)
        # A picture: the means of 4 × 4 cells, a channel each.
        channels = math.prod(shape[2:])

        def cells(obs: Any) -> Any:
            picture = np.asarray(obs, dtype=float).reshape(*shape[:2], channels)
            rows = np.array_split(picture, min(4, shape[0]))
            means = [part.mean((0, 1)) for row in rows for part in np.array_split(row, min(4, shape[1]), 1)]
            return np.concatenate(means)

        return min(4, shape[0]) * min(4, shape[1]) * channels, cells
    if kind == "Discrete":
        start, table = space.get("start", 0), np.eye(space["n"])
        return space["n"], lambda obs: table[int(obs) - start]
    if kind in ("MultiBinary", "MultiDiscrete"):
        size = int(np.prod(space["n"])) if kind == "MultiBinary" else int(np.size(space["nvec"]))
        return size, lambda obs: np.asarray(obs, dtype=float).reshape(-1)
    if kind in ("Dict", "Tuple"):
        named = space["spaces"].items() if kind == "Dict" else enumerate(space["spaces"])
        parts = [(name, *features(part)) for name, part in named]
        used = [(name, read) for name, size, read in parts if size]
        none = [np.zeros(0)]
        return (
            sum(size for _, size, _ in parts),
            lambda obs: np.concatenate([read(obs[name]) for name, read in used] or none),
        )
    if kind in ("Text", "MissionSpace"):
        return 0, lambda obs: np.zeros(0)
    raise ValueError("evolve cannot read observations of a space of type " + kind)


def actions(space: Schema) -> tuple[int, Callable[[Any], Any]]:
    """The number of outputs for an action space, and the function from outputs to an action. For numbers, ±1 are the
    bounds, or ±1 itself where there are none; of choices the largest output wins. ValueError for other types."""
    kind = space["type"]
    if kind == "Box":
        shape, dtype = space["shape"], np.dtype(space["dtype"])
        size = math.prod(shape)
        # Spaces of many numbers name their least and greatest bound alone.
        ends = (space.get("low", space.get("min")), space.get("high", space.get("max")))
        low, high = (np.broadcast_to(np.asarray(end, dtype=float).reshape(-1), size) for end in ends)
        low, high = np.where(np.isfinite(low), low, -1.0), np.where(np.isfinite(high), high, 1.0)

        def scaled(outputs: Any) -> Any:
            values = (low + high) / 2 + (high - low) / 2 * np.clip(outputs, -1.0, 1.0)
            return (np.rint(values) if dtype.kind in "iu" else values).astype(dtype).reshape(shape)

        return size, scaled
    if kind == "Discrete":
        start = space.get("start", 0)
        return space["n"], lambda outputs: int(np.argmax(outputs)) + start
    if kind == "MultiDiscrete":
        shape = np.shape(space["nvec"])
        cuts = np.cumsum(np.ravel(space["nvec"]))
        first = np.asarray(space.get("start", 0))

        def choices(outputs: Any) -> Any:
            best = [int(np.argmax(part)) for part in np.split(outputs, cuts[:-1])]
            return np.reshape(best, shape) + first

        return int(cuts[-1]), choices
    if kind == "MultiBinary":
        shape = tuple(np.atleast_1d(space["n"]))
        return math.prod(shape), lambda outputs: (outputs > 0).astype(np.int8).reshape(shape)
    if kind in ("Dict", "Tuple"):
        named = list(space["spaces"].items() if kind == "Dict" else enumerate(space["spaces"]))
        parts = [(name, *actions(part)) for name, part in named]
        cuts = np.cumsum([size for _, size, _ in parts])

        def joined(outputs: Any) -> Any:
            made = [
                (name, act(part))
                for (name, _, act), part in zip(parts, np.split(outputs, cuts[:-1]), strict=True)
            ]
            return dict(made) if kind == "Dict" else tuple(action for _, action in made)

        return int(cuts[-1]), joined
    raise ValueError("evolve cannot choose actions of a space of type " + kind)


class Policy:
    """Plays candidate k in episode k of the submit; `parameters.json` has all candidates."""

    def __init__(self, obs_space: Schema, action_space: Schema, env_meta: Schema) -> None:
        n_features, self.read = features(obs_space)
        n_outputs, self.action = actions(action_space)
        given = json.loads(Path(__file__).with_name("parameters.json").read_text(encoding="utf-8"))
        self.mean, self.deviation = np.array(given["mean"]), np.array(given["deviation"])
        self.candidates = np.array(given["candidates"]).reshape(-1, n_outputs, n_features + 1)

    def reset(self, episode_index: int) -> None:
        self.weights = self.candidates[episode_index % len(self.candidates)]

    def act(self, obs: Any) -> Any:
        normal = np.clip((self.read(obs) - self.mean) / self.deviation, -10.0, 10.0)
        return self.action(self.weights[:, :-1] @ normal + self.weights[:, -1])


HEADER = '''"""A linear policy whose weights the cross-entropy method has chosen."""

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

Schema = dict
'''


# ---- the agent ----


class Distribution:
    """The normal distribution over weights, float64 of `size`, and its random stream."""

    def __init__(self, size: int, rng: np.random.Generator) -> None:
        self.mean, self.deviation, self._rng = np.zeros(size), np.full(size, FIRST_DEVIATION), rng

    def draw(self, n: int) -> Vector:
        """A population, shape (n, size)."""
        return self.mean + self.deviation * self._rng.standard_normal((n, self.mean.size))

    def fit(self, population: Vector, returns: Vector, added: float) -> None:
        """Fits it to the elite; `added` is the additional standard deviation. Equal returns tell nothing."""
        if np.ptp(returns) > 0:
            n_elite = max(2, round(ELITE_SHARE * len(population)))
            elite = population[np.argsort(-returns, kind="stable")[:n_elite]]
            self.mean, self.deviation = elite.mean(axis=0), elite.std(axis=0) + added


class Normaliser:
    """Mean and standard deviation of features, from the observations in feedback."""

    def __init__(self, size: int) -> None:
        self._n, self._sum, self._squares = 0, np.zeros(size), np.zeros(size)

    def add(self, rows: Iterable[Vector]) -> None:
        for row in rows:
            if np.isfinite(row).all():
                self._n, self._sum, self._squares = self._n + 1, self._sum + row, self._squares + row**2

    @property
    def moments(self) -> tuple[Vector, Vector]:
        """Mean, and standard deviation; 0 and 1 without observations, 1 for what does not vary."""
        mean = self._sum / max(self._n, 1)
        deviation = np.sqrt(np.maximum(self._squares / max(self._n, 1) - mean**2, 0.0))
        return mean, np.where(deviation < 1e-6, 1.0, deviation)


def observations(episode: Path) -> Iterator[Any]:
    """Observations of an episode's folder, at most about `MAX_OBSERVATIONS`, spread evenly."""
    for path in episode.glob("observations.np[yz]"):
        loaded = np.load(path)
        named = {"observations": loaded} if path.suffix == ".npy" else dict(loaded)
        n = len(next(iter(named.values())))
        for t in range(0, n, n // MAX_OBSERVATIONS + 1):
            yield named["observations"][t] if "observations" in named else {k: v[t] for k, v in named.items()}
        return
    path = episode / "trajectory.jsonl"
    if path.is_file():
        lines = path.read_text(encoding="utf-8").splitlines()
        for line in lines[:: len(lines) // MAX_OBSERVATIONS + 1]:
            yield json.loads(line)["obs"]


class EvolveAgent:
    """One run of the agent in one workspace. ValueError for spaces that it cannot read or choose from."""

    def __init__(self, client: Client, workspace: Path, identity: str) -> None:
        self._client, self._workspace, self._identity = client, workspace, identity
        info = client.info()
        meta = info["env_meta"]
        n_features, self._read = features(meta["obs_space"])
        n_outputs, _ = actions(meta["action_space"])
        if not n_features:
            raise ValueError(
                "evolve finds no number in observations of a space of type " + meta["obs_space"]["type"]
            )
        self._n_cases, self._budget = int(meta["n_env_instances"]), int(info["episode_budget"])
        self._least, self._most = (int(info[f"{end}_episodes_per_submit"]) for end in ("min", "max"))
        seed = int.from_bytes(hashlib.sha256(identity.encode()).digest()[:8], "big")
        self._weights = Distribution(n_outputs * (n_features + 1), np.random.default_rng(seed))
        self._normaliser = Normaliser(n_features)
        self._normal = self._normaliser.moments
        self._feedback = workspace / "feedback"
        self._n_submits, self._is_over = 0, False

    def run(self) -> bool:
        """Spends the budget and returns whether a submit was accepted. GatewayError when the gateway stays
        unreachable, or refuses a submit."""
        check = max(self._least, 1)
        size = max(self._least, min(self._most, max(2, min(16, self._budget // 6))))
        n_iterations = self._budget // (size + check)
        for iteration in range(n_iterations):
            self._normal = self._normaliser.moments
            # One case for all, so that luck with the case does not choose the elite.
            case = iteration % self._n_cases
            population = self._weights.draw(size)
            returns = self._play(population, [case] * size)
            if returns is not None:
                self._weights.fit(population, returns, ADDED_DEVIATION * (1 - iteration / n_iterations))
            self._play(self._weights.mean[None], [case] * check)
        while self._budget >= check and not self._is_over:
            n = min(self._budget, self._most)
            self._play(self._weights.mean[None], [case % self._n_cases for case in range(n)])
        return self._n_submits > 0

    def _play(self, candidates: Vector, cases: list[int]) -> Vector | None:
        """Submits candidates, and returns an episode's return each; None for a submit that is not ok."""
        if self._is_over:
            return None
        index, self._n_submits = self._n_submits, self._n_submits + 1
        self._budget -= len(cases)
        folders = [each for each in self._feedback.glob("submit_*[0-9]") if int(each.name[7:]) == index]
        if not folders:
            self._stage(candidates)
            # The same key after a restart: a submit that is being played is not sent twice.
            key = uuid.uuid5(uuid.NAMESPACE_URL, f"{self._identity} {index}").hex
            answer = self._client.submit(cases, key)
            if isinstance(answer, RefusedSubmit):
                self._n_submits, self._is_over = index, True
                if answer.status not in CLOSED:
                    raise GatewayError(f"refused, {answer.status}: {answer.message}")
                return None
            folders = [self._feedback / answer.name]
        summary = json.loads((folders[0] / "summary.json").read_text(encoding="utf-8"))
        print(f"{folders[0].name}: {summary['status']}, mean return {summary['mean_return']}", flush=True)
        for episode in sorted((folders[0] / "episodes").glob("ep_*")):
            self._normaliser.add(self._read(obs) for obs in observations(episode))
        return None if summary["returns"] is None else np.array(summary["returns"], dtype=float)

    def _stage(self, candidates: Vector) -> None:
        mean, deviation = (values.tolist() for values in self._normal)
        given = {"mean": mean, "deviation": deviation, "candidates": candidates.tolist()}
        system = self._workspace / "system"
        source = [HEADER, *(inspect.getsource(part) for part in (features, actions, Policy))]
        (system / "policy.py").write_text("\n\n".join(source), encoding="utf-8")
        (system / "parameters.json").write_text(json.dumps(given), encoding="utf-8")


def main() -> None:
    """Runs the agent in the current directory, the workspace of `runs/ENTRY/ENVIRONMENT/EXPERIMENT`."""
    workspace = Path.cwd()
    identity = "/".join(workspace.parts[-4:-1])
    try:
        exit_after("evolve", lambda client: EvolveAgent(client, workspace, identity).run())
    except ValueError as error:
        print(f"evolve: {error}; --agent random plays it", file=sys.stderr)
        raise SystemExit(1) from None


if __name__ == "__main__":
    main()
