"""Plays recorded actions of published results again, on a cluster of this machine's own.

Rules that this module owns:
- Nothing of the file is executed, and no limit of it is taken over: actions are data, the environments are the
  installed ones, and the worker's slots run them in its jail.
- The splits are those of the opening, which the commitment fixes. A run whose environment is not installed, or in other
  versions than the run tells, is not played: other versions give other numbers. Nor is one whose environment does not
  repeat episodes according to this machine; the file's own statement does not count.
"""

from __future__ import annotations

import contextlib
import random
import uuid
from collections.abc import AsyncIterator, Awaitable, Callable, Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from evopolicy_common import catalogue
from evopolicy_common.errors import BrokenEnvironmentError, EvopolicyError, ProtocolError
from evopolicy_common.local.cluster import local_cluster
from evopolicy_common.messages.operator import DescribeEnvironment, Evaluate
from evopolicy_common.processes.scratch import scratch_folder
from evopolicy_common.records.episodes import compare
from evopolicy_common.records.episodes.trajectory import Trajectory
from evopolicy_common.records.splits import FILE_STEMS, SPLITS, SplitFile, cases_hash
from evopolicy_common.wire import credentials, transport
from evopolicy_results.evaluations import Evaluations
from evopolicy_results.publish.contents import Group
from evopolicy_results.publish.findings import Checked, Files, PublishedRun
from evopolicy_results.publish.run_rules import recording_of

LAST_PLACES = 4
"""Units in the last place by which a reward may differ on a processor with other features."""

Tell = Callable[[int, int], None]
"""Receives the number of episodes played, and the total."""


class Chosen(msgspec.Struct, frozen=True):
    """Episodes of one group that are played."""

    run: PublishedRun
    group: Group
    indexes: tuple[int, ...]
    case_ids: tuple[int, ...]


PlayRun = Callable[[Evaluations, PublishedRun, Sequence[Chosen], bool], Awaitable[None]]
"""Plays the chosen episodes of one run, and adds findings. Last: whether this processor has other features than the
run's."""


async def replay(files: Files, checked: Checked, share: float, seed: int, slots: int, tell: Tell) -> None:
    """Plays a share of all recorded episodes, drawn by `seed`, and adds what came of it to `checked`."""
    chosen = draw(checked.runs, share, seed)
    if not chosen:
        checked.add("replay", "open", "there are no episodes to play")

    async def play_run(
        evaluations: Evaluations, run: PublishedRun, parts: Sequence[Chosen], other_cpu: bool
    ) -> None:
        await _play_run(evaluations, files, run, parts, other_cpu, checked, seed)

    await play_runs("replay", installed(chosen, checked, "replay"), checked, slots, tell, play_run)


async def play_runs(
    kind: str,
    by_run: dict[str, list[Chosen]],
    checked: Checked,
    slots: int,
    tell: Tell,
    play_run: PlayRun,
    packages_of: Callable[[PublishedRun], tuple[str, ...]] = lambda run: (),
) -> None:
    """Plays runs on as many clusters, one after another, as their cases and packages ask for. Adds to `checked` those
    that cannot be."""
    total = sum(len(each.indexes) for parts in by_run.values() for each in parts)
    by_packages: dict[tuple[str, ...], list[PublishedRun]] = {}
    for part, *_ in by_run.values():
        by_packages.setdefault(packages_of(part.run), []).append(part.run)
    played = 0

    def told(count: int, waits_for: str) -> None:
        tell(played + count, total)

    for packages, runs in by_packages.items():
        for layer in layers(runs):
            try:
                async with cluster_of(layer, slots, told, packages) as evaluations:
                    for run in layer:
                        why_not, other_cpu = await unplayable(evaluations, run)
                        if why_not:
                            checked.add(kind, "open", f"not played: {why_not}", run.opening.run)
                        else:
                            await play_run(evaluations, run, by_run[run.folder], other_cpu)
                    played += evaluations.played
            except EvopolicyError as error:
                checked.add(kind, "open", f"could not be played: {error}")


def installed(chosen: Sequence[Chosen], checked: Checked, kind: str) -> dict[str, list[Chosen]]:
    """The runs that can be replayed here, by the run's folder; the others are added to `checked` as open."""
    by_run: dict[str, list[Chosen]] = {}
    missing: dict[str, str] = {}
    for each in chosen:
        env = each.run.opening.settings.env
        # A name that is not of an installed environment could be that of a module to import.
        if catalogue.is_shipped(env) or env in catalogue.plugins():
            by_run.setdefault(each.run.folder, []).append(each)
        else:
            missing[each.run.opening.run] = env
    for name, env in missing.items():
        checked.add(kind, "open", f"{env} is not installed here", name)
    return by_run


