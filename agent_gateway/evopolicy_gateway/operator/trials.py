"""Plays cases outside any run: `evopolicy try`."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import uuid
from collections.abc import Sequence
from pathlib import Path

import msgspec
from rich.progress import Progress

from evopolicy_common import catalogue
from evopolicy_common.console import Terminal, table, terminal
from evopolicy_common.errors import BundleError, ConfigError, raised_as
from evopolicy_common.local.cluster import unless_failed
from evopolicy_common.messages.episode import EpisodeOutcome, ResourceLimits, Tier
from evopolicy_common.messages.operator import Evaluate
from evopolicy_common.processes.notices import Waiting
from evopolicy_common.processes.preflight import check_writable
from evopolicy_common.records.aggregates import mean, std
from evopolicy_common.records.episodes import rendered
from evopolicy_common.records.policies.bundles import Bundle
from evopolicy_common.records.policies.checkpoints import bundle_of
from evopolicy_common.terminal import one_line, say, say_json
from evopolicy_gateway.operator.cluster import ChosenCluster, connected
from evopolicy_gateway.run.operations import Operations
from evopolicy_gateway.submits.formatting import cut_text, failure_text


def evaluation(
    env: str, bundle: Bundle, cases: Sequence[int], tier: Tier, limits: ResourceLimits
) -> Evaluate:
    """The request for train cases outside any run."""
    return Evaluate(
        key=uuid.uuid4().hex,
        env=env,
        bundle=bundle.digest,
        split="train",
        cases=tuple(cases),
        sandbox_tier=tier,
        limits=limits,
        step_limit="published",
        definition=catalogue.pinned(env),
    )


class TriedEpisode(msgspec.Struct, frozen=True, kw_only=True):
    case: int
    episode_return: float | None
    """None when nothing was played, because the first case showed that the code yields no Policy."""
    length: int
    failure: str | None = None
    """Category, step and message of the policy's failure; uniform random actions played from that step on."""
    failed_at: int | None = None
    """Step of the failure; None without a failure, or before the first step."""
    folder: str

    @property
    def played_by(self) -> str:
        if self.episode_return is None:
            return "not played"
        if self.failure is None:
            return "policy"
        return f"policy to step {self.failed_at}, then random" if self.failed_at else "random"


class TrialResult(msgspec.Struct, frozen=True, kw_only=True):
    env: str
    mean_return: float | None
    """Mean over the cases in which the policy did not fail; None when there are none."""
    std_return: float | None
    """Population standard deviation over the same cases."""
    n_failed: int
    """Cases in which the policy failed; their returns, mostly of random actions, are excluded from the mean."""
    episodes: tuple[TriedEpisode, ...]
    folder: str
    other_cases_next_time: bool = False
    """The cases derive from the secret of a temporary cluster: another call has other cases under the same ids."""


async def try_policy(
    bundle: Bundle, message: Evaluate, out: Path, where: ChosenCluster, *, as_json: bool
) -> int:
    """Plays the policy on train cases and prints the results; returns 1 if it failed in an episode, else 0.
    `message`: of `evaluation`; `out`: folder for trajectories."""
    check_writable(out, "--out")
    console = terminal(stderr=as_json)
    notes: set[str] = set()

    async def work(operations: Operations) -> TrialResult:
        await operations.upload(bundle.digest, bundle.packed)
        result = await _result(message, where, operations, console, out)
        if not catalogue.is_shipped(message.env):
            offered = (each.description for each in (await operations.environments())[0])
            notes.update(each.notes() for each in offered if each.env == message.env)
        return result

    async with connected(where, [message.env], {message.sandbox_tier}) as (operations, _, failed):
        result = await unless_failed(asyncio.create_task(work(operations)), failed)
    _print(result, as_json, console)
    for note in filter(None, notes):
        say(f"note: {note}", err=True)
    return int(any(episode.failure for episode in result.episodes))


async def _outcomes(operations: Operations, message: Evaluate, console: Terminal) -> list[EpisodeOutcome]:
    outcomes: list[EpisodeOutcome] = []
    with Progress(console=console, transient=True, disable=not console.is_terminal) as progress:
        task = progress.add_task(message.env, total=None)
        waiting = Waiting()
        async for outcome, total, waits_for in operations.evaluate(message):
            if outcome is not None:
                outcomes.append(outcome)
                waiting.ended()
            elif waiting.worth_saying(waits_for):
                console.print(f"{message.env}: waiting for {waits_for}", soft_wrap=True)
            progress.update(task, completed=len(outcomes), total=total)
    return sorted(outcomes, key=lambda outcome: outcome.index)


