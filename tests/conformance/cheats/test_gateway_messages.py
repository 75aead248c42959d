"""Every type of message that may reach a gateway, field by field: a field that is not listed here fails the test.

Who adds one says here, in words, that an agent may know it.

Attacks, each with its defence:
- searches its messages, memory, logs, and workspace for a hidden seed, case, or return: no message to a
  gateway has a field for one.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, get_args

import pytest
from msgspec import inspect

from evopolicy_common.messages.environment import Case
from evopolicy_common.messages.episode import EpisodeOutcome
from evopolicy_common.messages.gateway import EpisodeFeedback, GatewayReply, ResultsPage
from evopolicy_common.messages.worker import Message
from evopolicy_common.wire import codec

ALLOWED: dict[str, dict[str, str]] = {
    "RunOpened": {
        "env": "EnvironmentDescription",
        "n_env_instances": "int",
        "episode_budget": "int",
        "min_episodes_per_submit": "int",
        "max_episodes_per_submit": "int",
        "policy_scope": "'episode' | 'submit'",
        "observations": "'arrays' | 'lists'",
        "sandbox_tier": "'bwrap' | 'landlock' | 'none'",
        "video": "'all' | 'first' | 'off'",
        "limits": "ResourceLimits",
        "allowed_imports": "[str]",
        "denied_imports": "[str]",
        "state": "RunState",
        "simulation": "'allowed' | 'forbidden'",
        "finish": "'budget' | 'early'",
        "feedback": "'pictures' | 'scores' | 'trajectories'",
        "max_steps": "int",
        "profile": "'own' | 'published' | 'published-data'",
        "failed_episodes": "'end-submit' | 'play-on'",
        # How every run of the profile plays its hidden episodes, as the published software does: no result of them.
        "hidden_evaluation": "'pool' | 'submit'",
    },
    "EnvironmentDescription": {
        "env": "str",
        "env_version": "str",
        "obs_space": "{str: any}",
        "action_space": "{str: any}",
        "obs_storage": "'inline' | 'npy' | 'npz'",
        "max_episode_steps": "int",
        "reward_components": "[str]",
        "reward_texts": "{str: str}",
        "task_text": "str",
        "deterministic": "bool",
        "renders": "bool",
        "title": "str",
        "family": "str",
        "definition": "{str: any}",
        "reward_weights": "{str: float}",
        "success": "str",
        "success_at": "'any' | 'end'",
        "adapter": "str",
        "packages": "{str: str}",
        "step_us": "float",
        "info_left_out": "[str]",
    },
    "ResourceLimits": {
        "episode_wall_s": "float",
        "act_wall_s": "float",
        "init_wall_s": "float",
        "cpu_s": "float",
        "memory_bytes": "int",
        "processes": "int",
        "file_bytes": "int",
        "files": "int",
        "open_files": "int",
        "output_bytes": "int",
        "action_bytes": "int",
        "episode_action_bytes": "int",
        "feedback_bytes": "int",
        "submit_wall_s": "float | none",
    },
    "RunState": {
        "remaining_budget": "int",
        "n_submits": "int",
        "is_finalized": "bool",
        "in_flight": "SubmitInFlight | none",
        "held_s": "float",
        "cancelled": "bool",
    },
    "SubmitInFlight": {
        "submit_index": "int",
        "n_episodes": "int",
        "n_done": "int",
        "waits_for": "str",
        "held_s": "float",
    },
    "Permit": {"granted": "bool", "waits_for": "str"},
    "StateReply": {"state": "RunState"},
    "SubmitAccepted": {"submit_index": "int", "first_global_episode": "int", "remaining_budget": "int"},
    "ResultsPage": {
        "cursor": "int",
        "episodes": "[EpisodeFeedback]",
        "done": "SubmitDone | none",
        "waits_for": "str",
        "held_s": "float",
        # Of the run's own train episodes, as the cursor counts them.
        "more": "bool",
    },
    # Of train episodes only: the golden traffic test sees that no hidden one is ever told.
    "EpisodeFeedback": {
        "index": "int",
        "episode_return": "float",
        "length": "int",
        "failure": "PolicyFailure | none",
        "reward_components": "{str: float}",
        "trajectory": "BlobRef",
        "video": "BlobRef | none",
        "stdout": "bytes",
        "stderr": "bytes",
        "success": "bool | none",
    },
    "PolicyFailure": {
        "category": (
            "'act_error' | 'act_timeout' | 'cpu_limit' | 'denied_import' | 'episode_timeout' | 'file_limit'"
            " | 'import_error' | 'init_error' | 'killed' | 'missing_policy' | 'oom' | 'process_limit'"
            " | 'reset_error'"
        ),
        "step_index": "int | none",
        "message": "str",
        "traceback": "str",
        "limit": "float | none",
        "used": "float | none",
    },
    "BlobRef": {"digest": "str", "size": "int", "inline": "bytes | none"},
    "SubmitDone": {
        "status": (
            "'cancelled' | 'denied_import' | 'import_error' | 'init_error' | 'missing_policy' | 'ok'"
            " | 'rollout_timeout'"
        ),
        "n_episodes": "int",
        "env_instances": "[int]",
        "first_global_episode": "int",
        "remaining_budget": "int",
        "started_at": "float",
        "completed_at": "float",
        "failure": "PolicyFailure | none",
        "n_kept": "int",
    },
    "RunClosed": {},
    "BlobAck": {"have": "int"},
    "BlobChunk": {"size": "int", "data": "bytes"},
    "Refused": {"status": "enum", "message": "str"},
}
"""Type to field to what the field may hold."""


def described(kind: inspect.Type) -> str:
    """A field's type in short."""
    match kind:
        case inspect.UnionType(types=types):
            return " | ".join(described(one) for one in types)
        case inspect.Metadata(type=plain):
            return described(plain)
        case inspect.StructType(cls=cls):
            return cls.__name__
        case inspect.LiteralType(values=values):
            return " | ".join(repr(value) for value in sorted(values))
        case inspect.VarTupleType(item_type=item) | inspect.ListType(item_type=item):
            return f"[{described(item)}]"
        case inspect.DictType(key_type=key, value_type=value):
            return f"{{{described(key)}: {described(value)}}}"
        case _:
            return type(kind).__name__.removesuffix("Type").lower()


