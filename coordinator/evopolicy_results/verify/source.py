"""Reads from a finished run directory which episodes can be replayed, and where their files are.

Rules: no content is trusted to be the run's own; unreadable files are reported by name. An episode without a
trajectory (its submit was not `ok`) is not listed.
"""

from __future__ import annotations

import random
from pathlib import Path

import msgspec

from evopolicy_common.errors import ConfigError, ProtocolError
from evopolicy_common.messages.environment import Split
from evopolicy_common.messages.gateway import REJECTED
from evopolicy_common.records.aggregates import mean
from evopolicy_common.records.newest import described
from evopolicy_common.records.policies.checkpoints import CheckpointMeta, read_meta
from evopolicy_common.records.run_files import RUN_JSON, read_record, submit_folders
from evopolicy_common.records.run_record import RunRecord
from evopolicy_common.records.summary import Summary, decode_summary
from evopolicy_common.regular_files import read_regular

RANDOM = -1
"""Submit index of the random reference."""
_MAX_DIGITS = 9


class EpisodeList(msgspec.Struct, frozen=True, kw_only=True):
    """A list of cases that one policy played: a submit's, or a checkpoint's hidden ones."""

    split: Split
    submit_index: int
    """`RANDOM` for the random reference."""
    env_instances: tuple[int, ...]
    """Ids in the split, in order."""
    modulo: int
    """Number of episodes of the policy's own submit."""
    remaining_budget_after: int
    returns: tuple[float, ...] | None
    """As recorded in the run directory; None when it records only `mean`."""
    lengths: tuple[int, ...] | None = None
    summary: Summary | None = None
    """Of a submit's train episodes."""
    mean: float | None = None
    folders: tuple[Path, ...] = ()
    """Each train episode's folder; empty for hidden ones, and where the agent was shown scores alone."""
    pictures: bool = True
    """Whether the folders have the observations that are stored outside the rows."""
    checkpoint: Path | None = None
    """`checkpoints/submit_NNN` of the policy; None for the random reference."""
    digest: str = ""
    """Digest of the policy's bundle, from the checkpoint's metadata."""

    def name(self, index: int) -> str:
        """An episode's name in reports."""
        if self.folders:
            return f"submit {self.submit_index}, {self.folders[index].name}"
        policy = "random actions" if self.submit_index == RANDOM else f"submit {self.submit_index}"
        return f"{policy}, {self.split} episode {index}"

    def mean_differs(self, returns: dict[int, float]) -> bool:
        """Whether all returns are present and their mean differs from the one in the run directory."""
        if self.mean is None or len(returns) < len(self.env_instances):
            return False
        return mean(list(returns.values())) != self.mean


class SubmitFiles(msgspec.Struct, frozen=True, kw_only=True):
    """What the directory has of one submit."""

    index: int
    """By the name of its folders."""
    summary: Summary | None
    meta: CheckpointMeta | None
    feedback: Path
    """`feedback/submit_NNN`, whether or not it exists."""
    checkpoint: Path

    @property
    def status(self) -> str:
        """Its verdict; empty where no file has it."""
        if self.summary is not None:
            return self.summary.status
        return "" if self.meta is None else self.meta.validation_status

    @property
    def n_episodes(self) -> int:
        """Episodes charged."""
        if self.summary is not None:
            return self.summary.n_episodes
        return 0 if self.meta is None else self.meta.n_episodes_requested


class RunUnderTest(msgspec.Struct, frozen=True, kw_only=True):
    """A finished run directory and its replayable episodes."""

    root: Path
    record: RunRecord
    submits: tuple[SubmitFiles, ...]
    """In order of their index."""
    train: tuple[EpisodeList, ...]
    hidden: tuple[EpisodeList, ...]


def read_run(root: Path) -> RunUnderTest:
    """Reads a run directory. Raises ConfigError when `root` is no finished run's directory, or one of its files is
    damaged."""
    try:
        record = read_record(root)
    except OSError as error:
        if text := described(root):
            raise ConfigError(f"{root} is {text}") from error
        raise ConfigError(
            f"{root} is not the directory of a finished run: {RUN_JSON}: {error.strerror}; name a folder such as"
            " runs/evolve/gym_acrobot/first"
        ) from error
    except ProtocolError as error:
        raise ConfigError(f"{root / RUN_JSON}: {error}") from error
    submits = _submits(root, record)
    train = [played for submit in submits if (played := _train(record, submit))]
    return RunUnderTest(
        root=root,
        record=record,
        submits=submits,
        train=tuple(train),
        hidden=tuple(_hidden(record, {one.submit_index: one for one in train})),
    )


