"""Checks the numbers of a run directory without playing an episode: against each other, and against the coordinator's
result.

Rules that this module owns:
- A number that follows from others in the directory must be what follows, bit for bit: means, spreads, the selection,
  the budget.
- If the coordinator still has the run, its result decides the rest: which submits there were, of which policies, and
  all scores.
- Every difference names the file and both values.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import msgspec

from evopolicy_common.errors import BundleError, ConfigError, ProtocolError
from evopolicy_common.messages.gateway import CANCELLED
from evopolicy_common.messages.operator import RunResult, SubmitResult
from evopolicy_common.records import account
from evopolicy_common.records.aggregates import best_validated, mean, std
from evopolicy_common.records.policies import trees
from evopolicy_common.records.policies.checkpoints import bundle_of
from evopolicy_common.records.policies.submits import SubmitFiles
from evopolicy_common.records.rescores import FOLDER, RescoreRecord, read_rescore, rescore_names
from evopolicy_common.records.run_record import RunRecord
from evopolicy_common.records.summary import Summary
from evopolicy_results.verify.source import RunUnderTest

Compared = Iterable[tuple[str, object, object]]
"""Names of numbers, each with its value and what it has to be."""

MISSING = type("Missing", (), {"__repr__": lambda self: "nothing"})()
"""The value of a field that a document does not have."""
_MAX_CHARS = 80
_STORED = "the coordinator has"


def differences(run: RunUnderTest, result: RunResult | None) -> Iterator[tuple[str, str]]:
    """Pairs of a file and what differs in it. `result`: the coordinator's; None when it does not have the run."""
    stored = {submit.submit_index: submit for submit in result.submits} if result is not None else {}
    spent = 0
    for position, submit in enumerate(run.submits):
        name = f"submit {submit.index}"
        if submit.index != position:
            yield name, f"it is the submit after number {position - 1}: files of a submit are missing"
        spent += submit.n_episodes
        yield from _unlike(f"{name}, summary.json", _summary(run, submit, spent))
        yield from _unlike(f"{name}, _meta.json", _meta(run, submit))
        known = stored.get(submit.index)
        yield from _unlike(f"{name}, summary.json", _stored(submit, known), _STORED)
        if (fault := _checkpoint(submit, known)) is not None:
            yield name, fault
    for played in run.train:
        expected = {folder.name for folder in played.folders}
        there = {folder.name for folder in played.folders[0].parent.glob("ep_*")} if played.folders else set()
        for folder in sorted(there - expected):
            yield f"submit {played.submit_index}", f"{folder[:_MAX_CHARS]} is none of its episodes"
    yield from _unlike("run.json", _outcome(run, spent))
    if result is not None:
        here = [submit.index for submit in run.submits if submit.status != CANCELLED]
        known_trees = {str(submit.submit_index): submit.tree for submit in result.submits if submit.tree}
        pairs = [("submits", here, sorted(stored)), ("trees", run.record.trees, known_trees)]
        yield from _unlike("run.json", [*pairs, *_stored_outcome(run.record, result)], _STORED)
    for index, digest in run.record.trees.items():
        name = trees.name_of(run.root, int(index))
        try:
            own = trees.read_tree(run.root, name)[1]
        except ConfigError as error:
            yield "trees", str(error)
        else:
            yield from _unlike(f"trees/{name}.json", [("digest", own, digest)])
    for name in rescore_names(run.root):
        file = f"{FOLDER}/{name}.json"
        try:
            if (record := read_rescore(run.root, name)) is not None:
                yield from _unlike(file, _rescore(run, name, record))
        except ProtocolError as error:
            yield file, str(error)


def _stored_outcome(record: RunRecord, result: RunResult) -> Compared:
    """The outcome in `run.json` against the one that the coordinator's result gives."""
    outcome = record.outcome
    try:
        claims = account.claims_in(record)
    except msgspec.ValidationError as error:
        yield "metrics of code", str(error), "as the software writes them"
        return
    wanted = account.outcome(result, claims)
    yield from unlike_documents(as_json(outcome), as_json(wanted), "outcome")


