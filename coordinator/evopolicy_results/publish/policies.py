"""Plays published policies again that declare themselves deterministic, and compares their actions with the recorded
ones.

Rules that this module owns:
- A policy is untrusted code: it runs in the worker's sandbox, with default limits, like any agent's.
- Policies receive the published arguments (`env_meta`, episode indexes) and other random seeds than in the run, which
  are secret. Only policies that declare `deterministic = True` are played.
- A policy that fails here, or failed in the run, shows nothing: limits and machines differ.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence

import msgspec
import numpy as np

from evopolicy_common.messages.episode import EpisodeOutcome
from evopolicy_common.records.episodes import compare
from evopolicy_common.records.episodes.trajectory import Trajectory
from evopolicy_common.records.policies.bundles import Bundle
from evopolicy_common.records.policies.declarations import declares_deterministic
from evopolicy_results.evaluations import Evaluations
from evopolicy_results.publish.findings import Checked, Files, PublishedRun
from evopolicy_results.publish.replay import Chosen, Tell, draw, play_runs
from evopolicy_results.publish.run_rules import recording_of

_KIND = "policies"


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
    chosen: list[Chosen] = []
    drawn = draw(checked.runs, share, seed)
    for run in checked.runs:
        found = {
            (run.folder, index): bundle
            for index, bundle in run.bundles(files)
            if declares_deterministic({file.path: file.data for file in bundle.files})
        }
        declared |= found
        others = sum(submit.bundle is not None for submit in run.result.submits) - len(found)
        if others:
            text = f"{others} policies do not declare themselves deterministic, or were withheld: not played"
            checked.add(_KIND, "open", text, run.opening.run)
        own = [each for each in drawn if (each.run.folder, each.group.submit_index) in found]
        if found and not own:
            text = "no episode of its deterministic policies was drawn"
            checked.add(_KIND, "open", text, run.opening.run)
        if run.opening.settings.policy_scope == "submit":
            # One policy plays the whole list, of which no part can be played alone.
            own = [
                msgspec.structs.replace(each, indexes=tuple(range(len(each.cases.env_instances))))
                for each in own
            ]
        chosen += own

    async def play_run(
        evaluations: Evaluations, run: PublishedRun, parts: Sequence[Chosen], other_cpu: bool
    ) -> None:
        same = unknown = 0
        differ: list[str] = []
        for part in parts:
            settings, group = run.opening.settings, part.group
            recordings = dict(enumerate(run.recordings(files, group.name)))
            if not recordings:
                unknown += len(part.indexes)
                continue
            async for index, outcome in evaluations.replayed(
                part.cases,
                part.indexes,
                env=settings.env,
                conditions=settings,
                bundle=declared[run.folder, group.submit_index],
                # As in the run: train recordings have the policy's actions, hidden ones those that were played.
                record="full" if group.split == "train" else "actions",
            ):
                data, failed = recordings.get(index), group.episodes[index].failure
                if data is None or failed or outcome is None or outcome.failure is not None:
                    unknown += 1
                elif (fault := await _difference(evaluations, recording_of(data), outcome)) is None:
                    same += 1
                else:
                    text = "the policy declares itself deterministic and gave other actions"
                    differ.append(f"{group.name}, episode {index}: {text}: {fault}")
        name = run.opening.run
        for text in differ:
            if other_cpu:
                text += (
                    "; this machine's processor has other features than the run's, which can change numbers"
                )
            checked.add(_KIND, "open" if other_cpu else "failed", text, name)
        if unknown:
            text = f"{unknown} episodes show nothing: their policy failed here or in the run, or they have no recording"
            checked.add(_KIND, "open", text, name)
        if same and not differ:
            text = f"{same} episodes of policies that declare themselves deterministic: the same actions"
            checked.add(_KIND, "ok", text, name)

    await play_runs(_KIND, chosen, checked, slots, tell, play_run, packages)


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
