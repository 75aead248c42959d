"""The fields of published files, each with what covers it. Pure.

Rules that this module owns:
- Files are JSON in one spelling: a key that occurs twice, another order or other spaces are refused.
- A file or field that the table does not name is refused: no check would look at it.
- A field of `run.json` that the journal's entry should cover is a claim where it does not, as in results of earlier
  versions.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from typing import Any, Literal

import msgspec

from evopolicy_common.catalogue.installs import Licence
from evopolicy_common.errors import DECODE_ERRORS, ProtocolError
from evopolicy_common.messages.episode import ResourceLimits
from evopolicy_common.messages.operator import Committed
from evopolicy_common.messages.run_settings import Line, Start
from evopolicy_common.records.run_record import Tokens
from evopolicy_results.publish import contents

Cover = Literal["derived", "committed", "removed", "replayed", "claim"]
"""`derived`: compared with what follows from other files. `committed`: a journal entry holds a digest of it; in
`run.json` it is the publisher's word at the run's end (`TOLD`). `removed`: empty in every publication. `replayed`:
compared by `--replay`. `claim`: the publisher's word, which nobody can check."""


def _all(path: str, kind: type[msgspec.Struct]) -> str:
    return " ".join(f"{path}.{field}" for field in kind.__struct_fields__)


_RUN: dict[Cover, str] = {
    "derived": f"""
        schema_version record_version protocol_version model env exp_id repeat attempt run sandbox_tier
        agent.entry agent.prompts agent.inputs.*.kind agent.inputs.*.name agent.inputs.*.digest agent.inputs.*.hosts.*
        experiment_dimensions.episode_budget experiment_dimensions.min_episodes_per_submit
        experiment_dimensions.max_episodes_per_submit experiment_dimensions.policy_scope experiment_dimensions.observations
        experiment_dimensions.n_train experiment_dimensions.n_validation experiment_dimensions.n_heldout
        experiment_dimensions.video experiment_dimensions.simulation {_all("experiment_dimensions.limits", ResourceLimits)}
        experiment_dimensions.finish experiment_dimensions.step_limit experiment_dimensions.profile
        experiment_dimensions.feedback experiment_dimensions.agents_md experiment_dimensions.hidden_cases
        experiment_dimensions.failed_episodes experiment_dimensions.hidden_evaluation
        timing.start_time timing.end_time timing.wall_time_seconds
        outcome.status outcome.final_score outcome.best_submit_index outcome.val_scores.* outcome.heldout_mean_return
        outcome.heldout_std_return outcome.heldout_returns.* outcome.heldout_successes.* outcome.quarantined_submits.*
        outcome.random_reference.mean_return outcome.random_reference.std_return outcome.random_reference.returns.*
        outcome.budget_used outcome.auxiliary.policy_failures.* outcome.auxiliary.infrastructure_retries
        outcome.auxiliary.nondeterministic_results outcome.auxiliary.code_metrics_best.**
        outcome.auxiliary.code_metrics_by_submit.** outcome.auxiliary.code_metrics_trend.**
        versions.cases_hashes.* versions.data_secret {_all("committed", Committed)} {_all("start", Start)} {_all("start.line", Line)} trees.*
        replay_of
    """,  # noqa: E501
    "committed": f"""
        jail hidden_isolation env_title env_family agent.harness agent.cli_version agent.model_string agent.retries
        agent.turns {_all("agent.tokens", Tokens)} agent.model_use.** agent.resources.**
        agent.settings.wall_limit_s agent.settings.silence_limit_s agent.settings.effort
        timing.queue_s timing.rollout_s timing.finalise_s outcome.closed_reason outcome.random_reference.seeded_by
        versions.env versions.env_deterministic versions.fingerprint.* versions.fingerprint_overrides.*
        versions.installations.* versions.data_train_hash versions.data_valid_hash versions.data_heldout_hash
        versions.agents_md_hash versions.rules_hash versions.initial_policy_hash
    """,
    "removed": """
        outcome.error outcome.policy_failures.*.message rejected_submits.*.message artifacts.*
        replays.**
    """,
    "claim": """
        timing.agent_s timing.feedback_s timing.held_s timing.permit_s outcome.auxiliary.transitions.steps
        outcome.auxiliary.transitions.action_invalid
        outcome.policy_failures.*.split outcome.policy_failures.*.submit_index outcome.policy_failures.*.episode
        outcome.policy_failures.*.category outcome.policy_failures.*.step_index rejected_submits.*.status
        rejected_submits.*.at rejected_submits.*.after_submits versions.harness
    """,
}
TOLD = tuple(dict.fromkeys(".".join(name.split(".")[:2]) for name in _RUN["committed"].split()))
"""Fields of `run.json` that only the publisher's programs state. A journal entry fixes them when the run ends."""
FIELDS: dict[str, dict[Cover, str]] = {
    contents.MANIFEST: {
        "derived": "format version canary journal_entries journal_head files.*",
        "claim": "software",
    },
    contents.SIGNATURE: {"derived": "key signature"},
    contents.REMOVED: {"claim": "*.what *.why"},
    contents.JOURNAL: {"derived": "**"},
    contents.CARD: {"derived": "**", "claim": f"licence {_all('licences.*', Licence)} licences.*.used_by.*"},
    contents.CARD_TEXT: {"derived": ""},
    contents.CROISSANT: {"derived": "**"},
    f"runs/*/{contents.DIGESTS}": {"derived": "*"},
    f"runs/*/{contents.OPENING}": {"committed": "**"},
    f"runs/*/{contents.SALT}": {"committed": ""},
    f"runs/*/{contents.RESULT}": {"committed": "**"},
    f"runs/*/{contents.EPISODES}": {
        "derived": "*.split *.submit_index *.episodes.*.index *.episodes.*.episode_return *.episodes.*.length",
        "claim": "*.episodes.*.failure",
    },
    f"runs/*/{contents.RUN}": _RUN,
    "runs/*/actions/*": {"replayed": ""},
    "runs/*/checkpoints/*": {"committed": ""},
    f"runs/*/{contents.LOG}": {"claim": ""},
}
"""Fields by file and cover; `*` is any key, index or folder, `**` everything below. A file that is no JSON has one
field without a name. Where a recording or policy is withheld, what follows from it is a claim too. The journal is a
chain: what it says is fixed only up to a head that was noted elsewhere."""


