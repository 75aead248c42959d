"""Plays recorded actions of published results again, on a cluster of this machine's own.

Rules that this module owns:
- Nothing of the file is executed, and no limit of it is taken over: actions are data, the environments are the
  installed ones, and the worker's slots run them in its jail.
- The splits are those of the opening, which the commitment fixes. A run is not played whose environment is not
  installed, is in other versions, which give other numbers, or does not repeat episodes according to this machine.
"""

from __future__ import annotations

import contextlib
from collections.abc import AsyncIterator, Callable, Mapping, Sequence
from pathlib import Path

import msgspec
import numpy as np

from evopolicy_common import catalogue
from evopolicy_common.errors import BrokenEnvironmentError, ConfigError, EvopolicyError, ProtocolError
from evopolicy_common.local.cluster import local_cluster
from evopolicy_common.messages.operator import DescribeEnvironment
from evopolicy_common.processes.scratch import scratch_folder
from evopolicy_common.records.episodes import compare
from evopolicy_common.records.episodes.trajectory import Trajectory
from evopolicy_common.records.splits import FILE_STEMS, SPLITS, SplitFile, cases_hash
from evopolicy_common.wire import credentials, transport
from evopolicy_results.evaluations import Cases, Evaluations, Origin, sample, unlike
from evopolicy_results.publish.contents import EpisodeGroup
from evopolicy_results.publish.findings import FileSet, Findings, PublishedRun, State
from evopolicy_results.publish.run_rules import recording_of

LAST_PLACES = 4
"""Units in the last place by which a reward may differ on a processor with other features."""

Tell = Callable[[int, int], None]
"""Receives the number of episodes played, and the total."""


class Chosen(msgspec.Struct, frozen=True):
    """Episodes of one group that are played."""

    run: PublishedRun
    group: EpisodeGroup
    cases: Cases
    indexes: tuple[int, ...]


async def replay(files: FileSet, checked: Findings, share: float, tell: Tell) -> None:
    """Plays a share of all recorded episodes, drawn at random, and adds the findings to `checked`. Runs are played on
    as many clusters, one after another, as their cases ask for."""
    chosen = draw(checked.runs, share)
    if not chosen:
        checked.add("replay", "open", "there are no episodes to play")
    by_run: dict[str, list[Chosen]] = {}
    clusters: dict[int, list[PublishedRun]] = {}
    """Runs by the number of their cases in `known`: a cluster has one set of an environment's."""
    known: dict[str, list[str]] = {}
    for run, parts in ((run, [each for each in chosen if each.run is run]) for run in checked.runs):
        env = run.opening.settings.env
        if not parts:
            continue
        # A name that is not of an installed environment could be that of a module to import.
        if not (catalogue.is_shipped(env) or env in catalogue.plugins()):
            checked.add("replay", "open", f"{env} is not installed here", run.opening.run)
        else:
            by_run[run.folder] = parts
            cases = cases_hash(case for split in SPLITS for case in run.cases(split))
            numbered = known.setdefault(env, [])
            if cases not in numbered:
                numbered.append(cases)
            clusters.setdefault(numbered.index(cases), []).append(run)
    total = sum(len(each.indexes) for parts in by_run.values() for each in parts)
    played = 0

    def tell_played(count: int, waits_for: str) -> None:
        tell(played + count, total)

    for runs in clusters.values():
        try:
            async with _cluster_of(runs, tell_played) as evaluations:
                for run in runs:
                    why_not, other_cpu = await unplayable(evaluations, run)
                    if why_not:
                        checked.add("replay", "open", f"not played: {why_not}", run.opening.run)
                    else:
                        await _replay(files, checked, evaluations, by_run[run.folder], other_cpu)
                played += evaluations.played
        except EvopolicyError as error:
            checked.add("replay", "open", f"could not be played: {error}")


async def _replay(
    files: FileSet,
    checked: Findings,
    evaluations: Evaluations,
    parts: Sequence[Chosen],
    other_cpu: bool,
) -> None:
    """Plays the chosen episodes of one run. `other_cpu`: this processor has other features than the run's."""
    name, played, alike = parts[0].run.opening.run, 0, True
    for part in parts:
        recorded = _recorded(files, part)
        played += len(recorded)
        covered = checked.covered.get(part.group.part, 0)
        checked.covered[part.group.part] = covered + len(recorded)
        async for fault, is_rounding in _replayed(evaluations, part, recorded):
            alike = False
            state: State = "open" if other_cpu and is_rounding else "failed"
            if state == "open":
                fault += (
                    f", {LAST_PLACES} units in the last place at most: this machine's processor has other"
                    " features than the run's"
                )
            elif other_cpu:
                fault += "; other features of the processor do not explain this"
            checked.add("replay", state, fault, name)
    # A replay shows nothing of episodes without a recording, however many it drew.
    missing = checked.unrecorded(name)
    if alike:
        text = f"{played} episodes, bit for bit (drawn at random)"
        if missing:
            text += f"; only {', '.join(missing)} episodes have a recording"
        checked.add("replay", "open" if missing else "ok", text, name)