def layers(runs: Sequence[PublishedRun]) -> list[list[PublishedRun]]:
    """The runs in groups in which no two have other cases of one environment: a cluster has one set of cases of
    each."""
    layers: list[tuple[dict[str, str], list[PublishedRun]]] = []
    for run in runs:
        env, cases = (
            run.opening.settings.env,
            cases_hash(case for split in SPLITS for case in run.cases(split)),
        )
        for known, members in layers:
            if known.setdefault(env, cases) == cases:
                members.append(run)
                break
        else:
            layers.append(({env: cases}, [run]))
    return [members for _, members in layers]


async def _play_run(
    evaluations: Evaluations,
    files: Files,
    run: PublishedRun,
    parts: Sequence[Chosen],
    other_cpu: bool,
    checked: Checked,
    seed: int,
) -> None:
    name = run.opening.run
    played, alike = 0, True
    for part in parts:
        n, faults = await _play(evaluations, files, part)
        checked.covered[part.group.part] = checked.covered.get(part.group.part, 0) + n
        played += n
        for fault, rounding in faults:
            alike = False
            if other_cpu and rounding:
                text = (
                    f"{fault}, {LAST_PLACES} units in the last place at most: this machine's processor has other"
                    " features than the run's"
                )
                checked.add("replay", "open", text, name)
            elif other_cpu:
                text = f"{fault}; other features of the processor do not explain this"
                checked.add("replay", "failed", text, name)
            else:
                checked.add("replay", "failed", fault, name)
    # A replay shows nothing of episodes without a recording, however many it drew.
    missing = checked.unrecorded(name)
    if alike:
        text = f"{played} episodes, bit for bit (drawn by seed {seed})"
        if missing:
            text += f"; only {', '.join(missing)} episodes have a recording"
        checked.add("replay", "open" if missing else "ok", text, name)


def draw(runs: Sequence[PublishedRun], share: float, seed: int) -> list[Chosen]:
    everything: list[tuple[int, int, int]] = []
    for k, run in enumerate(runs):
        for g, group in enumerate(run.groups):
            everything += [(k, g, i) for i in range(len(group.episodes))]
    n = len(everything) if share >= 1.0 else min(len(everything), max(1, round(share * len(everything))))
    by_group: dict[tuple[int, int], list[int]] = {}
    for k, g, i in random.Random(seed).sample(everything, n):
        by_group.setdefault((k, g), []).append(i)
    found = []
    for (k, g), indexes in sorted(by_group.items()):
        run, group = runs[k], runs[k].groups[g]
        ids = _case_ids(run, group)
        kept = tuple(index for index in sorted(indexes) if index < len(ids))
        if kept:
            found.append(Chosen(run, group, kept, tuple(ids[index] for index in kept)))
    return found


def _case_ids(run: PublishedRun, group: Group) -> tuple[int, ...]:
    """The ids, in its split, of the cases that a group's episodes play; none for what cannot be."""
    if group.split == "train":
        submit = next((each for each in run.result.submits if each.submit_index == group.submit_index), None)
        ids = () if submit is None else submit.env_instances
    else:
        ids = tuple(range(len(group.episodes)))
    n = len(run.cases(group.split))
    return ids if all(0 <= each < n for each in ids) else ()


@contextlib.asynccontextmanager
async def cluster_of(
    runs: Sequence[PublishedRun], slots: int, tell: Callable[[int, str], None], packages: Sequence[str]
) -> AsyncIterator[Evaluations]:
    """A cluster whose splits are those of the runs. `packages`: those that policies may import besides numpy."""
    with scratch_folder("check-data") as data:
        by_env = {run.opening.settings.env: run for run in runs}
        for env, run in by_env.items():
            folder = Path(data) / catalogue.folder_name(env)
            folder.mkdir()
            for split in SPLITS:
                content = SplitFile(env=env, split=FILE_STEMS[split], cases=run.cases(split), secret=False)
                (folder / f"{FILE_STEMS[split]}.json").write_bytes(msgspec.json.encode(content))
        async with local_cluster("check", data=Path(data), policy_packages=packages) as cluster:
            await cluster.start_workers(sorted(by_env), slots=slots, tiers={"bwrap"})
            async with transport.connect(credentials.find("operator", (), cluster.operator_file)) as link:
                yield Evaluations(link, tell, own=True)


