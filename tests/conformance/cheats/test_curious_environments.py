"""A user's environment sees its own modules and declared data of the folder in which it lies, and info brings no other
text.

Attacks, each with its defence:
- lies in a folder with runs, keys, `.env`, state (`PYTHONPATH=$PWD`), and reads them: only modules, packages
  and declared data of such folders are shown, without dot files, keys, run directories, state folders.
- comes as a package with links to files of the operator's (another run's returns, the secret of all hidden cases, cloud
  keys), and puts them into observations, which the agent reads: a link shows only a file of the link's own package that
  is shown by itself, and no folder.
"""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
from slots import Slots, make_job, rows

from evopolicy_common import catalogue
from evopolicy_common.catalogue import Entry
from evopolicy_common.errors import WorkerError
from evopolicy_common.messages.environment import EnvironmentDescription
from evopolicy_common.messages.episode import Tier
from evopolicy_worker.slots.slot import Slot

CURIOUS = Path(__file__).with_name("simulators") / "curious"
SECRETS = (
    *("runs/e/toy_line/a/run.json", "runs/e/toy_line/a/logs/env.log", ".env", ".git/config", "token.txt"),
    *("server.pem", "state/identity.json", "levels/1.txt", "notes/plan.md"),
    *("parts/.env", "parts/runs/e/toy_line/a/run.json", "parts/runs/e/toy_line/a/logs/env.log"),
    *("parts/own.key", "parts/state/identity.json"),
)
OWN = ("curious.py", "helpers.py", "parts/inner.py", "parts/table.json", "parts/maps/1.txt")
both_tiers = pytest.mark.parametrize("tier", ["bwrap", "landlock"])


