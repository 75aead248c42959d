"""The longest episode of one environment of each family with pictures: it is played to its limit of steps and recorded
with all its pictures, within a quarter of the memory that a slot may have."""

from __future__ import annotations

import io
import zipfile
from pathlib import Path
from typing import NamedTuple

import msgspec
import pytest
from slots import Slots, family, make_job, pid_of

from evopolicy_common import catalogue
from evopolicy_common.catalogue import Wrapper
from evopolicy_common.messages.episode import ResourceLimits
from evopolicy_common.records.episodes.rendered import OBSERVATIONS, ROWS, checked_files
from evopolicy_worker.environments.interface.calls import USUAL
from evopolicy_worker.slots.slot import Slot

pytestmark = [pytest.mark.families, pytest.mark.slow, pytest.mark.timeout(600)]

WRAPPER = Wrapper(wrapper="endless:Endless")


class Long(NamedTuple):
    """An environment, and the steps to which it is played."""

    env: str
    steps: int


LONGEST = {
    "atari": Long("gymnasium/ALE/MontezumaRevenge-v5", 27_000),
    "box2d": Long("gymnasium/CarRacing-v3", 1000),
    "crafter": Long("crafter/CrafterReward-v1", 10_000),
    "miniworld": Long("gymnasium/MiniWorld-CollectHealth-v0", 1000),
    "nethack": Long("gymnasium/NetHack-v0", 5000),
    "stable_retro": Long("retro/Airstriker-Genesis-v0", 1000),
    "vizdoom": Long("gymnasium/VizdoomDeathmatch-v1", 4200),
}
"""By family."""


def peak_mb(pid: int) -> int:
    """Greatest resident memory that one of the processes has had so far, MiB."""
    status = [Path(f"/proc/{each}/status").read_text() for each in family(pid)]
    return max(int(text.partition("VmHWM:")[2].split()[0]) for text in status if "VmHWM:" in text) >> 10


@pytest.mark.parametrize("name", LONGEST)
def test_the_longest_episode_is_recorded_to_its_limit(
    slots: Slots, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    env, steps = LONGEST[name]
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parent / "endless"))
    entry = msgspec.structs.replace(catalogue.entry(env), id=f"long/{name}", wrappers=(WRAPPER,))
    with slots.running(Slot(None, "bwrap", slots.folder / "long", definitions=(entry,))) as slot:
        job = make_job(env=entry.id, bundle=None, limits=ResourceLimits(), render=True)
        (outcome,) = slots.run(slot.play_job(job, None, lambda episodes, steps: None), timeout_s=500.0)
        peak = peak_mb(pid_of(slot))
    assert (outcome.length, outcome.truncated, outcome.failure) == (steps, True, None)
    assert outcome.trajectory is not None
    assert outcome.trajectory.inline is not None
    size = outcome.trajectory.size
    files = checked_files(outcome.trajectory.inline, outcome.length, outcome.episode_return)
    assert set(files) == {ROWS, OBSERVATIONS}
    with zipfile.ZipFile(io.BytesIO(files[OBSERVATIONS])) as archive:
        raw = sum(member.file_size for member in archive.infolist())
    print(f"{name}: {steps:,} steps, {raw / 1e6:,.0f} MB, recorded in {size / 1e6:,.1f} MB; peak {peak} MiB")
    assert peak << 20 < USUAL.memory_bytes // 4