async def unplayable(evaluations: Evaluations, run: PublishedRun) -> tuple[str, bool]:
    """Why episodes of the run cannot be compared on this machine: its environment does not repeat them, or in other
    versions. Empty where they can. And whether the processor's features differ from those in the run."""
    env, known = run.opening.settings.env, run.record.versions.fingerprint
    try:
        state = await evaluations.versions(DescribeEnvironment(token="", env=env), wait=True)
    except BrokenEnvironmentError as error:
        return str(error), False
    if not state.fingerprints:
        return f"no worker of this machine offers {env}; `evopolicy-worker check-env {env}` tells why", False
    offered, *_ = await evaluations.ask.environments()
    if any(each.description.env == env and not each.description.deterministic for each in offered):
        return f"{env} is marked as not deterministic: the same actions can give another episode", False
    here: dict[str, str] = {}
    for fingerprint in state.fingerprints:
        here |= fingerprint.flat()
    names = sorted(known.keys() & here.keys() - {"cpu", "evopolicy-worker"})
    differ = [
        f"{name} {here[name]} here, {known[name]} in the run" for name in names if here[name] != known[name]
    ]
    return "; ".join(differ[:4]), here.get("cpu") != known.get("cpu")


async def _play(evaluations: Evaluations, files: Files, part: Chosen) -> tuple[int, list[tuple[str, bool]]]:
    """How many of these episodes were played, and what differed, each with whether it may be a matter of rounding."""
    run, group = part.run, part.group
    try:
        recordings = run.recordings(files, group.name)
    except ProtocolError:
        return 0, []  # reported by the check of recordings
    stored: list[tuple[int, bytes]] = []
    case_ids, refs = [], []
    for index, case_id in zip(part.indexes, part.case_ids, strict=True):
        data = recordings[index] if index < len(recordings) else None
        if data is None:
            continue
        try:
            actions = compare.action_log(recording_of(data).actions)
        except ProtocolError:
            continue
        refs.append(await evaluations.uploaded(actions))
        stored.append((index, data))
        case_ids.append(case_id)
    if not refs:
        return 0, []
    message = Evaluate(
        token="",
        key=uuid.uuid4().hex,
        env=run.opening.settings.env,
        bundle=None,
        split=group.split,
        cases=tuple(case_ids),
        record="actions",
        replays=tuple(refs),
        step_limit=run.opening.settings.step_limit,
    )
    faults: list[tuple[str, bool]] = []
    seen: set[int] = set()
    async for outcome in evaluations.outcomes(message):
        if outcome.trajectory is None:
            continue
        index, data = stored[outcome.index]
        seen.add(index)
        episode = group.episodes[index]
        recorded, again = recording_of(data), await evaluations.recording(outcome)
        fault = compare.first_difference(recorded, again)
        if fault is None and not compare.same(episode.episode_return, outcome.episode_return):
            fault = f"return {episode.episode_return!r} is told, {outcome.episode_return!r} came"
        if fault is not None:
            faults.append((f"{group.name}, episode {index}: {fault}", rounded(recorded, again)))
    missing = [index for index, _ in stored if index not in seen]
    faults += [(f"{group.name}, episode {index}: not played to its end", False) for index in missing]
    return len(stored), faults


def rounded(recorded: Trajectory, again: Trajectory) -> bool:
    """Whether two episodes of the same actions first differ in a reward, by `LAST_PLACES` units in the last place at
    most, and in nothing else at that step. Later steps are not compared: an environment can enlarge such a
    difference."""
    for t in range(min(recorded.n, again.n)):
        ours, theirs = float(recorded.rewards[t]), float(again.rewards[t])
        if (recorded.terminated[t], recorded.truncated[t]) != (again.terminated[t], again.truncated[t]):
            return False
        if not compare.same(ours, theirs):
            pair = np.array([ours, theirs])
            with np.errstate(over="ignore"):
                single = pair.astype(np.float32)
            # Many environments compute in single precision.
            unit = np.spacing(np.abs(single if np.array_equal(single, pair) else pair).max())
            return abs(ours - theirs) <= LAST_PLACES * float(unit)
    return False


def share_of(text: str) -> float:
    """`5%` or `all` as a share, 0 to 1. ValueError for anything else."""
    value: Any = (
        1.0 if text == "all" else float(text.removesuffix("%")) / 100.0 if text.endswith("%") else None
    )
    if value is None or not 0.0 < value <= 1.0:
        raise ValueError(text)
    return float(value)