def _tree(by_cover: dict[Cover, str]) -> dict[str, Any]:
    tree: dict[str, Any] = {}
    for cover, text in by_cover.items():
        for field in text.split() or ["**"]:
            node = tree
            for part in field.split("."):
                node = node.setdefault(part, {})
            node[""] = field, cover
    return tree


_TREES = {file: _tree(by_cover) for file, by_cover in FIELDS.items()}
_FILES = {file: re.compile(re.escape(file).replace(r"\*", "[^/]+")) for file in FIELDS}


def parsed(name: str, data: bytes) -> Any:
    """The content of a JSON file of published results. Raises ProtocolError where publication would have spelt it in
    another way."""
    try:
        value = msgspec.json.decode(data)
    except (*DECODE_ERRORS, ValueError) as error:
        raise ProtocolError(f"{name} is damaged: {error}") from error
    if name.endswith(f"/{contents.RUN}"):
        spelt = msgspec.json.format(msgspec.json.encode(value), indent=2) + b"\n"
    else:
        spelt = msgspec.json.encode(value, order="sorted")
        if not name.endswith((contents.OPENING, contents.RESULT, contents.JOURNAL)):
            spelt += b"\n"
    if spelt != data:
        raise ProtocolError(
            f"{name} is not written as the software writes it: a key occurs twice, or in another form"
        )
    return value


def file_kind(name: str) -> str | None:
    """The row of the table for a file; None for a file that publication does not write."""
    if name in FIELDS:
        return name
    return next((kind for kind in FIELDS if "*" in kind and _FILES[kind].fullmatch(name)), None)


def leaves(value: Any, path: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Any]]:
    """The paths of all numbers, texts, truth values and nulls in JSON."""
    if isinstance(value, dict | list):
        items = value.items() if isinstance(value, dict) else enumerate(value)
        for key, inner in items:
            yield from leaves(inner, (*path, str(key)))
    else:
        yield path, value


def unknown_and_claims(name: str, value: Any, committed: Mapping[str, Any]) -> tuple[list[str], list[str]]:
    """The fields that the table does not name or that publication empties, and those that are claims.

    `committed`: the fields of `run.json` that the run's result holds."""
    tree = _TREES[file_kind(name) or ""]
    unknown: dict[str, None] = {}
    claims: dict[str, None] = {}
    for path, leaf in leaves(value):
        node = tree
        for part in path:
            node = node.get(part) or node.get("*") or ({} if "**" not in node else {"**": node["**"]})
        node = node.get("**", node)
        if "" not in node:
            # A part that a run does not have is null as a whole.
            if leaf is not None or not node:
                unknown[".".join(path)] = None
            continue
        field, cover = node[""]
        if cover == "removed" and leaf not in (None, "", "left out"):
            unknown[".".join(path)] = None
        elif cover == "claim" or (
            cover == "committed"
            and name.endswith(f"/{contents.RUN}")
            and not any(".".join(path[:n]) in committed for n in range(1, len(path) + 1))
        ):
            claims[field] = None
    return list(unknown), list(claims)


def value_at(value: Any, path: str) -> Any:
    """A field of a JSON document by its path; None where it is missing."""
    for part in path.split("."):
        value = value.get(part) if isinstance(value, dict) else None
    return value
