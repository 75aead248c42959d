"""Splits: disjoint, the same for the same secret, independent of each other's lengths, and refused when wrong."""

from __future__ import annotations

import hashlib
import json
import re
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from evopolicy_common.errors import ConfigError
from evopolicy_common.messages.environment import Case
from evopolicy_common.records.splits import SPLITS, cases_hash, folders_below, overlaps
from evopolicy_coordinator import splits
from evopolicy_coordinator.splits import SplitSource, derive, load, secret_of

COUNTS = {"train": 64, "validation": 16, "heldout": 32}


def write(folder: Path, stem: str, seeds: list[int], **changes: Any) -> None:
    folder.mkdir(exist_ok=True)
    content = {"env": "toy/line", "split": stem, "cases": [{"seed": s} for s in seeds], **changes}
    (folder / f"{stem}.json").write_text(json.dumps(content))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    folder = tmp_path / "toy_line"
    write(folder, "train", [1, 2, 3])
    write(folder, "valid", [4, 5])
    write(folder, "heldout", [6, 7])
    return folder


def test_same_secret_gives_same_cases_and_another_gives_others() -> None:
    first = derive(b"a" * 32, "core16", "gym/acrobot", COUNTS)
    assert first == derive(b"a" * 32, "core16", "gym/acrobot", COUNTS)
    assert first != derive(b"b" * 32, "core16", "gym/acrobot", COUNTS)
    assert first != derive(b"a" * 32, "core16", "gym/bipedal", COUNTS)
    assert first != derive(b"a" * 32, "toy", "gym/acrobot", COUNTS)


