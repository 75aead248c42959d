"""Names of submits and episodes in answers, folders and rules. Imports no numpy, because commands import it."""

from __future__ import annotations


def _digits(episode_budget: int) -> int:
    return max(3, len(str(episode_budget)))


def submit_id(index: int, episode_budget: int) -> str:
    """`submit_NNN`: the name of a submit in answers, and of its folder."""
    return f"submit_{index:0{_digits(episode_budget)}d}"


def episode_name(global_index: int, episode_budget: int) -> str:
    """`ep_XXX`: the name of an episode, counted over all attempted episodes of the run."""
    return f"ep_{global_index:0{_digits(episode_budget)}d}"