def as_json(value: object) -> object:
    """The JSON document of a record."""
    return msgspec.json.decode(msgspec.json.encode(value))


def unlike_documents(told: object, wanted: object, path: str = "") -> Iterator[tuple[str, object, object]]:
    """The fields in which two JSON documents differ, by their paths, with both values (`MISSING` for none)."""
    if isinstance(told, dict) and isinstance(wanted, dict):
        for name in dict.fromkeys((*told, *wanted)):
            pair = (told.get(name, MISSING), wanted.get(name, MISSING))
            yield from unlike_documents(*pair, f"{path}.{name}" if path else name)
    # As JSON, 1 is no 1.0 and no true.
    elif told is MISSING or wanted is MISSING or msgspec.json.encode(told) != msgspec.json.encode(wanted):
        yield path, told, wanted


def _outcome(run: RunUnderTest, spent: int) -> Compared:
    """`run.json` against itself and the submits."""
    outcome, dimensions = run.record.outcome, run.record.experiment_dimensions
    heldout, reference = outcome.heldout_returns, outcome.random_reference
    yield "budget_used", outcome.budget_used, spent
    if spent > dimensions.episode_budget:
        yield "episode_budget", dimensions.episode_budget, f"{spent} or more"
    if reference is not None and reference.returns:
        yield "mean of random actions", reference.mean_return, mean(reference.returns)
        yield "standard deviation of random actions", reference.std_return, std(reference.returns)
        yield "number of random returns", len(reference.returns), dimensions.n_heldout
    if outcome.status != "completed":
        yield "heldout_returns", heldout, ()
        yield "best_submit_index", outcome.best_submit_index, None
        yield "final_score", outcome.final_score or None, None
        return
    yield "number of heldout_returns", len(heldout), dimensions.n_heldout
    if heldout:
        yield "final_score", outcome.final_score, mean(heldout)
        yield "heldout_mean_return", outcome.heldout_mean_return, mean(heldout)
        yield "heldout_std_return", outcome.heldout_std_return, std(heldout)
    scores = outcome.val_scores or {}
    quarantined = set(map(str, outcome.quarantined_submits))
    played = {str(submit.index) for submit in run.submits if submit.status == "ok"}
    yield "submits of val_scores", sorted(scores), sorted((played - quarantined) | (played & scores.keys()))
    eligible = {int(name): mean_ for name, mean_ in scores.items() if name in played - quarantined}
    yield "best_submit_index", outcome.best_submit_index, best_validated(eligible, dimensions.profile)


def _summary(run: RunUnderTest, submit: SubmitFiles, spent: int) -> Compared:
    """A submit's summary against itself and the budget. `spent`: episodes up to its end."""
    summary = submit.summary
    if summary is None:
        return
    yield "submit_index", summary.submit_index, submit.index
    yield "env", summary.env, run.record.env
    if summary.status == CANCELLED:
        return
    budget = run.record.experiment_dimensions.episode_budget
    yield "remaining_budget", summary.remaining_budget, budget - spent
    if summary.env_instances is not None:
        yield "n_episodes", summary.n_episodes, len(summary.env_instances)
    if summary.status == "ok":
        if summary.env_instances is None:
            yield "env_instances", None, "a value"
        if summary.first_global_episode is None:
            yield "first_global_episode", None, "a value"
        yield from _aggregates(summary)


def _aggregates(summary: Summary) -> Compared:
    n, returns, lengths = summary.n_episodes, summary.returns or (), summary.episode_lengths or ()
    yield "number of returns", len(returns), n
    yield "number of episode_lengths", len(lengths), n
    if len(returns) == len(lengths) == n > 0:
        yield "mean_return", summary.mean_return, mean(returns)
        yield "std_return", summary.std_return, std(returns)
        yield "min_return", summary.min_return, min(returns)
        yield "max_return", summary.max_return, max(returns)
        yield "mean_episode_length", summary.mean_episode_length, mean(lengths)
    failed = summary.errors or ()
    if summary.policy_failures is not None:
        yield "policy_failures", summary.policy_failures, len(failed)
    for name, places in (("errors", failed), ("timeouts", summary.timeouts or ())):
        yield name, places, tuple(place for place in places if 0 <= place < n and place in failed)
    parts = summary.reward_components_per_episode
    if parts is not None:
        yield "number of reward_components_per_episode", len(parts), n
        names = dict.fromkeys(name for each in parts for name in each)
        means = {name: mean([each.get(name, 0.0) for each in parts]) for name in names}
        yield "reward_components_mean", summary.reward_components_mean, means
    if summary.successes is not None:
        yield "number of successes", len(summary.successes), n


