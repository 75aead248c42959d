"""Bad values of options, a sample: `tests/integration/test_every_bad_value.py` tries all."""

from __future__ import annotations

import random
from collections.abc import Iterator

import pytest
from option_values import Case, Player, cases, player

pytestmark = pytest.mark.slow

SAMPLE = random.Random(34).sample(cases(), 120)


@pytest.fixture(scope="module", name="play")
def _play(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Player]:
    with player(tmp_path_factory.mktemp("values")) as found:
        yield found


@pytest.mark.parametrize("case", SAMPLE, ids="-".join)
def test_a_bad_value_is_refused_in_one_line_and_harms_nothing(case: Case, play: Player) -> None:
    assert play.faults(case) == []
