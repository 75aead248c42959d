"""The rules of `evopolicy check` for one run: its documents against the journal, against each other, and against its
recordings."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import zip_longest

import msgspec

from evopolicy_common.catalogue import worlds
from evopolicy_common.errors import ProtocolError
from evopolicy_common.messages.episode import RANDOM
from evopolicy_common.messages.operator import RunFinished, RunResult
from evopolicy_common.messages.run_settings import Line
from evopolicy_common.records import account, journal
from evopolicy_common.records.aggregates import best_validated, mean
from evopolicy_common.records.code_metrics import code_metrics
from evopolicy_common.records.episodes.compare import same
from evopolicy_common.records.episodes.trajectory import Trajectory, decode
from evopolicy_common.records.journal import Ended, Opened, Opening, Revealed
from evopolicy_common.records.policies.bundles import Bundle
from evopolicy_common.records.run_record import decode_run_record, inputs_digest
from evopolicy_common.records.splits import SPLITS, cases_hash, overlaps
from evopolicy_common.terminal import counted
from evopolicy_results.publish import contents, fields
from evopolicy_results.publish.contents import EpisodeGroup
from evopolicy_results.publish.findings import (
    KINDS,
    UPDATE,
    FileSet,
    Findings,
    Flaw,
    History,
    PublishedRun,
    decoded,
)
from evopolicy_results.verify.numbers import MISSING, as_json, short, unlike_documents

_SHOWN = 8
"""Signals of a run that become findings."""
_BY_SUBMIT = "code_metrics_by_submit"
_PARSED = "classes functions imports import_count cyclomatic_total cyclomatic_max parse_errors"
"""Metrics of code that rest on Python's parser."""
_DOCUMENTS = (contents.OPENING, contents.RESULT, contents.EPISODES, contents.RUN)


def read_run(files: FileSet, folder: str, checked: Findings) -> PublishedRun | None:
    place = {name: f"{folder}/{name}" for name in (*_DOCUMENTS, contents.SALT)}
    try:
        data = {name: files.read_file(path, contents.MAX_DOCUMENT_BYTES) for name, path in place.items()}
        written = {name: fields.parsed(place[name], data[name]) for name in _DOCUMENTS}
        salt = data[contents.SALT].decode("ascii", "replace")
        run = PublishedRun(
            folder=folder,
            record=decode_run_record(data[contents.RUN]),
            opening=decoded(place[contents.OPENING], data[contents.OPENING], Opening),
            salt=bytes.fromhex(salt),
            result=decoded(place[contents.RESULT], data[contents.RESULT], RunResult),
            groups=decoded(place[contents.EPISODES], data[contents.EPISODES], tuple[EpisodeGroup, ...]),
            opening_bytes=data[contents.OPENING],
            result_bytes=data[contents.RESULT],
            as_written=written[contents.RUN],
        )
        if salt != run.salt.hex():
            raise ProtocolError("its salt is not written as the software writes it")
    except (ProtocolError, ValueError) as error:
        checked.add("format", "failed", f"{folder}: {error}", folder)
        return None
    for name in (contents.EPISODES, contents.RUN):
        checked.refuse_unknown(place[name], written[name], run.opening.run, bool(run.result.record))
    return run


def check_run(
    files: FileSet, run: PublishedRun, history: History, damaged: set[str], checked: Findings
) -> None:
    name = run.opening.run
    for kind, rule in _RULES.items():
        faults = [each if isinstance(each, Flaw) else Flaw(kind, each) for each in rule(run, history)]
        for fault in faults:
            checked.add(fault.kind, "failed", fault.text, name)
        if not faults:
            checked.add(kind, "ok", KINDS[kind], name)
    _recordings(files, run, damaged, checked)
    _checkpoints(files, run, damaged, checked)
    if f"{run.folder}/{contents.LOG}" in files.names:
        checked.add("logs", "open", "the log is its publisher's: nothing fixed it when the run ended", name)
    if text := _chosen_world(run):
        checked.add("worlds", "open", text, name)
    checked.add(
        "claims", "open", f"its publisher's word, fixed when it ended: {', '.join(fields.TOLD)}", name
    )
    text = "a recording shows what was played, not who decided it: actions could have been computed elsewhere"
    checked.add("policies", "open", text, name)


