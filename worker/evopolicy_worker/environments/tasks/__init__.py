"""Task texts: one Markdown file per environment, from which alone one could write a policy.

A file is named after the suite id with `/` as `_`. A line `<!-- include: NAME -->` stands for another file of this
folder: what several environments share is written once. Form of a text: an objective; `## Observation` with a table
whose first column names components (`0`, `0–4`, `image[0–6, 0–6, 0]`, `direction`); `## Action` with a table whose
first column names dimensions or choices; `## Reward`; `## Start`; `## End`. A test reads the tables and holds them
against the spaces.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from importlib.resources import files
from typing import TYPE_CHECKING, Any

from evopolicy_common.catalogue import Entry, entries, is_shipped
from evopolicy_common.messages.environment import SpaceSchema
from evopolicy_worker.environments.tasks import template

if TYPE_CHECKING:
    import gymnasium


@cache
def written(env_id: str) -> str | None:
    """The Markdown text that is written for an environment; None when none is."""
    name = env_id.replace("/", "_") + ".md"
    return template.read(name) if files(__package__).joinpath(name).is_file() else None


def _shared(entry: Entry) -> str | None:
    """The text written for it, or for the same environment of Gymnasium's under another id with the same limit."""
    same = (
        each.id
        for each in entries().values()
        if entry.gymnasium_id
        and (each.gymnasium_id, each.max_episode_steps) == (entry.gymnasium_id, entry.max_episode_steps)
    )
    return next((text for env_id in (entry.id, *same) if (text := written(env_id))), None)


def task_text(
    entry: Entry,
    env: gymnasium.Env[Any, Any],
    obs_space: SpaceSchema,
    action_space: SpaceSchema,
    components: Mapping[str, str],
    limit: int,
) -> str:
    """The Markdown text of an environment: that of its definition, or the one that is written for it, or else made by the
    template."""
    if entry.task:
        return template.clean(entry.task)
    found = _shared(entry) if is_shipped(entry.id) else None
    return found or template.text(entry, env, obs_space, action_space, components, limit)