def _recorded(files: FileSet, part: Chosen) -> dict[int, bytes]:
    """The recordings of the chosen episodes, by index."""
    recorded: dict[int, bytes] = {}
    with contextlib.suppress(ProtocolError):  # reported by the check of recordings
        for index, data in enumerate(part.run.recordings(files, part.group.name)):
            if data is not None and index in part.indexes:
                recording_of(data)
                recorded[index] = data
    return recorded


async def _replayed(
    evaluations: Evaluations, part: Chosen, recorded: Mapping[int, bytes]
) -> AsyncIterator[tuple[str, bool]]:
    """Replays the recorded actions. Yields the differences, each with whether it may be a matter of rounding."""
    settings, group = part.run.opening.settings, part.group
    if not recorded:
        return
    actions = [compare.action_log(recording_of(data).actions) for data in recorded.values()]
    async for index, outcome in evaluations.replayed(
        part.cases, list(recorded), Origin(settings.env, settings), actions=actions
    ):
        place, told = f"{group.name}, episode {index}", group.episodes[index].episode_return
        if outcome is None or outcome.trajectory is None:
            yield f"{place}: not played to its end", False
            continue
        before, again = recording_of(recorded[index]), await evaluations.recording(outcome)
        fault = compare.first_difference(before, again)
        if fault is None and not compare.same(told, outcome.episode_return):
            fault = f"return {told!r} is recorded, {outcome.episode_return!r} was played"
        if fault is not None:
            yield f"{place}: {fault}", rounded(before, again)


def draw(runs: Sequence[PublishedRun], share: float) -> list[Chosen]:
    """A share of all episodes of the runs, by group. Leaves out those whose cases cannot be."""
    groups = [(run, group) for run in runs for group in run.groups]
    sizes = [len(group.episodes) for _, group in groups]
    chosen = []
    for k, drawn in sample(sizes, max(1, round(share * sum(sizes)))):
        run, group = groups[k]
        submit = next((one for one in run.result.submits if one.submit_index == group.submit_index), None)
        train = () if submit is None else submit.env_instances
        ids = train if group.split == "train" else tuple(range(len(group.episodes)))
        indexes = tuple(index for index in drawn if index < len(ids))
        if not indexes or not all(0 <= each < len(run.cases(group.split)) for each in ids):
            continue
        before = [one for one in run.result.submits if one.submit_index <= group.submit_index]
        cases = Cases(
            split=group.split,
            submit_index=group.submit_index,
            env_instances=ids,
            modulo=len(train) or len(ids),
            remaining_budget_after=run.opening.budget - sum(len(one.env_instances) for one in before),
        )
        chosen.append(Chosen(run, group, cases, indexes))
    return chosen


@contextlib.asynccontextmanager
async def _cluster_of(
    runs: Sequence[PublishedRun], tell: Callable[[int, str], None]
) -> AsyncIterator[Evaluations]:
    """A cluster whose splits are those of the runs."""
    with scratch_folder("check-data") as data:
        by_env = {run.opening.settings.env: run for run in runs}
        for env, run in by_env.items():
            folder = Path(data) / catalogue.folder_name(env)
            folder.mkdir()
            for split in SPLITS:
                content = SplitFile(env=env, split=FILE_STEMS[split], cases=run.cases(split), secret=False)
                (folder / f"{FILE_STEMS[split]}.json").write_bytes(msgspec.json.encode(content))
        async with local_cluster("check", data=Path(data)) as cluster:
            await cluster.start_workers(sorted(by_env), tiers={"bwrap"})
            async with transport.connect(credentials.find("operator", (), cluster.operator_file)) as link:
                yield Evaluations(link, tell, own=True)


async def unplayable(evaluations: Evaluations, run: PublishedRun) -> tuple[str, bool]:
    """Why episodes of the run cannot be compared on this machine: its environment does not repeat them, or in other
    versions. Empty where they can. And whether the processor's features differ from those in the run."""
    env, known = run.opening.settings.env, run.record.versions.fingerprint
    try:
        state = await evaluations.versions(DescribeEnvironment(env=env))
    except BrokenEnvironmentError as error:
        return str(error), False
    if not state.fingerprints:
        return f"no worker of this machine offers {env}; `evopolicy-worker check-env {env}` shows why", False
    offered, *_ = await evaluations.ask.environments()
    if any(each.description.env == env and not each.description.deterministic for each in offered):
        return f"{env} is marked as not deterministic: the same actions can give another episode", False
    here: dict[str, str] = {}
    for fingerprint in state.fingerprints:
        here |= fingerprint.flat()
    names = known.keys() & here.keys() - {"cpu", "evopolicy-worker"}
    differ = unlike({name: known[name] for name in names}, {name: here[name] for name in names})
    return "; ".join(differ[:4]), here.get("cpu") != known.get("cpu")


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


def share_of(option: str, text: str | None) -> float | None:
    """`5%` or `all` as a share, 0 to 1; None for none. ConfigError, with the option, for anything else."""
    if text is None:
        return None
    with contextlib.suppress(ValueError):
        value = 100.0 if text == "all" else float(text.removesuffix("%")) if text.endswith("%") else 0.0
        if 0.0 < value <= 100.0:
            return value / 100.0
    raise ConfigError(f"{option} {text!r}: say a share such as 5%, or all")
