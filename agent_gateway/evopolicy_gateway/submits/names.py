"""How submits and episodes are named in answers, folders and rules. Commands import this, and so no numpy."""

from __future__ import annotations


def _digits(episode_budget: int) -> int:
    """Width of submit and episode numbers in names."""
    return max(3, len(str(episode_budget)))


def submit_id(index: int, episode_budget: int) -> str:
    """`submit_NNN`: a submit's name in answers and its folder's."""
    return f"submit_{index:0{_digits(episode_budget)}d}"


def episode_name(global_index: int, episode_budget: int) -> str:
    """`ep_XXX`: counts attempted episodes through the run."""
    return f"ep_{global_index:0{_digits(episode_budget)}d}"
