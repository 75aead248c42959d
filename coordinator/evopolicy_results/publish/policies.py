"""Plays published policies again that declare themselves deterministic, and compares their actions with the recorded
ones.

Rules that this module owns:
- A policy is untrusted code: it runs in the worker's sandbox, with default limits, like any agent's.
- Policies receive the published arguments (`env_meta`, episode indexes) and other random seeds than in the run, which
  are secret. Only policies that declare `deterministic = True` are played.
- A policy that fails here, or failed in the run, shows nothing: limits and machines differ.
- The packages that a run's policies import are those that its `run.json` names, and only if the operator names them
  too: names in the file alone make nothing of this machine visible or imported.
"""

from __future__ import annotations

import shlex
import uuid
from collections.abc import Collection, Sequence

import msgspec
import numpy as np

from evopolicy_common.messages.episode import EpisodeOutcome
from evopolicy_common.messages.operator import Evaluate, PlayedAs
from evopolicy_common.processes.packages import packages_in
from evopolicy_common.records.episodes import compare
from evopolicy_common.records.episodes.trajectory import Trajectory
from evopolicy_common.records.journal import SubmitResult
from evopolicy_common.records.policies.bundles import Bundle
from evopolicy_common.records.policies.declarations import declares_deterministic
from evopolicy_results.evaluations import Evaluations
from evopolicy_results.publish.findings import Checked, Files, PublishedRun
from evopolicy_results.publish.replay import Chosen, Tell, draw, installed, play_runs
from evopolicy_results.publish.run_rules import recording_of

_KIND = "policies"


class _Tally(msgspec.Struct):
    """The result of replaying one run's policies."""

    same: int = 0
    differ: list[str] = []
    unknown: int = 0
    """Episodes that show nothing: failures, and recordings that were withheld."""


async def play_policies(
    files: Files,
    checked: Checked,
    share: float,
    seed: int,
    slots: int,
    tell: Tell,
    packages: Collection[str] = (),
) -> None:
    """Plays a share of the episodes of deterministic policies, drawn by `seed`, and adds the findings to `checked`.

    `packages`: those that policies may import besides numpy, where their run names it."""
    checked.findings = [each for each in checked.findings if each.kind != _KIND]
    declared: dict[tuple[str, int], Bundle] = {}
    for run in checked.runs:
        found = {
            index: bundle
            for index, bundle in run.bundles(files)
            if declares_deterministic({file.path: file.data for file in bundle.files})
        }
        declared |= {(run.folder, index): bundle for index, bundle in found.items()}
        others = sum(submit.bundle is not None for submit in run.result.submits) - len(found)
        if others:
            text = f"{others} policies do not declare themselves deterministic, or were withheld: not played"
            checked.add(_KIND, "open", text, run.opening.run)
    chosen = [_whole(each) for each in draw(checked.runs, share, seed) if _key(each) in declared]
    drawn = {each.run.folder for each in chosen}
    for run in checked.runs:
        if run.folder not in drawn and any(folder == run.folder for folder, _ in declared):
            checked.add(_KIND, "open", "no episode of its deterministic policies was drawn", run.opening.run)
    by_run = installed(chosen, checked, _KIND)
    for folder, (part, *_) in list(by_run.items()):
        if lacking := [name for name in _packages_of(part.run) if name not in packages]:
            checked.add(_KIND, "open", f"not played: {not_allowed(lacking)}", part.run.opening.run)
            del by_run[folder]

    async def play_run(
        evaluations: Evaluations, run: PublishedRun, parts: Sequence[Chosen], other_cpu: bool
    ) -> None:
        tally = _Tally()
        for part in parts:
            await _play(evaluations, files, part, declared[_key(part)], tally)
        _add_findings(tally, checked, run.opening.run, other_cpu)

    await play_runs(_KIND, by_run, checked, slots, tell, play_run, _packages_of)


def _packages_of(run: PublishedRun) -> tuple[str, ...]:
    return packages_in(run.record.versions.fingerprint)


def not_allowed(packages: Sequence[str]) -> str:
    """Says which packages policies import without being allowed to, with the options that allow them."""
    # The names are the publisher's, and the options are made to be copied into a shell.
    options = " ".join(f"--policy-package {shlex.quote(name)}" for name in packages)
    return f"its policies import packages that this command does not allow; allow them with {options}"


