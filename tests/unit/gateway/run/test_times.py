"""How a run's seconds add up over the processes and commands that have played it."""

from __future__ import annotations

from pathlib import Path

from evopolicy_common.records.run_record import AgentLimits, AgentResources
from evopolicy_gateway.run.times import Stopwatch, Times


def test_reported_times_add_up_over_deaths_and_commands(tmp_path: Path) -> None:
    now = [100.0]
    path = tmp_path / "times.json"
    first = Stopwatch(path, lambda: now[0])
    first.opened()
    first.begins("gateway")
    first.begins("agent")
    first.reported("gateway", Times(in_flight_s=2.0, feedback_s=0.5))
    first.reported("agent", Times(agent_s=5.0))
    # The second agent supervisor and the second gateway tell more than the first did, and still do not take its place.
    first.begins("agent")
    first.reported("agent", Times(agent_s=6.0))
    first.begins("gateway")
    first.reported("gateway", Times(in_flight_s=3.0, feedback_s=0.75))
    now[0] = 120.0
    first.reported("agent", Times(agent_s=7.0))
    whole = Times(agent_s=12.0, open_s=20.0, in_flight_s=5.0, feedback_s=1.25)
    assert first.times == whole
    # This command is killed here; what it told last is on disk.
    second = Stopwatch(path, lambda: now[0])
    assert second.times == whole
    second.opened()
    second.begins("agent")
    second.reported("agent", Times(agent_s=1.0))
    now[0] = 121.0
    second.closed()
    now[0] = 500.0
    assert second.times == Times(agent_s=13.0, open_s=21.0, in_flight_s=5.0, feedback_s=1.25)
    assert Stopwatch(path).times == second.times


def test_time_waited_for_hidden_episodes_is_a_figure_of_its_own(tmp_path: Path) -> None:
    path = tmp_path / "times.json"
    first = Stopwatch(path)
    first.held_reported(0.0, 2.0)
    assert first.held_reported(3.0) == 3.0
    # Both are told by each gateway: of the whole run the one, of its own wait the other.
    first.held_reported(0.0, 1.0)
    assert first.held_reported(2.0) == 3.0
    first.keep()
    assert Stopwatch(path).times == Times(held_s=3.0, permit_s=3.0)


def test_times_that_cannot_be_read_or_written_stop_nothing(tmp_path: Path) -> None:
    path = tmp_path / "times.json"
    path.write_text("{")
    assert Stopwatch(path).times == Times()
    Stopwatch(tmp_path / "gone" / "times.json").keep()


def test_resources_of_killed_and_resumed_agents_add_up(tmp_path: Path) -> None:
    path = tmp_path / "times.json"
    first = Stopwatch(path)
    limits = AgentLimits(pids=9)
    for cpu_s, peak in ((1.0, 50), (2.0, 70)):
        first.begins("agent")
        first.reported("agent", Times(resources=AgentResources(limits=limits, cpu_s=cpu_s / 2)))
        resources = AgentResources(limits=limits, cpu_s=cpu_s, memory_peak_bytes=peak, disk_bytes=100 - peak)
        first.reported("agent", Times(agent_s=1.0, resources=resources))
    second = Stopwatch(path)  # the command is killed here
    second.begins("agent")
    second.reported("agent", Times(resources=AgentResources(limits=limits, cpu_s=0.5, refused_forks=3)))
    second.closed()
    whole = AgentResources(limits=limits, cpu_s=3.5, memory_peak_bytes=70, disk_bytes=50, refused_forks=3)
    assert second.times.resources == Stopwatch(path).times.resources == whole