def check_starts(checked: Findings) -> None:
    """Adds a finding for each run: whether it starts from another one, and under no weaker conditions than that one."""
    by_name = {run.opening.run: run.record for run in checked.runs}
    for run in checked.runs:
        start, name = run.opening.settings.start, run.opening.run
        if start is None:
            checked.add("starts", "ok", KINDS["starts"], name)
            continue
        text = f"it starts from {start.text}: that run's work and budget are in its policies and its score"
        checked.add("starts", "open", text, name)
        if (parent := by_name.get(start.run)) is None:
            continue
        if parent.trees.get(str(start.submit_index), start.tree) != start.tree:
            text = f"its start has another workspace than {start.text}"
            checked.add("commitment", "failed", text, name)
        least = start.line.weakest(parent.line)
        for condition in Line.__struct_fields__:
            told, fixed = getattr(start.line, condition), getattr(least, condition)
            if told not in ("unknown", fixed):
                text = f"its start records {condition} {told!r} of the runs before; run {start.run} had {fixed!r}"
                checked.add("commitment", "failed", text, name)


def _commitment(run: PublishedRun, history: History) -> Iterator[str | Flaw]:
    opening, settings, place = run.opening, run.opening.settings, run.record.committed
    numbered = history.entry(Opened, opening.run)
    if numbered is None:
        yield Flaw("journal", "the journal has no entry of this run")
        return
    number, entry = numbered
    if len(run.salt) != journal.SALT_BYTES:
        yield f"its salt has {len(run.salt)} bytes instead of {journal.SALT_BYTES}"
    if journal.commitment(run.salt, run.opening_bytes) != entry.commitment:
        yield "splits or settings are not those that were committed to"
    names = ("entry", "model", "env", "exp_id", "repeat", "attempt", "start")
    if entry.epoch != opening.epoch or any(getattr(entry, name) != getattr(settings, name) for name in names):
        yield "the journal opened it for another entry, environment, experiment, epoch or start"
    if entry.start is not None:
        before = history.entry(Opened, entry.start.run)
        if before is None:
            yield Flaw("journal", f"it starts from run {entry.start.run}, of which the journal has no entry")
        elif before[0] >= number:
            yield Flaw("journal", f"it starts from run {entry.start.run}, which was not opened before it")
    fixed = (entry.commitment, number, history.heads[number], entry.epoch)
    if place is None or (place.commitment, place.opened, place.opened_head, place.epoch) != fixed:
        yield Flaw("record", "run.json has another commitment or head of the journal than the journal has")
    if of := settings.replay_of or entry.replay_of:
        yield f"it is a replay of run {of}, and no run of its own"
    if repeated := overlaps({split: run.cases(split) for split in SPLITS}):
        yield f"its splits are not disjoint: {repeated[0]}"


def _disclosure(run: PublishedRun, history: History) -> Iterator[str]:
    epoch = run.opening.epoch
    if not any(isinstance(entry, Revealed) and entry.epoch == epoch for entry in history.entries):
        yield f"epoch {epoch} was not revealed: its cases may still be played as secret ones"


def _result(run: PublishedRun, history: History) -> Iterator[str | Flaw]:
    numbered, place = history.entry(Ended, run.opening.run), run.record.committed
    if numbered is None:
        yield "the journal has no end of this run"
        return
    number, entry = numbered
    if journal.digest(run.result_bytes) != entry.result or run.result.run != run.opening.run:
        yield "result.json is not the result that the journal fixed when the run ended"
    if run.result.status != entry.status:
        yield f"it ended as {entry.status}, not as {run.result.status}"
    if place is None or (place.ended, place.ended_head) != (number, history.heads[number]):
        yield Flaw("record", "run.json has another end of the run than the journal has")