def _key(each: Chosen) -> tuple[str, int]:
    return each.run.folder, each.group.submit_index


def _whole(each: Chosen) -> Chosen:
    """With policy scope `submit` one policy plays the whole list, of which no part can be played alone."""
    if each.run.opening.settings.policy_scope != "submit":
        return each
    n = len(each.group.episodes)
    submit = _submit(each)
    ids = submit.env_instances if each.group.split == "train" else tuple(range(n))
    return Chosen(each.run, each.group, tuple(range(n)), tuple(ids))


def _submit(each: Chosen) -> SubmitResult:
    return next(one for one in each.run.result.submits if one.submit_index == each.group.submit_index)


def _add_findings(tally: _Tally, checked: Checked, name: str, other_cpu: bool) -> None:
    for text in tally.differ:
        if other_cpu:
            text += "; this machine's processor has other features than the run's, which can change numbers"
        checked.add(_KIND, "open" if other_cpu else "failed", text, name)
    if tally.unknown:
        text = f"{tally.unknown} episodes show nothing: their policy failed here or in the run, or they have no recording"  # noqa: E501
        checked.add(_KIND, "open", text, name)
    if tally.same and not tally.differ:
        text = f"{tally.same} episodes of policies that declare themselves deterministic: the same actions"
        checked.add(_KIND, "ok", text, name)


async def _play(evaluations: Evaluations, files: Files, part: Chosen, bundle: Bundle, tally: _Tally) -> None:
    run, group, submit = part.run, part.group, _submit(part)
    recordings = run.recordings(files, group.name)
    if not recordings:
        tally.unknown += len(part.indexes)
        return
    settings = run.opening.settings
    ids = submit.env_instances if group.split == "train" else tuple(range(len(group.episodes)))
    used = sum(
        len(one.env_instances) for one in run.result.submits if one.submit_index <= submit.submit_index
    )
    await evaluations.ask.upload(bundle.digest, bundle.packed)
    message = Evaluate(
        token="",
        key=uuid.uuid4().hex,
        env=settings.env,
        bundle=bundle.digest,
        split=group.split,
        cases=part.case_ids,
        # As in the run: train recordings have the actions that the policy returned, hidden ones those that were played.
        record="full" if group.split == "train" else "actions",
        step_limit=settings.step_limit,
        as_in=PlayedAs(
            run="",
            submit_index=submit.submit_index,
            env_instances=ids,
            indexes=part.indexes,
            modulo=len(submit.env_instances),
            remaining_budget_after=run.opening.budget - used,
            policy_scope=settings.policy_scope,
            observations=settings.observations,
            failed_episodes=settings.failed_episodes,
            hidden_evaluation=settings.hidden_evaluation,
        ),
    )
    seen: set[int] = set()
    async for outcome in evaluations.outcomes(message):
        index = part.indexes[outcome.index]
        seen.add(index)
        data = recordings[index] if index < len(recordings) else None
        if data is None or group.episodes[index].failure or outcome.failure is not None:
            tally.unknown += 1
            continue
        fault = await _difference(evaluations, recording_of(data), outcome)
        if fault is None:
            tally.same += 1
        else:
            text = "the policy declares itself deterministic and gave other actions"
            tally.differ.append(f"{group.name}, episode {index}: {text}: {fault}")
    tally.unknown += len(set(part.indexes) - seen)


async def _difference(evaluations: Evaluations, recorded: Trajectory, outcome: EpisodeOutcome) -> str | None:
    if outcome.trajectory is None:
        return "no recording came"
    again = await evaluations.recording(outcome)
    for step in range(min(recorded.n, again.n)):
        if not compare.same(_plain(recorded.actions[step]), _plain(again.actions[step])):
            return f"at step {step}"
    return None if recorded.n == again.n else f"{recorded.n} and {again.n} steps"


def _plain(action: object) -> object:
    """An action with its numbers as arrays, the form in which publication may have put them."""
    if isinstance(action, dict):
        return {name: _plain(value) for name, value in action.items()}
    if isinstance(action, list | tuple):
        return [_plain(value) for value in action]
    return np.asarray(action) if isinstance(action, np.generic | bool | int | float) else action
