"""Memory of a slot's processes, also of those whose shared part the kernel does not show."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest
from hypothesis import given
from hypothesis import strategies as st

from evopolicy_common.processes import proc
from evopolicy_worker.episodes.policy_process import address_space
from evopolicy_worker.slots.slot import _memory


@pytest.mark.parametrize("shown", [True, False])
def test_memory_counts_children_whether_or_not_the_kernel_shows_what_is_shared(
    shown: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    if not shown:
        monkeypatch.setattr(proc, "proportional_bytes", lambda pid: None)
    code = "held = bytearray(64 << 20); print(flush=True); input()"
    alone = _memory(os.getpid())
    with subprocess.Popen(
        [sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as child:
        assert child.stdin is not None
        assert child.stdout is not None
        child.stdout.readline()
        both = _memory(os.getpid())
        child.stdin.close()
    assert alone > 0
    assert both > alone + (60 << 20)


@given(base=st.integers(1 << 20, 1 << 33), memory=st.integers(1 << 20, 1 << 33))
def test_the_address_space_limit_grants_memory_and_hides_the_heap(base: int, memory: int) -> None:
    granted = address_space(base, memory)
    assert 0 <= granted - base - memory < 1 << 20
    assert (granted - memory) % (1 << 20) == 0


def test_zygotes_whose_heaps_begin_elsewhere_give_the_same_limit() -> None:
    # Sizes of two zygotes of one machine.
    assert address_space(111_756 << 10, 1 << 29) == address_space(111_760 << 10, 1 << 29)
