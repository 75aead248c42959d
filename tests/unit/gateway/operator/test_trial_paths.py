"""Texts of errors about the folder of a policy."""

from __future__ import annotations

from pathlib import Path

import pytest

from evopolicy_common.errors import ConfigError
from evopolicy_gateway.operator.trials import policy_bundle


@pytest.mark.parametrize(
    ("name", "problem"),
    [("empty", "holds no policy.py"), ("policy.py", "is a file"), ("absent", "there is no folder")],
)
def test_a_path_without_a_policy_is_refused_with_the_remedy(tmp_path: Path, name: str, problem: str) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "policy.py").touch()
    with pytest.raises(ConfigError) as refused:
        policy_bundle(tmp_path / name)
    assert problem in str(refused.value)
    assert str(tmp_path / name) in str(refused.value)
    assert "name a folder with policy.py in it" in str(refused.value)
