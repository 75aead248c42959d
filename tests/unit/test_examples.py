"""The example policies as files: one for each Core16 environment, whole, and made of what the sandbox has."""

from __future__ import annotations

import ast
import sys
from pathlib import Path

import pytest

from evopolicy_common import catalogue
from evopolicy_common.records.policies import bundles

POLICIES = Path(__file__).parents[2] / "examples" / "policies"
CORE16 = catalogue.suites()["core16"].environments


@pytest.mark.parametrize("env", CORE16)
def test_an_example_imports_only_what_the_sandbox_has(env: str) -> None:
    sources = list(catalogue.policy_folder(POLICIES, env).rglob("*.py"))
    own = {path.stem for path in sources}
    for path in sources:
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            if isinstance(node, ast.ImportFrom):
                names = [node.module or ""]
            for name in names:
                top = name.split(".")[0]
                assert top == "numpy" or top in own or top in sys.stdlib_module_names, f"{path}: {name}"


@pytest.mark.parametrize("env", CORE16)
def test_an_example_is_a_bundle(env: str) -> None:
    assert "policy.py" in [
        file.path for file in bundles.snapshot(catalogue.policy_folder(POLICIES, env)).files
    ]
