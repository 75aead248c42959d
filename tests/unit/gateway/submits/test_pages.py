"""How a gateway asks for results: few pages for many short episodes, and no wait for the last ones."""

from __future__ import annotations

import pytest

from evopolicy_gateway.submits.feedback import LONGEST_LINGER_S, Linger


def play(n: int, episode_s: float, round_trip_s: float = 0.002) -> tuple[int, float]:
    """Pages until the last of `n` episodes is here, one every `episode_s`, and seconds by which it came late."""
    linger, now, pages, n_done = Linger(n, 0.0), 0.0, 0, 0
    while n_done < n:
        now = max(now, (n_done + 1) * episode_s) + round_trip_s
        n_done = min(n, int(now / episode_s))
        pages += 1
        now += linger.pause_s(n_done, now) if n_done < n else 0.0
    return pages, now - n * episode_s - round_trip_s


@pytest.mark.parametrize("episode_s", [0.0001, 0.001, 0.01])
@pytest.mark.parametrize("n", [2, 8, 32, 128, 1000])
def test_many_short_episodes_take_few_pages_and_no_pause_at_the_end(n: int, episode_s: float) -> None:
    pages, late_s = play(n, episode_s)
    assert pages <= 14 + n * episode_s / LONGEST_LINGER_S * 1.2
    assert late_s <= episode_s + 0.003


def test_long_episodes_are_shown_within_the_longest_pause() -> None:
    pages, late_s = play(10, 2.0)
    assert pages == 10
    assert late_s <= LONGEST_LINGER_S


def test_no_pause_before_the_first_result() -> None:
    assert Linger(128, 0.0).pause_s(0, 5.0) == 0.0
