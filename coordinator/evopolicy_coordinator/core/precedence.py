"""Who goes first when hidden jobs and agents keep each other from the same kernels.

Rules that this module owns:
- Agents do, at first. When hidden jobs of closed runs, or an operator's, were kept from all kernels that could play them for
  `CoreSettings.hidden_wait_s` in all, one kernel is turned over to them until none of them is left: that with the fewest
  related agents, then train jobs. Hidden jobs of open runs never bring that about.
- There no related permit is granted; once none is left, no related train job is leased, and hidden jobs go before others.
- A submit none of whose episodes runs because hidden jobs have all its kernels is held. That time counts against no limit.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from .isolation import EVERYWHERE, Family, Kernel, Reversal, all_related
from .jobs import EARLY_VALIDATION, TRAIN, JobGroup
from .queue import Lane
from .records import train_group
from .turn import Turn

if TYPE_CHECKING:
    from .machine import Core

LOOK_S = 1.0
"""How often waiting hidden jobs, and train jobs that hidden ones may keep waiting, are looked at."""

DONE_LOOKS = 3
"""Nothing hidden was left for so many looks: then it is done. What follows from the last job may take a moment to queue."""


def watch(core: Core, lane: Lane, turn: Turn) -> None:
    """Look at the lane in a while, if it has anything to look at."""
    if core.isolation.on and (lane.backlog or lane.kept_s or lane.reversals or lane.waiting[TRAIN]):
        core.timers.arm_once(("hidden", lane.key), turn.now + LOOK_S)


def look(core: Core, lane: Lane, turn: Turn) -> None:
    """Turn a kernel over to hidden jobs that have waited for long, and back; see which submits are held."""
    passed_s = min(turn.now - lane.looked_at, 2 * LOOK_S)
    lane.looked_at = turn.now
    kernels = core.isolation.serving(lane)
    for family in {**lane.backlog, **lane.kept_s, **lane.reversals}:
        _hidden(core, lane, family, kernels, passed_s, turn)
    _train(core, lane, kernels, turn)
    watch(core, lane, turn)


def _hidden(
    core: Core, lane: Lane, family: Family, kernels: dict[Kernel, None], passed_s: float, turn: Turn
) -> None:
    isolation, reversal = core.isolation, lane.reversals.get(family)
    played = _played(core, lane, family)
    if played or lane.backlog.get(family):
        lane.done_looks.pop(family, None)
    else:
        lane.done_looks[family] = lane.done_looks.get(family, 0) + 1
        if lane.done_looks[family] >= DONE_LOOKS:
            del lane.done_looks[family]
            lane.kept_s.pop(family, None)
            if reversal is not None:
                turn_back(core, reversal, turn, "no hidden case of closed runs is left")
        return
    if reversal is not None:
        if reversal.kernel not in kernels:
            turn_back(core, reversal, turn, "its workers are gone")
        return
    known = [kernel for kernel in kernels if kernel.boot_id != EVERYWHERE]
    if played or not known or not all(isolation.hidden_bar(family, kernel) for kernel in known):
        return
    kept_s = lane.kept_s[family] = lane.kept_s.get(family, 0.0) + passed_s
    if kept_s >= core.settings.hidden_wait_s:
        _turn_over(core, lane, family, known, turn)


def _played(core: Core, lane: Lane, family: Family) -> bool:
    """Whether hidden jobs of the lane's closed runs are leased."""
    return any(
        stay.lease is not None and stay.lease.live and stay.lease.job.group.flow.closed
        for kernel in core.isolation.kernels.values()
        for stay in kernel.hidden.get(family, {}).values()
        if stay.lease is not None and stay.lease.job.group.flow.lane is lane
    )


def _turn_over(core: Core, lane: Lane, family: Family, kernels: list[Kernel], turn: Turn) -> None:
    def in_the_way(kernel: Kernel) -> tuple[int, int]:
        return len(all_related(kernel.permits, family)), len(all_related(kernel.train, family))

    kernel = min(kernels, key=in_the_way)
    reversal = lane.reversals[family] = Reversal(kernel, lane, family)
    family.users += 1
    kernel.reversals.setdefault(family, {})[str(lane.key)] = reversal
    for stay in all_related(kernel.hidden, family):
        lease = stay.lease
        if lease is not None and lease.live and lease.job.priority == EARLY_VALIDATION:
            core.scheduler.put_off(lease, "hidden jobs of closed runs go first there", turn)
    turn.dirty[lane] = None
    turn.log("info", "hidden_first", env=lane.key[0], boot_id=kernel.boot_id, agents=in_the_way(kernel)[0])


def turn_back(core: Core, reversal: Reversal, turn: Turn, why: str) -> None:
    """Agents go first again on a kernel."""
    kernel, family = reversal.kernel, reversal.family
    del reversal.lane.reversals[family]
    there = kernel.reversals[family]
    del there[str(reversal.lane.key)]
    if not there:
        del kernel.reversals[family]
    turn.log("info", "agents_first", env=reversal.lane.key[0], boot_id=kernel.boot_id, why=why)
    core.isolation.freed(family, turn)
    core.isolation.tidy(kernel)
    core.isolation.families.leave(family)


def _train(core: Core, lane: Lane, kernels: dict[Kernel, None], turn: Turn) -> None:
    """Begin or end to count the time for which submits are held."""
    barred = {
        family
        for family in lane.waiting[TRAIN]
        if kernels and all(core.isolation.train_bar(family, kernel) for kernel in kernels)
    }
    for group in [group for group in core.held if group.flow.lane is lane]:
        if group.flow.family not in barred:
            let_go(core, group, turn.now)
    if not barred:
        return
    waiting = {flow.id: None for _, _, flow in lane.heaps[TRAIN]}
    waiting |= {job.group.run: None for job in core.queue.suspects if job.priority == TRAIN}
    for name in waiting:
        run = core.runs.get(name)
        open_group = "" if run is None or run.open is None else train_group(run.id, run.open)
        found = core.groups.get(open_group)
        if found is None or found.n_leased or found.flow.lane is not lane or found.flow.family not in barred:
            continue
        if found.held_since is None:
            found.held_since = turn.now
            core.held[found] = None


def let_go(core: Core, group: JobGroup, now: float) -> None:
    """A submit is held no more."""
    if group.held_since is not None:
        group.held_s = group.held(now)
        group.held_since = None
        del core.held[group]
