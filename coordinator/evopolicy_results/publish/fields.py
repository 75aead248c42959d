"""The fields of published files, each with what covers it. Pure.

Rules that this module owns:
- Files are JSON in one spelling: a key that occurs twice, another order or other spaces are refused.
- A file or field that the table does not name is refused: no check would look at it.
- A field of `run.json` that the gateway tells at the run's end is a claim where the gateway closed no run.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any, Literal

import msgspec

from evopolicy_common.catalogue.installs import Licence
from evopolicy_common.errors import DECODE_ERRORS, ProtocolError, raised_as
from evopolicy_results.publish import contents

Cover = Literal["derived", "committed", "told", "removed", "replayed", "claim"]
"""`derived`: compared with what follows from other files. `committed`: a journal entry holds a digest of it. `told`:
compared with the gateway's word in the result. `removed`: empty in every publication. `replayed`: compared by
`--replay`. `claim`: the publisher's word, which nobody can check."""


def _all(path: str, kind: type[msgspec.Struct]) -> str:
    return " ".join(f"{path}.{field}" for field in kind.__struct_fields__)


_GATEWAY = """
    jail agent.harness agent.cli_version agent.model_string agent.retries agent.turns agent.tokens agent.model_use
    agent.resources agent.settings versions.agents_md_hash versions.rules_hash versions.initial_policy_hash
"""
_COORDINATOR = """
    env_title env_family hidden_isolation outcome.closed_reason outcome.heldout_successes outcome.quarantined_submits
    timing.queue_s timing.rollout_s timing.finalise_s
    versions.env versions.env_deterministic versions.fingerprint versions.fingerprint_overrides versions.installations
    versions.data_train_hash versions.data_valid_hash versions.data_heldout_hash
"""
TOLD = (*_COORDINATOR.split(), *_GATEWAY.split(), "submits.status")
"""Fields of `run.json`, and of `result.json` the last, that only the publisher's programs state. A journal entry fixes
them when the run ends."""
_RUN: dict[Cover, str] = {
    "derived": "**",
    "told": " ".join(f"{path} {path}.**" for path in _GATEWAY.split()),
    "removed": "outcome.error rejected_submits.*.message artifacts.* replays.**",
    "claim": """
        timing.agent_s timing.feedback_s timing.held_s timing.permit_s outcome.auxiliary.transitions.steps
        outcome.auxiliary.transitions.action_invalid rejected_submits.*.status rejected_submits.*.at
        rejected_submits.*.after_submits versions.harness
    """,
}
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
    with raised_as(ProtocolError, f"{name} is damaged", *DECODE_ERRORS, ValueError):
        value = msgspec.json.decode(data)
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


def leaves(value: object, path: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], object]]:
    """The paths of all numbers, texts, truth values and nulls in JSON."""
    if isinstance(value, dict | list):
        items = value.items() if isinstance(value, dict) else enumerate(value)
        for key, inner in items:
            yield from leaves(inner, (*path, str(key)))
    else:
        yield path, value


def unknown_and_claims(name: str, value: object, told: bool = False) -> tuple[list[str], list[str]]:
    """The fields that the table does not name or that publication empties, and those that are claims.

    `told`: the run's result has the gateway's word."""
    tree = _TREES[file_kind(name) or ""]
    unknown: dict[str, None] = {}
    claims: dict[str, None] = {}
    for path, leaf in leaves(value):
        node, below = tree, dict[str, object]()
        for part in path:
            below = node.get("**", below)
            node = node.get(part) or node.get("*") or {}
        node = node if "" in node else node.get("**", below)
        if "" not in node:
            # A part that a run does not have is null as a whole.
            if leaf is not None or not node:
                unknown[".".join(path)] = None
            continue
        field, cover = node[""]
        if cover == "removed" and leaf not in (None, "", "left out"):
            unknown[".".join(path)] = None
        elif cover == "claim" or (cover == "told" and not told):
            claims[field] = None
    return list(unknown), list(claims)