async def _result(
    message: Evaluate, where: ChosenCluster, operations: Operations, console: Terminal, out: Path
) -> TrialResult:
    """Plays the cases, and writes their files into a new folder in `out`."""
    outcomes = await _outcomes(operations, message, console)
    folder = await asyncio.to_thread(_new_folder, out, message.env)
    episodes = []
    for outcome, case in zip(outcomes, message.cases or (), strict=True):
        target, ref = folder / f"ep_{outcome.index:03d}", outcome.trajectory
        packed = None if ref is None else await operations.fetch(ref)
        await asyncio.to_thread(_write, target, packed, outcome)
        tried = TriedEpisode(
            case=case,
            episode_return=outcome.episode_return if outcome.length else None,
            length=outcome.length,
            failure=failure_text(outcome.failure),
            failed_at=None if outcome.failure is None else outcome.failure.step_index,
            folder=str(target),
        )
        episodes.append(tried)
    good = [one for one in episodes if one.failure is None]
    returns = [one.episode_return for one in good if one.episode_return is not None]
    local = where.local
    return TrialResult(
        env=message.env,
        mean_return=mean(returns) if returns else None,
        std_return=std(returns) if returns else None,
        n_failed=len(episodes) - len(good),
        episodes=tuple(episodes),
        folder=str(folder),
        other_cases_next_time=local is not None and local.state is None and local.data is None,
    )


def _write(target: Path, packed: bytes | None, outcome: EpisodeOutcome) -> None:
    target.mkdir()
    files = {} if packed is None else rendered.files_of(rendered.decode(packed), None)
    files["stdout.txt"] = cut_text(outcome.stdout)
    files["stderr.txt"] = cut_text(outcome.stderr)
    if outcome.failure is not None:
        files["error.txt"] = outcome.failure.traceback.encode() or outcome.failure.message.encode()
    for name, data in files.items():
        (target / name).write_bytes(data)


def policy_bundle(policy: Path) -> Bundle:
    """Bundles the policy in a folder, or in `system/` below it. Raises ConfigError when it is missing or invalid."""
    folder = policy if (policy / "policy.py").is_file() else policy / "system"
    if not (folder / "policy.py").is_file():
        problem = f"{policy} is a file" if policy.exists() else f"there is no folder {policy}"
        if policy.is_dir():
            problem = f"{policy} holds no policy.py"
        raise ConfigError(f"{problem}; name a folder with policy.py in it, or in its folder system/")
    with raised_as(ConfigError, folder, BundleError):
        return bundle_of(folder)


def _new_folder(out: Path, env: str) -> Path:
    for number in itertools.count():
        folder = out.absolute() / catalogue.folder_name(env) / f"try_{number:03d}"
        with contextlib.suppress(FileExistsError):
            folder.mkdir(parents=True)
            break
    return folder


def _print(result: TrialResult, as_json: bool, console: Terminal) -> None:
    if as_json:
        say_json([result])
        return
    numbers = ("case", "return", "steps")
    made = table(*numbers, "played by", "failure", right=numbers)
    for one in result.episodes:
        shown = "–" if one.episode_return is None else f"{one.episode_return:.4g}"
        made.add_row(str(one.case), shown, str(one.length), one.played_by, one_line(one.failure or ""))
    console.print(made)
    console.print(_summary(result), soft_wrap=True)
    console.print(f"trajectories and errors: {result.folder}", soft_wrap=True)
    if result.other_cases_next_time:
        console.print(
            "note: this cluster's cases end with it, the next call has others under the same ids;"
            " leave out --fresh, or give --data DIR or --connect, to keep them the same",
            soft_wrap=True,
        )


def _summary(result: TrialResult) -> str:
    n, failed = len(result.episodes), result.n_failed
    if result.mean_return is None:
        return f"{result.env}: no mean return, the policy failed in {'all ' * (n > 1)}{_cases(n)}"
    over = f"{n - failed} of {_cases(n)}" if failed else _cases(n)
    left_out = f"; {_cases(failed)} left out, in which the policy failed" if failed else ""
    return (
        f"{result.env}: mean return {result.mean_return:.4g}, population standard deviation {result.std_return:.4g},"
        f" over {over}{left_out}"
    )


def _cases(n: int) -> str:
    return f"{n} case{'s' * (n != 1)}"