@given(
    counts=st.fixed_dictionaries({split: st.integers(0, 40) for split in SPLITS}),
    space=st.integers(128, 2**31),
)
def test_derived_splits_are_disjoint_and_of_the_length_asked_for(counts: dict[Any, int], space: int) -> None:
    """A small seed space makes draws collide all the time."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(splits, "SEED_LIMIT", space)
        drawn = derive(b"s" * 32, "suite", "env", counts)
    assert {split: len(cases) for split, cases in drawn.items()} == counts
    assert overlaps(drawn) == []
    assert all(0 <= case.seed < space for cases in drawn.values() for case in cases)


@given(longer=st.fixed_dictionaries({split: st.integers(0, 20) for split in SPLITS}))
def test_making_a_split_longer_changes_no_case(longer: dict[Any, int]) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(splits, "SEED_LIMIT", 200)
        short = derive(b"s" * 32, "suite", "env", {"train": 5, "validation": 5, "heldout": 5})
        long = derive(b"s" * 32, "suite", "env", {split: 5 + n for split, n in longer.items()})
    for split in SPLITS:
        assert long[split][:5] == short[split]


def test_a_run_with_own_hidden_cases_shares_train_cases_only(folder: Path) -> None:
    source = SplitSource(data=None, secret=b"s" * 32)
    shared, first, second = (source.splits("toy", "toy/line", COUNTS, own) for own in ("", "run-1", "run-2"))
    assert first == source.splits("toy", "toy/line", COUNTS, "run-1")
    assert shared.train == first.train == second.train
    seeds = [
        {case.seed for case in (*one.validation, *one.heldout)} | {case.seed for case in shared.train}
        for one in (shared, first, second)
    ]
    trained = {case.seed for case in shared.train}
    assert len({case.seed for case in (*first.validation, *first.heldout)} - trained) == len(
        (*first.validation, *first.heldout)
    )
    assert seeds[0] & seeds[1] == seeds[0] & seeds[2] == seeds[1] & seeds[2] == trained
    with pytest.raises(ConfigError, match="per-run"):
        SplitSource(data=folder.parent, secret=b"s" * 32).splits("toy", "toy/line", {}, "run-1")


def test_hash_is_of_canonical_json_of_the_cases() -> None:
    cases = [Case(seed=3), Case(seed=4, options={"b": 1, "a": [0.5]})]
    text = '[{"seed":3},{"options":{"a":[0.5],"b":1},"seed":4}]'
    assert cases_hash(cases) == hashlib.sha256(text.encode()).hexdigest()


def test_files_are_read_and_cut_to_what_is_asked_for(folder: Path) -> None:
    source = SplitSource(data=folder.parent, secret=b"")
    whole = source.splits("toy", "toy/line", {})
    assert [case.seed for case in whole.train] == [1, 2, 3]
    assert [case.seed for case in source.splits("toy", "toy/line", {"heldout": 1}).heldout] == [6]
    with pytest.raises(ConfigError, match="has 2 cases, and 9 are requested"):
        source.splits("toy", "toy/line", {"validation": 9})
    with pytest.raises(ConfigError, match="toy_maze"):
        source.splits("toy", "toy/maze", {})


def test_files_that_do_not_say_they_are_secret_are_not(folder: Path) -> None:
    assert SplitSource(data=folder.parent, secret=b"").splits("toy", "toy/line", {}).secret is False
    for stem, seeds in (("train", [1]), ("valid", [2]), ("heldout", [3])):
        write(folder, stem, seeds, secret=True)
    assert SplitSource(data=folder.parent, secret=b"").splits("toy", "toy/line", {}).secret is True


@pytest.mark.parametrize(
    ("stem", "seeds", "changes", "finding"),
    [
        ("heldout", [6, 2], {}, "seed 2 is train case 1 and heldout case 1"),
        ("train", [1, 1], {}, "seed 1 is train case 0 and train case 1"),
        ("valid", [4], {"split": "train"}, "says it is split 'train'"),
        ("valid", [4], {"env": "toy/maze"}, "is of environment 'toy/maze'"),
        ("valid", [], {}, "has no cases"),
        ("valid", [2**31], {}, f"case 0 has seed {2**31}"),
        ("valid", [-1], {}, "case 0 has seed -1"),
        ("valid", [], {"cases": [{"seed": "x"}]}, r"not a split file.*\$\.cases\[0\]\.seed"),
        ("valid", [], {"cases": None}, "not a split file"),
        (
            "valid",
            [],
            {"cases": [{"seed": 4, "options": {"a": 2**64}}]},
            "valid.json is not a split file: .*ints",
        ),
        ("train", [1], {"cases": [{"seed": 6, "options": {}}]}, "seed 6 is train case 0 and heldout case 0"),
    ],
)
def test_wrong_files_are_found_out_and_not_played(
    folder: Path, stem: str, seeds: list[int], changes: dict[str, Any], finding: str
) -> None:
    write(folder, stem, seeds, **changes)
    _, findings = load(folder)
    assert any(re.search(finding, text) for text in findings), findings
    with pytest.raises(ConfigError, match="evopolicy data check"):
        SplitSource(data=folder.parent, secret=b"").splits("toy", "toy/line", {})


def test_published_tree_is_read_as_ours_is(folder: Path, tmp_path: Path) -> None:
    published = tmp_path / "main-128" / "toy" / "line"
    published.parent.mkdir(parents=True)
    folder.rename(published)
    source = SplitSource(data=tmp_path / "main-128", secret=b"")
    assert source.splits("toy", "toy/line", {}).cases("train")[0].seed == 1
    assert folders_below(tmp_path / "main-128") == [published]
    assert folders_below(published) == [published]


def test_same_seed_with_other_options_is_another_case(folder: Path) -> None:
    write(folder, "valid", [], cases=[{"seed": 1, "options": {"level": 2}}])
    assert load(folder)[1] == []


def test_missing_file_and_missing_folder_are_reported(folder: Path, tmp_path: Path) -> None:
    (folder / "valid.json").unlink()
    splits_, findings = load(folder)
    assert splits_ is None
    assert "valid.json" in findings[0]
    with pytest.raises(ConfigError, match="is not a folder"):
        SplitSource(data=tmp_path / "nowhere", secret=b"")


def test_secret_is_made_once_and_only_its_owner_reads_it(tmp_path: Path) -> None:
    secret, note = secret_of(tmp_path)
    assert len(secret) == 32
    assert note == ""
    assert (tmp_path / "secret").stat().st_mode & 0o777 == 0o600
    assert secret_of(tmp_path) == (secret, "")


def test_unjailed_agents_find_no_other_runs_secret(tmp_path: Path) -> None:
    usual, _ = secret_of(tmp_path)
    own, note = secret_of(tmp_path, unjailed=True)
    assert "cases are of its own" in note
    files = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    assert files == {"secret-unjailed": own}
    assert secret_of(tmp_path, unjailed=True)[0] == own  # runs without a jail compare with each other
    later, note = secret_of(tmp_path)
    assert "the cases are new from here on" in note
    assert len({usual, own, later}) == 3
    assert secret_of(tmp_path) == (later, "")


def test_secret_that_others_may_read_or_that_is_cut_short_is_refused(tmp_path: Path) -> None:
    secret_of(tmp_path)
    (tmp_path / "secret").chmod(0o644)
    with pytest.raises(ConfigError, match="chmod 600"):
        secret_of(tmp_path)
    (tmp_path / "secret").write_bytes(b"short")
    with pytest.raises(ConfigError, match="5 bytes"):
        secret_of(tmp_path)


WORLD, OTHER = "gym/acrobot@w1", "gym/acrobot@w2"


def world_of(found: splits.EnvironmentSplits) -> set[str]:
    """The keys in all cases."""
    return {case.options["world"] for split in SPLITS for case in found.cases(split) if case.options}


def test_all_cases_of_a_world_have_one_key_for_each_secret() -> None:
    source = SplitSource(data=None, secret=b"s" * 32)
    (key,) = world_of(source.splits("core16-worlds", WORLD, COUNTS))
    assert re.fullmatch("[0-9a-f]{32}-0", key)
    assert world_of(source.splits("core16-worlds", WORLD, COUNTS, own="run-7")) == {key}
    further = source.further("core16-worlds", WORLD, "more", 3, ())
    assert {case.options["world"] for case in further.cases if case.options} == {key}
    assert world_of(source.splits("core16-worlds", OTHER, COUNTS)) != {key}
    assert world_of(SplitSource(data=None, secret=b"t" * 32).splits("core16-worlds", WORLD, COUNTS)) != {key}
    assert world_of(source.splits("core16", "gym/acrobot", COUNTS)) == set()


@pytest.mark.parametrize("second", [None, {"world": "b" * 32}, {"world": "short"}])
def test_files_of_a_world_need_one_key_for_all_cases(tmp_path: Path, second: Any) -> None:
    folder = tmp_path / "gym_acrobot@w1"
    for stem, seed in (("train", 1), ("valid", 2), ("heldout", 3)):
        cases = [{"seed": seed, "options": {"world": "a" * 32}}]
        write(folder, stem, [], env=WORLD, cases=cases)
    source = SplitSource(data=tmp_path, secret=b"s" * 32)
    assert world_of(source.splits("core16-worlds", WORLD, {})) == {"a" * 32}
    write(folder, "valid", [], env=WORLD, cases=[{"seed": 2, "options": second}])
    with pytest.raises(ConfigError, match="all cases of a world have the same key"):
        source.splits("core16-worlds", WORLD, {})