def _record(run: PublishedRun, history: History) -> Iterator[str | Flaw]:
    """`run.json`, compared with what `account.run_record` makes of the committed documents and of its claims."""
    record, opening, result, place = run.record, run.opening, run.result, run.record.committed
    if place is None:
        return  # `_commitment` reports it
    try:
        claims = account.claims_in(record)
        if result.record:
            told = msgspec.convert(result.record, account.Told)
            claims = msgspec.structs.replace(claims, **msgspec.structs.asdict(told))
    except msgspec.ValidationError as error:
        yield f"run.json or result.json tells claims in another form than the software: {error}"
        return
    began, over = history.entry(Opened, opening.run), history.entry(Ended, opening.run)
    fixed = {name: getattr(result, name) for name in RunResult.__struct_fields__}
    fixed["split_hashes"] = result.split_hashes | {split: cases_hash(run.cases(split)) for split in SPLITS}
    finished = RunFinished(
        **fixed,
        settings=opening.settings,
        error=None,
        agent={},
        # No more than make a difference: the number is the file's.
        fingerprint_overrides=("left out",)
        * min(result.n_overrides, 1 + len(record.versions.fingerprint_overrides)),
        budget=opening.budget,
        min_episodes_per_submit=opening.min_episodes_per_submit,
        max_episodes_per_submit=opening.max_episodes_per_submit,
        n_train=len(opening.train),
        n_validation=len(opening.validation),
        n_heldout=len(opening.heldout),
        cases_secret=opening.cases_secret,
        created_at=0.0 if began is None else began[1].at,
        finished_at=0.0 if over is None else over[1].at,
        committed=place,
    )
    for name, here, wanted in unlike_documents(run.as_written, as_json(account.run_record(finished, claims))):
        if wanted is MISSING:
            yield Flaw("format", f"run.json: {name[:120]} is no field of published results: {UPDATE}")
        else:
            yield f"run.json has {name} {short(here)}; the committed documents give {short(wanted)}"
    told_inputs = inputs_digest(record.agent.inputs)
    if told_inputs != opening.settings.inputs:
        yield f"run.json has agent.inputs {short(told_inputs)}; committed to was {short(opening.settings.inputs)}"


def _budget(run: PublishedRun, history: History) -> Iterator[str]:
    opening, result = run.opening, run.result
    indexes = [submit.submit_index for submit in result.submits]
    if indexes != sorted(set(indexes)):
        yield "its submits are not in order"
    used = 0
    for submit in result.submits:
        n = len(submit.env_instances)
        used += n
        if not opening.min_episodes_per_submit <= n <= opening.max_episodes_per_submit:
            yield f"submit {submit.submit_index} has {n} episodes, which the settings do not allow"
        if any(not 0 <= case < len(opening.train) for case in submit.env_instances):
            yield f"submit {submit.submit_index} plays a case that is not one of train"
    if used != result.budget_used or used > opening.budget:
        told, granted = result.budget_used, opening.budget
        yield f"its submits take {used} episodes, {told} are recorded, {granted} were granted"


def _selection(run: PublishedRun, history: History) -> Iterator[str]:
    result = run.result
    eligible = {
        submit.submit_index: submit.val_mean
        for submit in result.submits
        if submit.status == "ok" and submit.val_mean is not None
    }
    if result.status not in ("completed", "no_ok_submit"):
        return
    wanted = best_validated(eligible, run.opening.settings.profile)
    if result.best_submit_index != wanted:
        yield f"submit {result.best_submit_index} is recorded as selected, submit {wanted} has the best validation mean"
    ineligible = [one.submit_index for one in result.submits if one.status == "ok" and one.val_mean is None]
    if ineligible != sorted(result.validation_ineligible):
        told = list(result.validation_ineligible)
        yield f"submits {ineligible} have no validation mean, {told} are recorded as ineligible"
    elif ineligible and run.opening.settings.failed_episodes != "end-submit":
        yield f"submits {ineligible} are recorded as ineligible, which the settings do not allow"


