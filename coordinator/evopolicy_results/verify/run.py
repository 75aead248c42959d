"""Replays a finished run's episodes and reports every difference.

Rules that this module owns:
- The exact check replays recorded actions in the environment, without a policy. The actions are the coordinator's
  stored ones if it still has them, otherwise those of the feedback files. The results must equal, bit for bit, the
  stored record, the feedback files, and the returns in `summary.json` and `run.json`.
- All other numbers of the directory are checked without playing (`numbers`), whatever the sample.
- The advisory check: the checkpoint's policy plays the same cases again. A policy may read clocks, so this proves
  nothing.
- The cases must be the run's: split hashes are compared before any episode is played.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import msgspec

from evopolicy_common.errors import BundleError, ConfigError
from evopolicy_common.messages.episode import EpisodeOutcome
from evopolicy_common.messages.gateway import CANCELLED
from evopolicy_common.messages.operator import DescribeEnvironment, EnvironmentState, RunResult
from evopolicy_common.records.aggregates import mean
from evopolicy_common.records.episodes import compare
from evopolicy_common.records.episodes.rendered import decode
from evopolicy_common.records.episodes.trajectory import Trajectory
from evopolicy_common.records.policies.checkpoints import bundle_of
from evopolicy_common.records.rescores import FOLDER, rescore_names
from evopolicy_common.records.splits import SPLITS
from evopolicy_common.wire.operator_client import TIMEOUT_S
from evopolicy_results.evaluations import Evaluations, Origin, unlike
from evopolicy_results.reading.comparability import comparable
from evopolicy_results.verify import numbers
from evopolicy_results.verify.source import EpisodeList, RunUnderTest


class Difference(msgspec.Struct, frozen=True, kw_only=True):
    """One episode, or one list of episodes, that differs from the run's record."""

    episode: str
    difference: str


class Report(msgspec.Struct, kw_only=True):
    """The result of a verification; updated while it runs."""

    run_directory: str
    env: str
    identical: bool = True
    episodes: int = 0
    """Replayed from their recorded actions."""
    from_files: int = 0
    """Of these, episodes whose actions came from feedback files, as the coordinator no longer stores them."""
    differences: list[Difference] = []
    not_checked: list[Difference] = []
    unchecked_episodes: int = 0
    """Of these, episodes whose actions nobody has any more."""
    policy_episodes: int = 0
    """Played again by the checkpoint's policy."""
    policy_differences: list[Difference] = []
    """Advisory."""
    fingerprint_differences: list[str] = []
    notes: list[str] = []

    def differs(self, episode: str, difference: str) -> None:
        self.identical = False
        self.differences.append(Difference(episode=episode, difference=difference))

    def leaves_open(self, episode: str, difference: str) -> None:
        self.not_checked.append(Difference(episode=episode, difference=difference))


class _Recording(msgspec.Struct, kw_only=True):
    """The data of one episode before its replay."""

    actions: bytes
    """Trajectory bytes with the actions to replay."""
    outcome: EpisodeOutcome | None
    """As stored by the coordinator."""
    stored: bytes | None
    """Its packed trajectory, unpacked only for the comparison: a submit's trajectories together may be gigabytes."""
    has_files: bool


