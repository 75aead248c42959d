"""Few simulators are found, and no honest agent is flagged; `simulator_rates.py` prints the rates of
docs/how-to/reports.md."""

from __future__ import annotations

from simulator_rates import agents, examples, held_out


def test_simulators_are_found_by_imports_and_by_numbers() -> None:
    assert held_out("simulators").flagged == ["plain_highway.py"]
    assert len(held_out("simulators").passed) == 15
    assert examples(rehearsing=True).flagged == ["gym_acrobot", "gym_continuouscar"]


def test_honest_agents_are_not_flagged() -> None:
    assert len(held_out("honest").passed) == 16
    for found in (held_out("honest"), examples(rehearsing=False), agents()):
        assert found.flagged == []