def _scores(run: PublishedRun, history: History) -> Iterator[str]:
    result, opening = run.result, run.opening
    groups = {group.name: group for group in run.groups}
    if len(groups) != len(run.groups):
        yield "a list of episodes occurs twice"
    wanted_groups = {
        contents.group_name(split, index): (split, index, n)
        for split, index, n in contents.wanted_groups(result)
    }
    if odd := [name for name in groups if name not in wanted_groups]:
        yield f"the result has no episodes of {odd[0]}"
    submits = {submit.submit_index: submit for submit in result.submits}
    for name, (split, index, n) in wanted_groups.items():
        group = groups.get(name)
        if group is None:
            yield f"the episodes of {name} are not there"
            continue
        wanted = len(opening.validation) if n < 0 else n
        if [episode.index for episode in group.episodes] != list(range(wanted)):
            yield f"{name} has {len(group.episodes)} episodes, or out of order, instead of {wanted}"
            continue
        returns = tuple(episode.episode_return for episode in group.episodes)
        if split == "heldout":
            recorded = result.random_heldout_returns if index == RANDOM else result.heldout_returns
            if returns != recorded:
                yield f"the returns of {name} are not those of the result"
        else:
            submit = submits[index]
            told = submit.mean_return if split == "train" else submit.val_mean
            if returns and mean(returns) != told:
                yield f"the returns of {name} have the mean {mean(returns)!r}, not {told!r}"
    if (best := result.best_submit_index) is not None:
        for split in ("validation", "heldout"):
            group = groups.get(contents.group_name(split, best))
            failed = sum(episode.failure != "" for episode in group.episodes) if group else 0
            if group and failed != result.policy_failures.get(split, 0):
                yield f"{group.name} has {failed} failures of the policy, which the result does not count"
    if result.status == "completed":
        n_heldout = len(result.heldout_returns)
        if n_heldout != len(opening.heldout) or result.final_score != mean(result.heldout_returns):
            yield "the score is not the mean return of all held-out cases"


def _worlds(run: PublishedRun, history: History) -> Iterator[str]:
    """The rules of a world have a candidate that `accept-worlds` tries, and the n-th world at least the n-th."""
    env, opening = run.opening.settings.env, run.opening
    if worlds.unchanged(env) == env:
        return
    keys = {str((case.options or {}).get(worlds.OPTION, "")) for split in SPLITS for case in run.cases(split)}
    key = min(keys, default="")
    if len(keys) > 1 or not worlds.KEY.fullmatch(key):
        yield f"the cases of {env} have other keys of a world"
    elif (number := worlds.candidate(key)) is not None:
        least = worlds.ids(worlds.unchanged(env)).index(env)
        most = worlds.CANDIDATES - 1 if opening.trials else least
        if not least <= number <= most:
            how = "its trials allow" if opening.trials else "without trials it has"
            yield f"{env} has candidate {number}; {how} {least}" + (f" to {most}" if most > least else "")


def _chosen_world(run: PublishedRun) -> str:
    """The parts of a run's world that nobody can check; empty for no world."""
    env, opening = run.opening.settings.env, run.opening
    if worlds.unchanged(env) == env:
        return ""
    number = (
        worlds.candidate(str((opening.train[0].options or {}).get(worlds.OPTION, "")))
        if opening.train
        else None
    )
    if number is None:
        return f"{env} has rules of its publisher's choice, from case files"
    how = (
        f"its publisher's trials chose it (SHA-256 {opening.trials})"
        if opening.trials
        else "it was not tried"
    )
    return f"{env} has candidate {number} of {worlds.CANDIDATES}: {how}"


_RULES: dict[str, Callable[[PublishedRun, History], Iterator[str | Flaw]]] = {
    "commitment": _commitment,
    "disclosure": _disclosure,
    "result": _result,
    "record": _record,
    "budget": _budget,
    "selection": _selection,
    "scores": _scores,
    "worlds": _worlds,
}
"""By the kind of their findings; a `Flaw` is of another kind."""


def _recordings(files: FileSet, run: PublishedRun, damaged: set[str], checked: Findings) -> None:
    lists = f"{run.folder}/actions/"
    recorded: dict[str, tuple[int, int]] = {}
    checked.recorded[run.opening.run] = recorded
    paths = {each for each in files.names if each.startswith(lists)}
    odd = sorted(paths - {lists + group.name for group in run.groups})
    faults = [f"{path} is of no list of episodes" for path in odd]
    paths -= damaged
    for number, group in enumerate(run.groups):
        # The result has the returns of held-out episodes.
        claimed = ["length"] if group.split == "heldout" else ["length", "episode_return"]
        recordings: list[bytes | None] = []
        if lists + group.name in paths:
            try:
                recordings = run.recordings(files, group.name)
                if len(recordings) != len(group.episodes):
                    faults.append(f"{group.name}: {len(recordings)} recordings")
                    recordings = []
            except ProtocolError as error:
                faults.append(f"{group.name}: {error}")
        n, of = recorded.get(group.part, (0, 0))
        recorded[group.part] = n + sum(each is not None for each in recordings), of + len(group.episodes)
        for position, (episode, data) in enumerate(zip_longest(group.episodes, recordings)):
            if data is None:
                place = f"{number}.episodes.{position}"
                checked.claim(f"{run.folder}/{contents.EPISODES}", (f"{place}.{field}" for field in claimed))
            elif fault := recording_fault(episode, data):
                faults.append(f"{group.name}, episode {episode.index}: {fault}")
    open_text = ""
    if missing := checked.unrecorded(run.opening.run):
        open_text = f"only {', '.join(missing)} episodes have a recording"
        open_text += ": the other returns rest on the publisher's word"
    episodes = counted(sum(n for n, _ in recorded.values()), "episode")
    checked.conclude("recordings", faults, episodes, run.opening.run, open_text)