class Verifier:
    def __init__(self, evaluations: Evaluations, run: RunUnderTest) -> None:
        self._evaluations = evaluations
        self._run = run
        record, dimensions = run.record, run.record.experiment_dimensions
        self._origin = Origin(record.env, dimensions, record.run, record.sandbox_tier, dimensions.limits)
        self._knows_run = False
        self._recorded: dict[int, _Recording] = {}
        """Of the list that was replayed last, by index."""
        self.report = Report(run_directory=str(run.root), env=run.record.env)

    async def check_cases(self) -> bool:
        """Whether the coordinator still has the run. Raises ConfigError when the coordinator's cases are not the
        run's."""
        state = await self._describe()
        record, versions = self._run.record, self._run.record.versions
        if record.experiment_dimensions.hidden_cases == "per_run" and not state.knows_run:
            raise ConfigError(
                f"run {record.run} had hidden cases of its own, and this cluster's coordinator does not have that run:"
                " they are in the state folder of the coordinator that made it; use that one, with --state, or a"
                " backup of it"
            )
        for split in SPLITS:
            ours = versions.cases_hash(split).removeprefix("sha256:")
            theirs = state.split_hashes.get(split, "")
            if not ours:
                self.report.leaves_open(f"{split} cases", "run.json has no hash of them: they may be others")
            elif ours != theirs:
                raise ConfigError(
                    f"this cluster's {split} cases of {record.env} are not the run's (SHA-256 {theirs[:12]}…"
                    f" here, {ours[:12]}… in run.json): use the coordinator that made the run, its --state, or its"
                    " --data"
                )
        self._knows_run = state.knows_run
        result = msgspec.json.decode(state.result, type=RunResult) if state.result else None
        for name, difference in numbers.differences(self._run, result):
            self.report.differs(name, difference)
        for submit in self._run.submits:
            for name, content in (("summary.json", submit.summary), ("_meta.json", submit.meta)):
                if content is None and submit.status != CANCELLED:
                    self.report.leaves_open(f"submit {submit.index}", f"it has no {name}")
        for name in rescore_names(self._run.root):
            text = (
                "its returns are not played again: say `evopolicy rescore` with"
                f" --name {name} for a copy of the run directory without this file, and compare"
            )
            self.report.leaves_open(f"{FOLDER}/{name}.json", text)
        return state.knows_run

    def skips(self, n: int) -> bool:
        """Whether the run's `n` episodes are not played again, as its environment does not repeat them."""
        if self._run.record.versions.env_deterministic:
            return False
        text = (
            f"{n} not played again: the environment is marked as not deterministic, so the same actions give other"
            " episodes"
        )
        self.report.leaves_open("episodes", text)
        self.report.unchecked_episodes += n
        return True

    async def replay(self, played: EpisodeList, indexes: Sequence[int]) -> None:
        """Makes the exact check of these episodes of a list."""
        self._recorded = recorded = await self._recordings(played, indexes)
        if not recorded:
            return
        returns: list[float] = []
        async for index, outcome in self._evaluations.replayed(
            played,
            list(recorded),
            self._origin,
            actions=[recording.actions for recording in recorded.values()],
            record="full" if played.split == "train" else "actions",
        ):
            if outcome is None:
                self.report.differs(played.name(index), "could not be played again")
                continue
            returns.append(outcome.episode_return)
            self.report.episodes += 1
            replayed = await self._evaluations.recording(outcome)
            for difference in _differences(played, index, recorded[index], outcome, replayed):
                self.report.differs(played.name(index), difference)
        is_whole = len(returns) == len(played.env_instances)
        if is_whole and played.mean is not None and mean(returns) != played.mean:
            name = f"submit {played.submit_index}, {played.split}"
            self.report.differs(name, f"run.json has a mean of {played.mean!r}")

    async def play_policy(self, played: EpisodeList, indexes: Sequence[int]) -> None:
        """Makes the advisory check of these train episodes with their checkpoint's policy. Call it right after their
        `replay`."""
        dimensions = self._run.record.experiment_dimensions
        name = f"submit {played.submit_index}"
        if dimensions.policy_scope == "submit" and len(indexes) < len(played.env_instances):
            self.report.leaves_open(
                name, "its one policy plays whole submits, of which this sample is a part"
            )
            return
        assert played.submit is not None
        try:
            bundle = bundle_of(played.submit.checkpoint)
        except BundleError as error:
            if not played.submit.bundle:
                self.report.differs(name, f"its checkpoint cannot be read: {error}")
            return  # otherwise a difference that the check of numbers has reported
        if bundle.digest != played.submit.bundle:
            return  # a difference that the check of numbers has reported
        async for index, outcome in self._evaluations.replayed(
            played, indexes, self._origin, bundle=bundle, record="full"
        ):
            if outcome is None or (recording := self._recorded.get(index)) is None:
                continue
            self.report.policy_episodes += 1
            difference: str | None
            if outcome.failure is not None and outcome.trajectory is None:
                difference = f"{outcome.failure.category}: {outcome.failure.message}"
            else:
                again = await self._evaluations.recording(outcome)
                if recording.stored is not None:
                    difference = compare.first_difference(decode(recording.stored), again)
                else:
                    difference = _of_files(played, index, again, actions=True)
            if difference is not None:
                finding = Difference(episode=played.name(index), difference=difference)
                self.report.policy_differences.append(finding)

    async def check_fingerprint(self) -> None:
        """Compares the library versions of the connected workers with the run's. Call it after workers have played
        episodes."""
        if known := self._run.record.versions.fingerprint:
            fingerprints = [each.flat() for each in (await self._describe()).fingerprints]
            differences = [each for here in fingerprints for each in unlike(*comparable([known, here]))]
            self.report.fingerprint_differences = list(dict.fromkeys(differences))

    async def _describe(self) -> EnvironmentState:
        record, dimensions = self._run.record, self._run.record.experiment_dimensions
        message = DescribeEnvironment(
            env=record.env,
            run=record.run,
            n_validation=dimensions.n_validation,
            n_heldout=dimensions.n_heldout,
        )
        return await self._evaluations.ask.describe(message)

    async def _recordings(self, played: EpisodeList, indexes: Sequence[int]) -> dict[int, _Recording]:
        stored: dict[int, EpisodeOutcome] = {}
        if self._knows_run:
            run, split, submit = self._run.record.run, played.split, played.submit_index
            outcomes = self._evaluations.ask.recorded(run, split, submit, timeout_s=TIMEOUT_S)
            stored = {outcome.index: outcome async for outcome in outcomes}
        recordings: dict[int, _Recording] = {}
        for index in indexes:
            outcome, rows = stored.get(index), self._rows(played, index)
            trajectory: bytes | None = None
            if outcome is not None and outcome.trajectory is not None:
                trajectory = await self._evaluations.ask.fetch(outcome.trajectory)
                actions = compare.action_log(decode(trajectory).actions)
            elif rows is not None:
                try:
                    actions = compare.action_log(compare.actions_of(rows))
                except Exception as error:
                    # JSON of any shape and size: an agent without a jail could have written it.
                    text = f"its actions cannot be played: {type(error).__name__}: {error}"
                    self.report.differs(played.name(index), text)
                    continue
                self.report.from_files += 1
            else:
                if not played.folders:
                    self.report.unchecked_episodes += 1
                    text = "the coordinator has no record of it any more"
                    self.report.leaves_open(played.name(index), text)
                continue
            recordings[index] = _Recording(
                actions=actions, outcome=outcome, stored=trajectory, has_files=rows is not None
            )
        return recordings

    def _rows(self, played: EpisodeList, index: int) -> compare.Rows | None:
        if not played.folders:
            return None
        fault = ""
        try:
            rows = compare.Rows(played.folders[index])
            if not rows and (played.lengths is None or played.lengths[index]):
                fault = "trajectory.jsonl has no step"
        except (OSError, ValueError) as error:
            fault = f"trajectory.jsonl cannot be read: {error}"
        if fault:
            self.report.differs(played.name(index), fault)
            return None
        return rows


