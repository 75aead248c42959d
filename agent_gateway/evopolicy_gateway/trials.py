"""Playing cases outside any run: `evopolicy try` and `evopolicy random`."""

from __future__ import annotations

import asyncio
import math
import uuid
from collections.abc import Sequence
from pathlib import Path

import msgspec
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from evopolicy_common import bundles
from evopolicy_common.errors import BundleError, ConfigError
from evopolicy_common.local_cluster import unless_failed
from evopolicy_common.messages.environment import Split
from evopolicy_common.messages.episode import EpisodeOutcome, ResourceLimits, Tier
from evopolicy_common.messages.operator import Evaluate
from evopolicy_gateway import options
from evopolicy_gateway.episode_files import trajectory_files
from evopolicy_gateway.formatting import cut_text
from evopolicy_gateway.operations import Operations
from evopolicy_gateway.runs import Cluster, connected


class Trial(msgspec.Struct, frozen=True, kw_only=True):
    """A policy to be tried."""

    env: str
    policy: Path
    split: Split
    cases: tuple[int, ...]
    out: Path
    tier: Tier
    limits: ResourceLimits


class TriedEpisode(msgspec.Struct, frozen=True, kw_only=True):
    """One episode of a trial."""

    case: int
    episode_return: float
    length: int
    failure: str | None = None
    """Category, step and message, when the policy failed."""
    folder: str | None = None


class TrialResult(msgspec.Struct, frozen=True, kw_only=True):
    """What a trial came to."""

    env: str
    mean_return: float
    std_return: float
    """Population standard deviation."""
    episodes: tuple[TriedEpisode, ...]
    folder: str | None = None


async def try_policy(trial: Trial, where: Cluster, *, as_json: bool) -> int:
    """Plays the policy and prints what came of it; 1 when it failed in an episode, else 0. ConfigError for no policy."""
    bundle = _bundle(trial.policy)
    console = options.console(stderr=as_json)
    results: list[TrialResult] = []

    async def work(operations: Operations) -> None:
        await operations.upload(bundle)
        message = Evaluate(
            token="",
            key=uuid.uuid4().hex,
            env=trial.env,
            bundle=bundle.digest,
            split=trial.split,
            cases=trial.cases,
            sandbox_tier=trial.tier,
            limits=trial.limits,
        )
        outcomes = await _outcomes(operations, message, console)
        folder = await asyncio.to_thread(_new_folder, trial.out, trial.env)
        episodes = [
            await _tried(outcome, case, folder, operations)
            for outcome, case in zip(outcomes, trial.cases, strict=True)
        ]
        results.append(_result(trial.env, episodes, folder))

    async with connected(where, [trial.env]) as (operations, _, failed):
        await unless_failed(asyncio.create_task(work(operations)), failed)
    _print(results, as_json, console)
    return int(any(episode.failure for episode in results[0].episodes))


async def play_random(
    env_ids: Sequence[str],
    split: str,
    cases: tuple[int, ...] | None,
    where: Cluster,
    *,
    as_json: bool,
) -> int:
    """Plays uniform random actions and prints the returns."""
    console = options.console(stderr=as_json)
    results: list[TrialResult] = []

    async def work(operations: Operations) -> None:
        for env_id in env_ids:
            message = Evaluate(
                token="",
                key=uuid.uuid4().hex,
                env=env_id,
                bundle=None,
                split=msgspec.convert(split, Split),
                cases=cases,
                record="actions",
            )
            outcomes = await _outcomes(operations, message, console)
            ids = range(len(outcomes)) if cases is None else cases
            episodes = [
                TriedEpisode(case=case, episode_return=outcome.episode_return, length=outcome.length)
                for outcome, case in zip(outcomes, ids, strict=True)
            ]
            results.append(_result(env_id, episodes, None))

    async with connected(where, env_ids) as (operations, _, failed):
        await unless_failed(asyncio.create_task(work(operations)), failed)
    if as_json or len(results) == 1:
        _print(results, as_json, console)
    else:
        _print_means(results, console)
    return 0