def _submits(root: Path, record: RunRecord) -> tuple[SubmitFiles, ...]:
    feedback, checkpoints = root / "workspace" / "feedback", root / "checkpoints"
    found = []
    for index, folder in sorted({**submit_folders(checkpoints), **submit_folders(feedback)}.items()):
        of_feedback, checkpoint = feedback / folder.name, checkpoints / folder.name
        found.append(
            SubmitFiles(
                index=index,
                summary=_summary(of_feedback),
                meta=_meta(checkpoint, record.experiment_dimensions.episode_budget),
                feedback=of_feedback,
                checkpoint=checkpoint,
            )
        )
    return tuple(submit for submit in found if submit.status not in REJECTED)


def _train(record: RunRecord, submit: SubmitFiles) -> EpisodeList | None:
    """The episodes of an `ok` submit; None for any other."""
    summary, folder, meta = submit.summary, submit.feedback, submit.meta
    if summary is None or summary.env_instances is None or summary.first_global_episode is None:
        return None
    width = max(3, len(str(record.experiment_dimensions.episode_budget)))
    first, n = summary.first_global_episode, len(summary.env_instances)
    return EpisodeList(
        split="train",
        submit_index=submit.index,
        env_instances=summary.env_instances,
        modulo=n,
        remaining_budget_after=summary.remaining_budget,
        # Other numbers of them are a difference by themselves.
        returns=summary.returns if len(summary.returns or ()) == n else None,
        lengths=summary.episode_lengths if len(summary.episode_lengths or ()) == n else None,
        summary=summary,
        # At the level `scores` the feedback has no trajectories.
        folders=()
        if record.experiment_dimensions.feedback == "scores"
        else tuple(folder / "episodes" / f"ep_{first + index:0{width}d}" for index in range(n)),
        pictures=record.experiment_dimensions.feedback == "pictures",
        checkpoint=submit.checkpoint,
        digest="" if meta is None else meta.bundle,
    )


def _hidden(record: RunRecord, train: dict[int, EpisodeList]) -> list[EpisodeList]:
    dimensions, outcome = record.experiment_dimensions, record.outcome
    found: list[EpisodeList] = []

    def add(
        split: Split, own: EpisodeList, n: int, returns: tuple[float, ...] | None, mean: float | None
    ) -> None:
        found.append(
            msgspec.structs.replace(
                own,
                split=split,
                env_instances=tuple(range(n)),
                returns=returns,
                lengths=None,
                summary=None,
                mean=mean,
                folders=(),
            )
        )

    for text, told in (outcome.val_scores or {}).items():
        index = int(text) if text.isdecimal() and len(text) <= _MAX_DIGITS else -1
        if (own := train.get(index)) is not None:
            add("validation", own, dimensions.n_validation, None, told)
    if outcome.best_submit_index is not None and (own := train.get(outcome.best_submit_index)) is not None:
        add(
            "heldout", own, len(outcome.heldout_returns), outcome.heldout_returns, outcome.heldout_mean_return
        )
    reference = outcome.random_reference
    if reference is not None and reference.returns:
        n = len(reference.returns)
        found.append(
            EpisodeList(
                split="heldout",
                submit_index=RANDOM,
                env_instances=tuple(range(n)),
                modulo=n,
                remaining_budget_after=0,
                returns=reference.returns,
                mean=reference.mean_return,
            )
        )
    return found


def _summary(folder: Path) -> Summary | None:
    path = folder / "summary.json"
    try:
        return decode_summary(read_regular(path))
    except FileNotFoundError:
        return None
    except (OSError, ProtocolError) as error:
        raise ConfigError(f"{path} cannot be read: {error}") from error


def _meta(checkpoint: Path, episode_budget: int) -> CheckpointMeta | None:
    try:
        return read_meta(checkpoint, episode_budget)
    except ProtocolError as error:
        raise ConfigError(f"{checkpoint} is damaged: {error}") from error


def sample(lists: list[EpisodeList], n: int | None, seed: int) -> list[tuple[EpisodeList, tuple[int, ...]]]:
    """Draws `n` episodes of all lists without replacement (None: all), as indexes of each list that has some."""
    everything = [(k, index) for k, played in enumerate(lists) for index in range(len(played.env_instances))]
    chosen = everything if n is None or n >= len(everything) else random.Random(seed).sample(everything, n)
    by_list: dict[int, list[int]] = {}
    for k, index in chosen:
        by_list.setdefault(k, []).append(index)
    return [(lists[k], tuple(sorted(by_list[k]))) for k in sorted(by_list)]
