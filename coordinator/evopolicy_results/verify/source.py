"""Reads from a finished run directory which episodes can be replayed, and where their files are.

Rules: no content is trusted to be the run's own; unreadable files are reported by name. An episode without a
trajectory (its submit was not `ok`) is not listed.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import msgspec

from evopolicy_common.errors import ConfigError, ProtocolError, raised_as
from evopolicy_common.messages.environment import Split
from evopolicy_common.messages.episode import RANDOM
from evopolicy_common.records.policies.submits import SubmitFiles, read_submits
from evopolicy_common.records.run_files import RUN_JSON, read_record
from evopolicy_common.records.run_record import RunRecord
from evopolicy_results.evaluations import Cases

_MAX_DIGITS = 9


class EpisodeList(Cases, frozen=True, kw_only=True):
    """A list of cases that one policy played, with the run directory's files and numbers of its episodes."""

    returns: tuple[float, ...] | None = None
    """None when the directory records only `mean`."""
    lengths: tuple[int, ...] | None = None
    submit: SubmitFiles | None = None
    """Of train episodes."""
    mean: float | None = None
    folders: tuple[Path, ...] = ()
    """Each train episode's folder; empty for hidden ones, and where the agent was shown scores alone."""
    pictures: bool = True
    """Whether the folders have the observations that are stored outside the rows."""

    def name(self, index: int) -> str:
        if self.folders:
            return f"submit {self.submit_index}, {self.folders[index].name}"
        policy = "random actions" if self.submit_index == RANDOM else f"submit {self.submit_index}"
        return f"{policy}, {self.split} episode {index}"


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
        raise ConfigError(
            f"{root} is not the directory of a finished run: {RUN_JSON}: {error.strerror}; name a folder such as"
            " runs/evolve/gym_acrobot/first"
        ) from error
    except ProtocolError as error:
        raise ConfigError(f"{root / RUN_JSON}: {error}") from error
    with raised_as(ConfigError, root, ProtocolError):
        submits = read_submits(root)
        for submit in submits:  # a damaged file is an error before anything is played
            _ = submit.summary, submit.meta
    train = tuple(played for submit in submits if (played := _train(record, submit)))
    hidden = tuple(_hidden(record, {one.submit_index: one for one in train}))
    return RunUnderTest(root=root, record=record, submits=tuple(submits), train=train, hidden=hidden)


def _train(record: RunRecord, submit: SubmitFiles) -> EpisodeList | None:
    """The episodes of an `ok` submit; None for any other."""
    summary, folder = submit.summary, submit.feedback
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
        submit=submit,
        # At the level `scores` the feedback has no trajectories.
        folders=()
        if record.experiment_dimensions.feedback == "scores"
        else tuple(folder / "episodes" / f"ep_{first + index:0{width}d}" for index in range(n)),
        pictures=record.experiment_dimensions.feedback == "pictures",
    )


def _hidden(record: RunRecord, train: dict[int, EpisodeList]) -> Iterator[EpisodeList]:
    dimensions, outcome = record.experiment_dimensions, record.outcome
    best, returns = outcome.best_submit_index, outcome.heldout_returns
    rows: list[tuple[Split, EpisodeList | None, int, tuple[float, ...] | None, float | None]] = [
        ("validation", train.get(int(text)), dimensions.n_validation, None, mean)
        for text, mean in (outcome.val_scores or {}).items()
        if text.isdecimal() and len(text) <= _MAX_DIGITS
    ]
    if best is not None:
        rows.append(("heldout", train.get(best), len(returns), returns, outcome.heldout_mean_return))
    if (reference := outcome.random_reference) is not None and (n := len(reference.returns)):
        own = EpisodeList(
            split="heldout",
            submit_index=RANDOM,
            env_instances=(),
            modulo=n,
            remaining_budget_after=0,
        )
        rows.append(("heldout", own, n, reference.returns, reference.mean_return))
    for split, of, n, told, mean in rows:
        if of is not None:
            hidden = {"split": split, "env_instances": tuple(range(n)), "returns": told, "mean": mean}
            yield msgspec.structs.replace(of, **hidden, lengths=None, submit=None, folders=())
