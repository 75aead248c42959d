"""What a jailed agent reads of a policy at work on its machine: the ways that are closed, and those that SECURITY.md
says are open.

Open ones are why hidden episodes and agents never share a kernel.
"""

from __future__ import annotations

import pytest
from attacks import channels
from slots import Slots

CLOSED = {"cpu_time", "threads_started"}
OPEN = {"opens a library": "opens"}
"""Heard on a busy machine too. The other numbers are moved by whatever else runs there."""
PATIENT_PERIOD_S = 0.15
TRIES = 4


@pytest.fixture(scope="module")
def reader(tmp_path_factory: pytest.TempPathFactory) -> channels.JailedReader:
    return channels.JailedReader(tmp_path_factory.mktemp("jailed"))


@pytest.mark.parametrize("way", channels.WAYS)
def test_what_a_jailed_agent_hears_of_a_policy_is_what_is_documented(
    slots: Slots, reader: channels.JailedReader, way: str
) -> None:
    heard: dict[str, float] = {}
    for k in range(TRIES):
        period_s = PATIENT_PERIOD_S * 2**k  # the busier the machine, the longer a bit must last
        for reading, rate in channels.live(slots, reader, way, n=30, period_s=period_s).items():
            heard[reading] = max(rate, heard.get(reading, 0.0))
        if way not in OPEN or heard[OPEN[way]]:
            break
    assert all(heard[reading] == 0.0 for reading in CLOSED & set(heard)), heard
    if way in OPEN:
        assert heard[OPEN[way]] > 0.0, heard


def test_what_the_kernel_counted_before_says_nothing_to_a_jailed_agent(
    reader: channels.JailedReader,
) -> None:
    first, second = reader.look(), reader.look()
    for name in CLOSED:
        assert first[name] == second[name] == 0.0