@pytest.fixture
def project(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of a user who exports PYTHONPATH=$PWD."""
    found = tmp_path / "project"
    shutil.copytree(CURIOUS, found)
    for name in (*SECRETS, *OWN[3:], "maps/deep/2.txt"):
        (found / name).parent.mkdir(parents=True, exist_ok=True)
        (found / name).write_text("a secret, or data")
    monkeypatch.setenv("PYTHONPATH", str(found))
    return found


def entries(project: Path, **fields: object) -> tuple[Entry, ...]:
    """The environment of a file of the user's."""
    about = {"id": "my/curious", "gymnasium_id": "curious:Curious-v0", **fields}
    kwargs = about.pop("kwargs", {})
    file = project / "curious.toml"
    lines = [f"{name} = {json.dumps(value)}" for name, value in about.items()]
    lines += ["[kwargs]", *(f"{name} = {json.dumps(value)}" for name, value in dict(kwargs).items())]  # type: ignore[call-overload]
    file.write_text("\n".join(lines))
    return tuple(catalogue.entry(each) for each in catalogue.add(file))


def played(
    slots: Slots, tier: Tier, definitions: tuple[Entry, ...]
) -> tuple[EnvironmentDescription, dict[str, object]]:
    """The environment's description, and the info of a step."""
    (definition,) = definitions
    slot = Slot(None, tier, slots.folder / f"own-{tier}", definitions=definitions)

    async def play() -> tuple[EnvironmentDescription, dict[str, object]]:
        try:
            await slot.start()
            (description,) = await slot.describe([definition.id])
            job = make_job(env=definition.id, bundle=None, tier=tier)
            (outcome,) = await slot.play_job(job, None, lambda episodes, steps: None)
            return description, rows(outcome)[0].info
        finally:
            await slot.close()

    return slots.run(play())


@both_tiers
def test_an_environment_reads_its_modules_and_nothing_else_beside_them(
    tier: Tier, slots: Slots, project: Path
) -> None:
    asks = [*SECRETS, *OWN, "maps/deep/2.txt"]
    _, info = played(slots, tier, entries(project, kwargs={"asks": asks}))
    assert {name for name in asks if info[name]} == set(OWN)


def test_without_a_jail_the_same_environment_reads_it_all(slots: Slots, project: Path) -> None:
    _, info = played(slots, "none", entries(project, kwargs={"asks": SECRETS}))
    assert {name for name in SECRETS if info[name]} == set(SECRETS)


LINKS = {
    "parts/b.dat": "../../operator/run.json",
    "parts/s.dat": "../../operator/secret",
    "parts/r.dat": "../runs/e/toy_line/a/logs/env.log",
    "parts/e.dat": ".env",
    "parts/k.dat": "own.key",
    "parts/l.dat": "runs/e/toy_line/a/logs/env.log",
    "parts/i.dat": "state/identity.json",
    "parts/chain.dat": "b.dat",
    "parts/maps/up.dat": "../../token.txt",
    "parts/folder": "../../operator",
    "parts/near": "maps",
    "whole/b.dat": "../../operator/secret",
    "whole/folder": "../../operator",
    "x.libs": "../operator",
    "stolen.py": "../operator/secret",
    "beside.py": "token.txt",
    "stolen": "../operator",
    "plan.dat": "../operator/secret",
}
"""By name, the target of a link in the folder."""
THROUGH = ("parts/folder/secret", "whole/folder/secret", "x.libs/secret", "stolen/secret", "parts/near/1.txt")


@both_tiers
def test_links_of_a_package_show_no_file_of_the_operators(tier: Tier, slots: Slots, project: Path) -> None:
    operator = project.parent / "operator"
    operator.mkdir(mode=0o700)
    for name in ("run.json", "secret", "__init__.py"):
        (operator / name).write_text("a secret")
    (project / "whole").mkdir()
    (project / "whole" / "__init__.py").touch()
    for name, target in {**LINKS, "parts/alias.json": "table.json", "parts/maps/2.txt": "1.txt"}.items():
        (project / name).symlink_to(target)
    asks = [*LINKS, *THROUGH, "parts/alias.json", "parts/maps/2.txt"]
    _, info = played(slots, tier, entries(project, kwargs={"asks": asks}))
    assert {name for name in asks if info[name]} == {"parts/alias.json", "parts/maps/2.txt"}
    _, info = played(slots, "none", entries(project, kwargs={"asks": asks}))
    assert {name for name in asks if info[name]} >= {"parts/b.dat", "stolen.py", "x.libs/secret"}


@both_tiers
def test_declared_data_is_shown_without_what_nobody_declares(tier: Tier, slots: Slots, project: Path) -> None:
    (project / "maps" / ".env").write_text("a secret")
    asks = ["maps/deep/2.txt", "levels/1.txt", "maps/.env", "token.txt"]
    _, info = played(slots, tier, entries(project, kwargs={"asks": asks}, data=["maps", "levels/1.txt"]))
    assert {name for name in asks if info[name]} == {"maps/deep/2.txt", "levels/1.txt"}


@both_tiers
def test_an_error_names_the_file_that_is_not_shown_and_the_remedy(
    tier: Tier, slots: Slots, project: Path
) -> None:
    with pytest.raises(WorkerError) as caught:
        played(slots, tier, entries(project, kwargs={"needs": "maps/deep/2.txt"}))
    assert "maps/deep/2.txt is not shown" in str(caught.value)
    assert "declare it in data" in str(caught.value)


@both_tiers
def test_text_in_info_is_passed_on_where_the_definition_declares_its_key(
    tier: Tier, slots: Slots, project: Path
) -> None:
    """Attack: passes texts of this machine on to agents in `info`. Defence: feedback has texts only under
    keys that the definition declares (`info_strings`, part of its digest). Numbers and observations can
    still carry anything that the environment sees."""
    description, info = played(slots, tier, entries(project))
    assert info == {"near": 1.0, "steps": 1}
    assert set(description.info_left_out) == {"where", "phase"}
    assert "'where', 'phase'; to pass them on, name their keys in info_strings" in description.notes()
    named, info = played(slots, tier, entries(project, info_strings=["phase"]))
    assert info == {"near": 1.0, "phase": "helped inside", "steps": 1}
    assert named.info_left_out == ("where",)
    assert named.digest() != description.digest()
