"""Every option and argument of every command with every bad value. `tests/unit/test_bad_values.py` tries a sample."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from documents import commands
from option_values import Case, Player, cases, player

pytestmark = [pytest.mark.system, pytest.mark.slow, pytest.mark.timeout(600)]


@pytest.fixture(scope="module", name="play")
def _play(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Player]:
    with player(tmp_path_factory.mktemp("values")) as found:
        yield found


@pytest.mark.parametrize("command", [name for name, _ in commands()])
def test_a_command_refuses_a_bad_value_wherever_it_stands(command: str, play: Player) -> None:
    chosen = [case for case in cases() if case.command == command]
    assert {case[1:]: faults for case in chosen if (faults := play.faults(case))} == {}


def test_the_cases_are_those_of_all_commands() -> None:
    with_values = {name for name, command in commands() if command.params}
    assert {case.command for case in cases()} == with_values
    assert Case("evopolicy run", "credentials_file", "pipe") in cases()
