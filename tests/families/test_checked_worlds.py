"""`check-env` finds nothing in the worlds of Core16, with the rules of the public key."""

from __future__ import annotations

import pytest

from evopolicy_common import catalogue
from evopolicy_common.catalogue.worlds import ids
from evopolicy_worker import check_env

pytestmark = pytest.mark.families


@pytest.mark.slow
@pytest.mark.timeout(600)
@pytest.mark.parametrize("env", catalogue.suites()["core16"].environments)
def test_check_env_finds_nothing_in_the_worlds_of_core16(env: str, monkeypatch: pytest.MonkeyPatch) -> None:
    # A world costs as much as its environment, which is measured elsewhere.
    monkeypatch.setattr(check_env, "in_a_slot", lambda *given: check_env.InASlot())
    worlds = ids(env)
    verdicts = {each.here.env: each.verdict for each in check_env.check(worlds, (), 40)}
    assert verdicts == dict.fromkeys(worlds, "ok")