def _meta(run: RunUnderTest, submit: SubmitFiles) -> Compared:
    """A checkpoint's metadata against the summary and `run.json`."""
    meta, summary = submit.meta, submit.summary
    if meta is None:
        return
    yield "submit_index", meta.submit_index, submit.index
    scores = run.record.outcome.val_scores or {}
    if run.record.outcome.status == "completed":
        yield "val_mean", meta.val_mean, scores.get(str(submit.index))
    if summary is not None and summary.status != CANCELLED:
        yield "validation_status", meta.validation_status, summary.status
        yield "mean_return", meta.mean_return, summary.mean_return
        yield "n_episodes_requested", meta.n_episodes_requested, summary.n_episodes
        yield "remaining_budget_after", meta.remaining_budget_after, summary.remaining_budget
        before = summary.remaining_budget + summary.n_episodes
        yield "remaining_budget_before", meta.remaining_budget_before, before


def _rescore(run: RunUnderTest, name: str, record: RescoreRecord) -> Compared:
    """A re-score against the run. Nothing in the directory determines its returns."""
    yield "name", record.name, name
    yield "run", record.run, run.record.run
    yield "env", record.env, run.record.env
    yield "selected", record.selected, run.record.outcome.best_submit_index
    known = {submit.index for submit in run.submits if submit.status == "ok"}
    there = sorted(each.submit_index for each in record.checkpoints)
    yield "submits of checkpoints", there, sorted(known.intersection(there))
    for each in record.checkpoints:
        what = f"of submit {each.submit_index}"
        yield f"number of lengths {what}", len(each.lengths), record.n_cases
        if each.successes:
            yield f"number of successes {what}", len(each.successes), record.n_cases
        places = sorted(map(int, each.failures))
        yield f"failures {what}", places, [place for place in places if place < record.n_cases]


def _stored(submit: SubmitFiles, known: SubmitResult | None) -> Compared:
    """A submit against the coordinator's result."""
    summary = submit.summary
    if known is None or summary is None or summary.status == CANCELLED:
        return
    yield "status", summary.status, known.status
    yield "mean_return", summary.mean_return, known.mean_return
    if summary.env_instances is not None:
        yield "env_instances", summary.env_instances, known.env_instances


def _checkpoint(submit: SubmitFiles, known: SubmitResult | None) -> str | None:
    """Whether the checkpoint's files are those that were submitted; without the coordinator, that its metadata
    names."""
    submitted = None if known is None else known.bundle
    wanted = submitted or submit.bundle
    if not wanted:
        return None
    try:
        if bundle_of(submit.checkpoint).digest != wanted:
            names = "that _meta.json names" if submitted is None else "that was submitted"
            return f"its checkpoint does not hold the policy {names}"
    except BundleError as error:
        return f"its checkpoint cannot be read: {error}"
    return (
        "_meta.json names another policy than the one that was submitted"
        if submit.bundle not in ("", wanted)
        else None
    )


def _unlike(
    file: str, told: Compared, source: str = "what follows from the rest is"
) -> Iterator[tuple[str, str]]:
    for name, here, wanted in told:
        if here != wanted:
            yield file, f"{name} is {short(here)}; {source} {short(wanted)}"


def short(value: object) -> str:
    """A value as a difference quotes it."""
    text = repr(value)
    return text if len(text) <= _MAX_CHARS else f"{text[: _MAX_CHARS - 1]}…"