def structs_in(kind: inspect.Type) -> Iterator[inspect.StructType]:
    """Every struct that a value of that type may hold, the type itself first; one that holds itself only once."""
    seen: set[type] = set()

    def walk(one: object) -> Iterator[inspect.StructType]:
        if isinstance(one, inspect.StructType):
            if one.cls in seen:
                return
            seen.add(one.cls)
            yield one
            for field in one.fields:
                yield from walk(field.type)
        elif isinstance(one, inspect.Type):
            for part in one.__struct_fields__:
                held = getattr(one, part)
                for inner in held if isinstance(held, tuple | list) else (held,):
                    yield from walk(inner)

    yield from walk(kind)


def fields_in(kind: Any) -> dict[str, dict[str, str]]:
    """Type to field to what it may hold, of everything that may be in a value of that type."""
    return {
        struct.cls.__name__: {field.name: described(field.type) for field in struct.fields}
        for struct in structs_in(inspect.type_info(kind))
    }


def test_no_message_to_a_gateway_has_a_field_that_is_not_allowed() -> None:
    assert fields_in(GatewayReply) == ALLOWED


def test_what_a_gateway_decodes_is_what_was_walked() -> None:
    assert codec.gateway_replies.type == GatewayReply
    assert {kind.__name__ for kind in get_args(GatewayReply)} <= set(ALLOWED)
    assert all(issubclass(kind, Message) for kind in get_args(GatewayReply))


class LeakyCase(Message, frozen=True, kw_only=True, tag="leaky_case"):
    pages: dict[str, tuple[Case | None, ...]]


class LeakyOutcome(Message, frozen=True, kw_only=True, tag="leaky_outcome"):
    episodes: tuple[EpisodeOutcome, ...]


class SeededFeedback(EpisodeFeedback, frozen=True, kw_only=True):
    case_seed: int


class SeededPage(ResultsPage, frozen=True, kw_only=True, tag="seeded_page"):
    others: tuple[SeededFeedback, ...] = ()


@pytest.mark.parametrize(
    ("message", "planted"), [(LeakyCase, Case), (LeakyOutcome, EpisodeOutcome), (SeededPage, SeededFeedback)]
)
def test_the_walk_finds_what_is_planted_anywhere_below_a_message(message: type, planted: type) -> None:
    found = fields_in(GatewayReply | message)
    assert planted.__name__ in found
    assert found != ALLOWED


def test_the_walk_finds_a_field_that_is_added_to_a_message() -> None:
    found = fields_in(SeededPage)
    assert set(found["SeededFeedback"]) - set(ALLOWED["EpisodeFeedback"]) == {"case_seed"}
    assert found["SeededPage"]["others"] == "[SeededFeedback]"