def _differences(
    played: EpisodeList, index: int, recording: _Recording, again: EpisodeOutcome, replayed: Trajectory
) -> Iterator[str]:
    then, summary = recording.outcome, played.submit.summary if played.submit else None
    stored = None if recording.stored is None else decode(recording.stored)
    if stored and then and (fault := compare.episode_difference(then, stored, again, replayed)):
        yield f"the stored record: {fault}"
    if recording.has_files and (fault := _of_files(played, index, stored or replayed, actions=bool(stored))):
        yield f"the feedback files: {fault}"
    if played.returns is not None and not compare.same(played.returns[index], again.episode_return):
        yield f"return {played.returns[index]!r} is recorded, {again.episode_return!r} was played"
    if played.lengths is not None and played.lengths[index] != again.length:
        yield f"{played.lengths[index]} steps are recorded, {again.length} were played"
    if summary is None:
        return
    pairs: list[tuple[str, object, object]] = []
    parts, solved = summary.reward_components_per_episode, summary.successes
    if parts is not None and index < len(parts):
        pairs.append(("reward components", parts[index], again.reward_components))
    if then is not None:
        # A replay has no policy that could fail.
        pairs.append(("policy failed", index in (summary.errors or ()), then.failure is not None))
        if solved is not None and index < len(solved):
            pairs.append(("success", solved[index], then.success))
    for what, told, came in pairs:
        if told != came:
            yield f"{what} {told!r} is recorded, {came!r} was played"


def _of_files(played: EpisodeList, index: int, episode: Trajectory, *, actions: bool) -> str | None:
    """Describes the first difference of an episode's feedback files from `episode`."""
    folder = played.folders[index]
    try:
        rows = compare.Rows(folder)
        return compare.files_difference(folder, rows, episode, actions=actions, pictures=played.pictures)
    except Exception as error:
        # An agent without a jail could have written the files: damaged archives, arrays of any size.
        return f"cannot be read: {type(error).__name__}: {error}"
