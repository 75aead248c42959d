"""The rules of `evopolicy check` for one run: its documents against the journal, against each other, and against its recordings."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, TypeVar

from evopolicy_common.errors import BundleError, ProtocolError
from evopolicy_common.records import journal
from evopolicy_common.records.aggregates import mean
from evopolicy_common.records.episodes.trajectory import Trajectory, decode
from evopolicy_common.records.journal import Ended, Opened, Opening, Result, Revealed
from evopolicy_common.records.policies import bundles
from evopolicy_common.records.run_record import decode_run_record, inputs_digest
from evopolicy_coordinator.publish import contents
from evopolicy_coordinator.publish.contents import Group
from evopolicy_coordinator.publish.findings import (
    KINDS,
    Checked,
    Fault,
    Files,
    History,
    PublishedRun,
    decoded,
)
from evopolicy_coordinator.splits import FILE_STEMS, SPLITS, cases_hash, overlaps
from evopolicy_coordinator.verify.compare import same
from evopolicy_coordinator.verify.numbers import outcome_pairs

T = TypeVar("T")


def read_run(files: Files, folder: str, checked: Checked) -> PublishedRun | None:
    def read(name: str) -> bytes:
        return files.read(f"{folder}/{name}", contents.MAX_DOCUMENT_BYTES)

    try:
        opening, result = read(contents.OPENING), read(contents.RESULT)
        salt = read(contents.SALT).decode("ascii", "replace")
        return PublishedRun(
            folder=folder,
            record=decode_run_record(read(contents.RUN)),
            opening=decoded(f"{folder}/{contents.OPENING}", opening, Opening),
            salt=bytes.fromhex(salt),
            result=decoded(f"{folder}/{contents.RESULT}", result, Result),
            groups=decoded(f"{folder}/{contents.EPISODES}", read(contents.EPISODES), tuple[Group, ...]),
            opening_bytes=opening,
            result_bytes=result,
        )
    except (ProtocolError, ValueError) as error:
        checked.add("format", "failed", f"{folder}: {error}", folder)
        return None


def check_run(files: Files, run: PublishedRun, history: History, damaged: set[str], checked: Checked) -> None:
    name = run.opening.run
    rules: tuple[tuple[str, Iterator[Fault]], ...] = (
        ("commitment", _commitment(run, history)),
        ("disclosure", _disclosure(run, history)),
        ("result", _result(run, history)),
        ("record", _record(run)),
        ("budget", _budget(run)),
        ("selection", _selection(run)),
        ("scores", _scores(run)),
    )
    for kind, faults in rules:
        found = list(faults)
        for fault in found:
            checked.add(fault.kind, "failed", fault.text, name)
        if not found:
            checked.add(kind, "ok", KINDS[kind], name)
    _recordings(files, run, damaged, checked)
    _checkpoints(files, run, damaged, checked)
    if f"{run.folder}/{contents.LOG}" in files.names:
        checked.add("logs", "open", "the log is its publisher's: nothing fixed it when the run ended", name)
    text = "a recording shows what was played, not who decided it: actions could have been computed elsewhere"
    checked.add("policies", "open", text, name)


def _entry(history: History, kind: type[T], run: str) -> tuple[int, T] | None:
    for number, entry in enumerate(history.entries):
        if isinstance(entry, kind) and getattr(entry, "run", None) == run:
            return number, entry
    return None


def _commitment(run: PublishedRun, history: History) -> Iterator[Fault]:
    opening, settings = run.opening, run.opening.settings
    found = _entry(history, Opened, opening.run)
    if found is None:
        yield Fault("journal", "the journal has no entry of this run")
        return
    number, entry = found
    if len(run.salt) != journal.SALT_BYTES:
        yield Fault("commitment", f"its salt has {len(run.salt)} bytes instead of {journal.SALT_BYTES}")
    if journal.commitment(run.salt, run.opening_bytes) != entry.commitment:
        yield Fault("commitment", "splits or settings are not those that were committed to")
    declared = (entry.epoch, entry.entry, entry.model, entry.env, entry.exp_id, entry.repeat, entry.attempt)
    ours = (opening.epoch, settings.entry, settings.model, settings.env, settings.exp_id)
    if declared != (*ours, settings.repeat, settings.attempt):
        yield Fault("commitment", "the journal opened it for another entry, environment, experiment or epoch")
    place = run.record.committed
    if place is None or (place.commitment, place.opened, place.opened_head, place.epoch) != (
        entry.commitment,
        number,
        history.heads[number],
        entry.epoch,
    ):
        yield Fault("record", "run.json tells another commitment or head of the journal than the journal has")
    cases = {split: run.cases(split) for split in SPLITS}
    if repeated := overlaps(cases):
        yield Fault("commitment", f"its splits are not disjoint: {repeated[0]}")


def _disclosure(run: PublishedRun, history: History) -> Iterator[Fault]:
    epoch = run.opening.epoch
    if not any(isinstance(entry, Revealed) and entry.epoch == epoch for entry in history.entries):
        yield Fault(
            "disclosure", f"epoch {epoch} was not revealed: its cases may still be played as secret ones"
        )


def _result(run: PublishedRun, history: History) -> Iterator[Fault]:
    found = _entry(history, Ended, run.opening.run)
    if found is None:
        yield Fault("result", "the journal has no end of this run")
        return
    number, entry = found
    if journal.digest(run.result_bytes) != entry.result or run.result.run != run.opening.run:
        yield Fault("result", "result.json is not the result that the journal fixed when the run ended")
    if run.result.status != entry.status:
        yield Fault("result", f"it ended as {entry.status}, not as {run.result.status}")
    place = run.record.committed
    if place is None or (place.ended, place.ended_head) != (number, history.heads[number]):
        yield Fault("record", "run.json tells another end of the run than the journal has")


def _record(run: PublishedRun) -> Iterator[Fault]:
    """`run.json`, compared with the committed documents."""
    record, opening, result = run.record, run.opening, run.result
    settings, dimensions = opening.settings, record.experiment_dimensions
    staged = dimensions.n_train > 0
    pairs: list[tuple[str, Any, Any]] = [
        ("run", record.run, opening.run),
        ("env", record.env, settings.env),
        ("model", record.model, settings.model),
        ("exp_id", record.exp_id, settings.exp_id),
        ("repeat", record.repeat, settings.repeat),
        ("attempt", record.attempt, settings.attempt),
        ("agent.entry", record.agent.entry, settings.entry),
        ("sandbox_tier", record.sandbox_tier, settings.sandbox_tier),
        ("episode_budget", dimensions.episode_budget, opening.budget),
        ("versions.data_secret", record.versions.data_secret, opening.cases_secret),
    ]
    for name in (
        "policy_scope",
        "observations",
        "simulation",
        "video",
        "limits",
        "finish",
        "step_limit",
        "profile",
        "feedback",
    ):
        pairs.append((name, getattr(dimensions, name), getattr(settings, name)))
    pairs.append(("hidden_cases", dimensions.hidden_cases, settings.hidden_cases))
    for name, here, fixed in (
        ("agents_md", dimensions.agents_md, settings.agents_md),
        ("agent.prompts", record.agent.prompts, settings.prompts),
    ):
        pairs.append((name, here, f"sha256:{fixed}" if fixed else ""))
    pairs.append(("agent.inputs", inputs_digest(record.agent.inputs), settings.inputs))
    if staged:
        pairs.append(("n_train", dimensions.n_train, len(opening.train)))
        pairs.append(
            ("min_episodes_per_submit", dimensions.min_episodes_per_submit, opening.min_episodes_per_submit)
        )
        pairs.append(
            ("max_episodes_per_submit", dimensions.max_episodes_per_submit, opening.max_episodes_per_submit)
        )
    for split in SPLITS:
        ours = f"sha256:{cases_hash(run.cases(split))}"
        pairs.append((f"the hash of the {FILE_STEMS[split]} cases", record.versions.cases_hash(split), ours))
    for name, here, fixed in pairs:
        if here != fixed:
            yield Fault("record", f"run.json tells {name} {_short(here)}; committed to was {_short(fixed)}")
    for name, here, fixed in outcome_pairs(record.outcome, result):
        if here != fixed:
            yield Fault(
                "record", f"run.json tells {name} {_short(here)}; what came of the run is {_short(fixed)}"
            )


def _budget(run: PublishedRun) -> Iterator[Fault]:
    opening, result = run.opening, run.result
    indexes = [submit.submit_index for submit in result.submits]
    if indexes != sorted(set(indexes)):
        yield Fault("budget", "its submits are not in order")
    used = 0
    for submit in result.submits:
        n = len(submit.env_instances)
        used += n
        if not opening.min_episodes_per_submit <= n <= opening.max_episodes_per_submit:
            yield Fault(
                "budget", f"submit {submit.submit_index} has {n} episodes, which the settings do not allow"
            )
        if any(not 0 <= case < len(opening.train) for case in submit.env_instances):
            yield Fault("budget", f"submit {submit.submit_index} plays a case that is not one of train")
    if used != result.budget_used or used > opening.budget:
        yield Fault(
            "budget",
            f"its submits take {used} episodes, {result.budget_used} are told, {opening.budget} were granted",
        )


def _selection(run: PublishedRun) -> Iterator[Fault]:
    result = run.result
    eligible = [
        submit
        for submit in result.submits
        if submit.status == "ok"
        and submit.val_mean is not None
        and submit.submit_index not in result.validation_ineligible
    ]
    best = max(eligible, key=lambda submit: (submit.val_mean, submit.submit_index), default=None)
    wanted = None if best is None or result.status != "completed" else best.submit_index
    if result.status == "completed" and result.best_submit_index != wanted:
        yield Fault(
            "selection",
            f"submit {result.best_submit_index} is told, submit {wanted} has the best validation mean",
        )


def _scores(run: PublishedRun) -> Iterator[Fault]:
    result, opening = run.result, run.opening
    if len({group.name for group in run.groups}) != len(run.groups):
        yield Fault("scores", "a list of episodes occurs twice")
    groups = {(group.split, group.submit_index): group for group in run.groups}
    submits = {submit.submit_index: submit for submit in result.submits}
    for split, index, n in contents.wanted_groups(result):
        name = contents.group_name(split, index)
        group = groups.get((split, index))
        if group is None:
            yield Fault("scores", f"the episodes of {name} are not there")
            continue
        wanted = len(opening.validation) if n < 0 else n
        if [episode.index for episode in group.episodes] != list(range(wanted)):
            yield Fault(
                "scores", f"{name} has {len(group.episodes)} episodes, or out of order, instead of {wanted}"
            )
            continue
        returns = tuple(episode.episode_return for episode in group.episodes)
        if split == "heldout":
            recorded = result.random_heldout_returns if index == contents.RANDOM else result.heldout_returns
            if returns != recorded:
                yield Fault("scores", f"the returns of {name} are not those of the result")
        else:
            submit = submits[index]
            told = submit.mean_return if split == "train" else submit.val_mean
            if returns and mean(returns) != told:
                yield Fault("scores", f"the returns of {name} have the mean {mean(returns)!r}, not {told!r}")
    if result.status == "completed":
        n_heldout = len(result.heldout_returns)
        if n_heldout != len(opening.heldout) or result.final_score != mean(result.heldout_returns):
            yield Fault("scores", "the score is not the mean return of all held-out cases")


def _recordings(files: Files, run: PublishedRun, damaged: set[str], checked: Checked) -> None:
    name, played, missing, fine = run.opening.run, 0, 0, True
    for group in run.groups:
        path = f"{run.folder}/actions/{group.name}"
        if path not in files.names or path in damaged:
            missing += len(group.episodes)
            continue
        try:
            recordings = contents.unpack_recordings(files.read(path, contents.MAX_RECORDING_BYTES))
        except ProtocolError as error:
            checked.add("recordings", "failed", f"{group.name}: {error}", name)
            fine = False
            continue
        if len(recordings) != len(group.episodes):
            checked.add("recordings", "failed", f"{group.name}: {len(recordings)} recordings", name)
            fine = False
            continue
        for episode, data in zip(group.episodes, recordings, strict=True):
            if data is None:
                missing += 1
                continue
            played += 1
            if fault := recording_fault(episode, data):
                checked.add("recordings", "failed", f"{group.name}, episode {episode.index}: {fault}", name)
                fine = False
    if missing:
        checked.add("recordings", "open", f"{missing} episodes have no recording here", name)
    elif fine:
        checked.add("recordings", "ok", f"{played} episodes", name)


def recording_fault(episode: contents.Episode, data: bytes) -> str | None:
    """The contradiction between a recording and the stated result of its episode; None if there is none."""
    try:
        recording = recording_of(data)
    except ProtocolError as error:
        return str(error)
    total = return_of(recording)
    if not same(total, episode.episode_return):
        return f"its rewards come to {total!r}, told is {episode.episode_return!r}"
    if recording.n != episode.length:
        return f"it has {recording.n} steps, told are {episode.length}"
    return None


def recording_of(data: bytes) -> Trajectory:
    """A published recording. Raises ProtocolError for other bytes, and for a recording of more than actions and
    rewards."""
    found = decode(data, contents.MAX_EPISODE_BYTES)
    if found.record != "actions":
        raise ProtocolError("it holds more than actions and rewards")
    return found


def return_of(recording: Trajectory) -> float:
    """The sum of the rewards in the order of the steps, as an episode's return is made."""
    total = 0.0
    for reward in recording.rewards:
        total += float(reward)
    return total


def _checkpoints(files: Files, run: PublishedRun, damaged: set[str], checked: Checked) -> None:
    name, withheld, there, fine = run.opening.run, 0, 0, True
    for submit in run.result.submits:
        if submit.bundle is None:
            continue
        path = f"{run.folder}/{contents.checkpoint_path(submit.submit_index)}"
        if path not in files.names or path in damaged:
            withheld += 1
            continue
        try:
            bundles.load(files.read(path, contents.MAX_DOCUMENT_BYTES * 2), submit.bundle)
            there += 1
        except (BundleError, ProtocolError) as error:
            text = f"submit {submit.submit_index}: another policy than the one that was submitted: {error}"
            checked.add("checkpoints", "failed", text, name)
            fine = False
    if withheld:
        checked.add("checkpoints", "open", f"{withheld} policies were withheld", name)
    elif fine:
        checked.add("checkpoints", "ok", f"{there} policies", name)


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 80 else f"{text[:77]}…"
