"""Descriptions of environments and cases, on which the other message modules build.

In all messages unknown fields are skipped, and every field added later has a default.
"""

from __future__ import annotations

import hashlib
from typing import Literal

import msgspec

from evopolicy_common.messages.bounds import Int, Many, Named, Number, Plain, Text, Word

SpaceSchema = Plain
"""A space as plain data: `{"type": "Box", "shape": [2], "dtype": "float32", "low": …, "high": …}` and so on."""

Split = Literal["train", "validation", "heldout"]
PolicyScope = Literal["episode", "submit"]
ObservationForm = Literal["arrays", "lists"]
StepLimit = Literal["published", "natural"]
"""Whether an episode is cut where the published software cuts it, or ends by its environment's own limit."""
FailedEpisodes = Literal["play-on", "end-submit"]
"""An episode in which the policy failed. `play-on`: random actions play it to its end, and its return counts.
`end-submit`: it ends with one random action, the submit has no mean return, and its checkpoint is not eligible."""
HiddenEvaluation = Literal["submit", "pool"]
"""`submit`: a policy on hidden cases gets the `env_meta` and the episode indices of its own submit. `pool`: it gets
those of one list of all cases, with no budget left, and with policy scope `submit` one instance plays all of them."""
ObsStorage = Literal["inline", "npy", "npz"]


class Case(msgspec.Struct, frozen=True, kw_only=True):
    """One initial condition of an environment: the arguments of its `reset`."""

    seed: Int
    """Seed of the environment's own generator, 0 ≤ seed < 2**31."""
    options: Plain | None = None
    """`reset(options=…)`; None for environments that take none."""


class EnvironmentDescription(msgspec.Struct, frozen=True, kw_only=True):
    """Everything that is known of an environment without its simulator; made by the worker that offers it."""

    env: Word
    """Suite id, such as `gym/acrobot`."""
    env_version: Word
    """Name and version of the simulated environment, such as `Acrobot-v1 (gymnasium 1.4.0)`."""
    obs_space: SpaceSchema
    action_space: SpaceSchema
    obs_storage: ObsStorage = "inline"
    """Where feedback keeps observations: in the rows, or in `observations.npy` / `.npz` beside them."""
    max_episode_steps: Int
    reward_components: Many[Text] = ()
    """Names under which `info`, or its `rewards`, reports parts of the reward; summed per episode in the summary."""
    reward_texts: Named[Text] = {}
    """Meaning of each reward component."""
    task_text: Text
    """Markdown for `/task`: objective, observation, action, reward, how an episode ends."""
    deterministic: bool = True
    """False when even a fresh environment does not repeat an episode from its seed and actions."""
    renders: bool = False
    """True when an episode can be recorded as video."""
    title: Word = ""
    """Short name for tables; empty: the id."""
    family: Word = ""
    """Key of the family in which its scores are averaged; empty: the catalogue's."""
    definition: Plain = {}
    """How it is constructed: `gymnasium_id`, plus `kwargs` and `wrappers` where it has any."""
    reward_weights: Named[Number] = {}
    """For a vector reward: the weights of its elements, in order, in the return. Empty: the reward is a number."""
    success: Word = ""
    """Key in `info` that reports whether the task was solved; empty when no key does."""
    success_at: Literal["end", "any"] = "end"
    """Whether only the last step's value counts, or a true value at any step."""
    adapter: Word = ""
    """Revision of the adapter, `+`, and a digest of its code."""
    packages: Named[Text] = {}
    """Name to exact version of the distributions that decide this environment's numbers."""
    step_us: Number = 0.0
    """Mean time of a few random steps where it was described, microseconds; 0: not measured."""
    info_left_out: Many[Text] = ()
    """Keys of info that had text in these steps, which feedback leaves out."""

    def notes(self) -> str:
        """A note for its author, with the remedy; empty if there is nothing to say."""
        if not self.info_left_out:
            return ""
        return (
            f"{self.env}: feedback leaves out the texts of info under {', '.join(map(repr, self.info_left_out))}; to"
            " pass them on, name their keys in info_strings of an environment file"
        )

    def digest(self) -> str:
        """SHA-256 of the definition, 64 hex digits: of all fields except `_NOT_DEFINED`. A field at its
        default does not count, so that fields added later change no digest."""
        fields = {
            field.name: value
            for field in msgspec.structs.fields(self)
            if field.name not in _NOT_DEFINED and (value := getattr(self, field.name)) != _default(field)
        }
        return hashlib.sha256(msgspec.json.encode(fields, order="deterministic")).hexdigest()


def _default(field: msgspec.structs.FieldInfo) -> object:
    factory = field.default_factory
    return field.default if factory is msgspec.NODEFAULT else factory()


_NOT_DEFINED = frozenset({"env_version", "obs_storage", "adapter", "packages", "step_us", "info_left_out"})