def recording_fault(episode: contents.PublishedEpisode, data: bytes) -> str | None:
    """The contradiction between a recording and the stated result of its episode; None if there is none."""
    try:
        recording = recording_of(data)
    except ProtocolError as error:
        return str(error)
    total = return_of(recording)
    if not same(total, episode.episode_return):
        return f"its rewards sum to {total!r}, its return is {episode.episode_return!r}"
    if recording.n != episode.length:
        return f"it has {recording.n} steps, its length is {episode.length}"
    return None


def recording_of(data: bytes) -> Trajectory:
    """A published recording. Raises ProtocolError for other bytes, and for a recording of more than actions and
    rewards."""
    recording = decode(data, contents.MAX_EPISODE_BYTES)
    if recording.record != "actions":
        raise ProtocolError("it holds more than actions and rewards")
    return recording


def return_of(recording: Trajectory) -> float:
    """The sum of the rewards in the order of the steps, as an episode's return is made."""
    total = 0.0
    for reward in recording.rewards:
        total += float(reward)
    return total


def _checkpoints(files: FileSet, run: PublishedRun, damaged: set[str], checked: Findings) -> None:
    folder = f"{run.folder}/"
    places = {folder + contents.checkpoint_path(one.submit_index) for one in run.result.submits if one.bundle}
    odd = sorted(path for path in files.names - places if path.startswith(f"{folder}checkpoints/"))
    faults = [f"{path} is the policy of no submit" for path in odd]
    policies: dict[int, Bundle] = {}
    withheld = 0
    for index, policy in run.policies(files, damaged):
        if isinstance(policy, Bundle):
            policies[index] = policy
        elif policy:
            faults.append(f"submit {index}: another policy than the one that was submitted: {policy}")
        else:
            withheld += 1
    text = f"{withheld} policies were withheld" if withheld else ""
    checked.conclude("checkpoints", faults, f"{len(policies)} policies", run.opening.run, text)
    for fault in _metrics(run, policies, checked):
        checked.add("record", "failed", fault, run.opening.run)


def _metrics(run: PublishedRun, policies: dict[int, Bundle], checked: Findings) -> Iterator[str]:
    """The metrics of code in `run.json`, compared with the policies."""
    by_submit = run.record.outcome.auxiliary.get(_BY_SUBMIT, {})
    file = f"{run.folder}/{contents.RUN}"
    wanted = [str(submit.submit_index) for submit in run.result.submits]
    try:
        pairs: list[tuple[str, object, object]] = [(_BY_SUBMIT, list(by_submit), wanted)]
        for index, here in by_submit.items():
            where = f"outcome.auxiliary.{_BY_SUBMIT}.{index}"
            if (policy := policies.get(int(index))) is None:
                checked.claim(file, [f"{where}.**"])
                continue
            own = msgspec.to_builtins(code_metrics({file.path: file.data for file in policy.files}))
            # Versions of Python differ in what they can parse.
            parsed = () if own["parse_errors"] == tuple(here["parse_errors"]) else _PARSED.split()
            checked.claim(file, [f"{where}.{name}" for name in parsed])
            pairs += [(where, here.get(name), value) for name, value in own.items() if name not in parsed]
            pairs.append((where, sorted(here), sorted(own)))
    except (AttributeError, KeyError, TypeError, ValueError):
        yield "run.json has metrics of code in another form than the software"
        return
    for name, here, fixed in pairs:
        if contents.document(here) != contents.document(fixed):
            yield f"run.json has {name} {short(here)}; the policies give {short(fixed)}"