async def _outcomes(operations: Operations, message: Evaluate, console: Console) -> list[EpisodeOutcome]:
    """All outcomes in the order asked for."""
    outcomes: list[EpisodeOutcome] = []
    with Progress(console=console, transient=True, disable=not console.is_terminal) as progress:
        task = progress.add_task(message.env, total=None)
        async for outcome, total, _ in operations.evaluate(message):
            outcomes.append(outcome)
            progress.update(task, completed=len(outcomes), total=total)
    return sorted(outcomes, key=lambda outcome: outcome.index)


async def _tried(outcome: EpisodeOutcome, case: int, folder: Path, operations: Operations) -> TriedEpisode:
    target = folder / f"ep_{outcome.index:03d}"
    packed = None if outcome.trajectory is None else await operations.fetch(outcome.trajectory)
    await asyncio.to_thread(_write, target, packed, outcome)
    failure = None
    if outcome.failure is not None:
        at = "" if outcome.failure.step_index is None else f" at step {outcome.failure.step_index}"
        failure = f"{outcome.failure.category}{at}: {outcome.failure.message}"
    return TriedEpisode(
        case=case,
        episode_return=outcome.episode_return,
        length=outcome.length,
        failure=failure,
        folder=str(target),
    )


def _write(target: Path, packed: bytes | None, outcome: EpisodeOutcome) -> None:
    target.mkdir()
    files = {} if packed is None else trajectory_files(packed, None)
    files["stdout.txt"] = cut_text(outcome.stdout)
    files["stderr.txt"] = cut_text(outcome.stderr)
    if outcome.failure is not None:
        files["error.txt"] = outcome.failure.traceback.encode() or outcome.failure.message.encode()
    for name, data in files.items():
        (target / name).write_bytes(data)


def _bundle(policy: Path) -> bundles.Bundle:
    folder = policy if (policy / "policy.py").is_file() else policy / "system"
    if not (folder / "policy.py").is_file():
        raise ConfigError(f"{policy} holds no policy.py")
    try:
        return bundles.snapshot(folder)
    except BundleError as error:
        raise ConfigError(f"{folder}: {error}") from error


def _new_folder(out: Path, env: str) -> Path:
    base = out / env.replace("/", "_")
    base.mkdir(parents=True, exist_ok=True)
    number = 0
    while True:
        folder = base / f"try_{number:03d}"
        try:
            folder.mkdir()
            return folder.absolute()
        except FileExistsError:
            number += 1


def _result(env: str, episodes: Sequence[TriedEpisode], folder: Path | None) -> TrialResult:
    returns = [episode.episode_return for episode in episodes]
    mean = math.fsum(returns) / len(returns)
    std = math.sqrt(math.fsum((value - mean) * (value - mean) for value in returns) / len(returns))
    return TrialResult(
        env=env,
        mean_return=mean,
        std_return=std,
        episodes=tuple(episodes),
        folder=None if folder is None else str(folder),
    )


def _print(results: Sequence[TrialResult], as_json: bool, console: Console) -> None:
    if as_json:
        print(msgspec.json.format(msgspec.json.encode(results)).decode())
        return
    for result in results:
        table = Table(box=None, pad_edge=False)
        for title in ("case", "return", "steps", "failure"):
            table.add_column(title, justify="left" if title == "failure" else "right")
        for episode in result.episodes:
            table.add_row(
                str(episode.case), f"{episode.episode_return:.4g}", str(episode.length), episode.failure or ""
            )
        console.print(table)
        console.print(
            f"{result.env}: mean return {result.mean_return:.4g} ± {result.std_return:.4g}", highlight=False
        )
        if result.folder is not None:
            console.print(f"trajectories: {result.folder}", highlight=False, soft_wrap=True)


def _print_means(results: Sequence[TrialResult], console: Console) -> None:
    table = Table(box=None, pad_edge=False)
    for title in ("environment", "episodes", "mean return", "std"):
        table.add_column(title, justify="left" if title == "environment" else "right")
    for result in results:
        table.add_row(
            result.env, str(len(result.episodes)), f"{result.mean_return:.4g}", f"{result.std_return:.4g}"
        )
    console.print(table)
