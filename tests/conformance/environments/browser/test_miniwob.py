"""MiniWoB++ in a real browser: its tasks can be solved with its own actions, and episodes repeat."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from test_environment_task_texts import flags

from evopolicy_common import catalogue
from evopolicy_common.errors import WorkerError
from evopolicy_common.messages.environment import Case
from evopolicy_worker.environments import Environment, make, missing
from evopolicy_worker.environments.browser import chromium
from evopolicy_worker.environments.browser import page as page_module
from evopolicy_worker.environments.browser.miniwob_env import ACTIONS, KEYS, MiniWoBEnv
from evopolicy_worker.environments.browser.page import shared
from evopolicy_worker.environments.checks import conformance
from evopolicy_worker.environments.interface.base import Step
from evopolicy_worker.environments.interface.settings import BROWSER

pytestmark = pytest.mark.families

SAMPLE = (
    "miniwob/click-test-v1",
    "miniwob/click-tab-v1",
    "miniwob/click-tab-2-medium-v1",
    "miniwob/order-food-v1",
    "miniwob/enter-text-v1",
    "miniwob/drag-box-v1",
)
Warm = Callable[[str], Environment]


@pytest.fixture(scope="module", autouse=True)
def browser() -> Iterator[None]:
    """This process's browser ends with this file."""
    yield
    shared().lose()


def action(kind: str, **values: Any) -> dict[str, Any]:
    """An action with only what its kind looks at."""
    usual = {"coords": np.zeros(2, np.float32), "ref": 0, "key": 0, "text": "", "field": 0}
    return {**usual, **values, "action_type": ACTIONS.index(kind)}


def only(obs: dict[str, Any], **wanted: str) -> dict[str, Any]:
    """The first element with these values."""
    return next(
        each for each in obs["dom_elements"] if all(each[name] == value for name, value in wanted.items())
    )


def middle(element: dict[str, Any]) -> np.ndarray[Any, Any]:
    return np.concatenate(
        (element["left"] + element["width"] / 2, element["top"] + element["height"] / 2)
    ).astype(np.float32)


def test_a_click_on_an_element_or_at_its_place_solves_the_task(warm: Warm) -> None:
    environment = warm("miniwob/click-button-v1")
    for kind in ("CLICK_ELEMENT", "CLICK_COORDS"):
        obs = environment.reset(Case(seed=5))
        (_, target), *_ = obs["fields"]
        button = only(obs, tag="button", text=target)
        step = environment.step(action(kind, ref=button["ref"], coords=middle(button)))
        assert step.terminated
        assert 0.9 < step.reward < 1.0
        assert step.info["success"] is True
        assert step.obs == {"dom_elements": (), "fields": (), "utterance": ""}


def test_a_wrong_click_costs(warm: Warm) -> None:
    environment = warm("miniwob/click-button-v1")
    obs = environment.reset(Case(seed=5))
    (_, target), *_ = obs["fields"]
    wrong = next(each for each in obs["dom_elements"] if each["tag"] == "button" and each["text"] != target)
    step = environment.step(action("CLICK_ELEMENT", ref=wrong["ref"]))
    assert (step.reward, step.terminated, step.info["success"]) == (-1.0, True, False)


@pytest.mark.parametrize("typing", ["TYPE_TEXT", "TYPE_FIELD", "FOCUS_ELEMENT_AND_TYPE_TEXT", "PRESS_KEY"])
def test_text_is_typed(warm: Warm, typing: str) -> None:
    environment = warm("miniwob/enter-text-v1")
    obs = environment.reset(Case(seed=3))
    (_, target), *_ = obs["fields"]
    field = only(obs, tag="input_text")
    if typing == "FOCUS_ELEMENT_AND_TYPE_TEXT":
        environment.step(action(typing, ref=field["ref"], text=target))
    else:
        environment.step(action("CLICK_COORDS", coords=middle(field)))
        if typing == "PRESS_KEY":
            for character in target:
                step = environment.step(action(typing, key=KEYS.index(character)))
        else:
            step = environment.step(action(typing, text=target, field=0))
        assert only(step.obs, tag="input_text")["value"] == target
        assert only(step.obs, tag="input_text")["flags"][0] == 1
    step = environment.step(action("CLICK_ELEMENT", ref=only(obs, tag="button")["ref"]))
    assert step.terminated
    assert step.reward > 0


def test_no_later_episode_can_paste_a_copied_text(warm: Warm) -> None:
    """Attack: keeps something for a later episode: storage, cookies, databases, service workers, the
    window's name, the clipboard. Defence: storage lasts in memory for one episode; no secure context; a
    process whose browser has played a hidden episode plays no train episode."""
    environment = warm("miniwob/copy-paste-v1")

    def fields(obs: dict[str, Any]) -> tuple[dict[str, Any], dict[str, Any], dict[str, Any]]:
        return only(obs, tag="textarea"), only(obs, tag="input_text"), only(obs, tag="button")

    def press(field: dict[str, Any], *keys: str) -> Step:
        environment.step(action("CLICK_ELEMENT", ref=field["ref"]))
        return [environment.step(action("PRESS_KEY", key=KEYS.index(key))) for key in keys][-1]

    source, target, submit = fields(environment.reset(Case(seed=1)))
    press(source, "C-a", "C-c")
    assert fields(press(target, "C-v").obs)[1]["value"] == source["value"] != ""
    assert environment.step(action("CLICK_ELEMENT", ref=submit["ref"])).reward > 0
    target = fields(environment.reset(Case(seed=2)))[1]
    assert fields(press(target, "C-v").obs)[1]["value"] == ""


def test_a_box_is_dragged(warm: Warm) -> None:
    environment = warm("miniwob/drag-box-v1")
    obs = environment.reset(Case(seed=4))
    small, large = only(obs, tag="div", text="s"), only(obs, tag="div", text="L")
    environment.step(action("MOUSEDOWN_COORDS", coords=middle(small)))
    environment.step(action("MOVE_COORDS", coords=middle(large)))
    environment.step(action("MOUSEUP_COORDS", coords=middle(large)))
    assert environment.step(action("CLICK_ELEMENT", ref=only(obs, tag="button")["ref"])).reward > 0


def test_the_reward_counts_steps_and_not_the_wall_clock(warm: Warm) -> None:
    environment = warm("miniwob/click-test-v1")

    def rewarded(idle: int, pause_s: float) -> float:
        obs = environment.reset(Case(seed=1))
        for _ in range(idle):
            environment.step(action("NONE"))
        time.sleep(pause_s)
        return environment.step(action("CLICK_ELEMENT", ref=only(obs, tag="button")["ref"])).reward

    assert rewarded(0, 0.0) == rewarded(0, 1.5) > rewarded(5, 0.0)


def test_a_page_times_out_within_the_limit_of_its_id(warm: Warm) -> None:
    environment = warm("miniwob/click-test-v1")
    environment.reset(Case(seed=1))
    steps = [environment.step(action("NONE"))]
    while not (steps[-1].terminated or steps[-1].truncated):
        steps.append(environment.step(action("NONE")))
    step = steps[-1]
    assert (step.terminated, step.truncated) == (True, False)
    assert (step.reward, step.info["reason"]) == (-1.0, "timed out")
    assert len(steps) == catalogue.entry("miniwob/click-test-v1").max_episode_steps - 1


@pytest.mark.parametrize(
    ("env_id", "grow", "reason"),
    [
        ("miniwob/click-test-v1", "...Array.from({length: 9000}, () => document.createElement('p'))", "too many"),
        ("miniwob/click-test-v1", "'word '.repeat(9000), document.createElement('br')", "cannot be listed"),
        ("browsergym/miniwob.click-test", "...Array.from({length: 9000}, () => document.createElement('p'))", "too many"),  # noqa: E501
    ],
)  # fmt: skip
def test_an_episode_ends_when_its_page_has_grown_too_large(
    warm: Warm, env_id: str, grow: str, reason: str
) -> None:
    environment = warm(env_id)
    nothing = action("NONE") if env_id.startswith("miniwob/") else "noop()"
    first = str(environment.reset(Case(seed=1)))
    shared().run(f"document.body.append({grow})")
    step = environment.step(nothing)
    assert step.terminated
    assert reason in step.info["reason"]
    assert step.reward <= 0
    assert str(environment.reset(Case(seed=1))) == first


def test_the_random_actions_of_checks_name_elements_that_there_are(warm: Warm) -> None:
    environment = warm("miniwob/click-checkboxes-v1")
    obs = environment.reset(Case(seed=1))
    rng = np.random.default_rng(1)
    drawn = [environment.draw(rng, obs) for _ in range(20)]
    refs = {each["ref"] for each in obs["dom_elements"]}
    assert all(each["ref"] in refs | {0} and not environment.action_codec.repair(each)[1] for each in drawn)
    assert len({each["ref"] for each in drawn}) > 3


@pytest.mark.parametrize("env_id", SAMPLE)
def test_an_environment_keeps_what_the_interface_promises(env_id: str) -> None:
    played = conformance.play_checked(env_id, 20)
    assert played.verdict(None) == "ok"


# Episodes in which the browser scrolls a dragged selection, or takes the focus from what is no longer shown, in its own
# time.
@pytest.mark.parametrize(
    ("env_id", "seed", "steps"),
    [("miniwob/text-editor-v1", 20_011_117, 40), ("miniwob/choose-date-v1", 1, 15)],
)
def test_a_drag_and_a_lost_focus_are_waited_for(env_id: str, seed: int, steps: int, warm: Warm) -> None:
    assert len({conformance.digest(warm(env_id), seed, steps) for _ in range(5)}) == 1


# Pages that the end of an episode leaves in the middle of an animation.
@pytest.mark.parametrize(
    ("page", "act"),
    [
        ("click-collapsible-2", action("CLICK_COORDS", coords=np.array([80, 75], np.float32))),
        ("choose-date-easy", action("CLICK_COORDS", coords=np.array([95, 77], np.float32))),
    ],
)
def test_an_animation_that_an_episode_leaves_is_not_in_the_next(page: str, act: dict[str, Any]) -> None:
    environment = MiniWoBEnv(page)

    def seen() -> str:
        first = environment.reset(seed=1)[0]
        return str((first, *(environment.step(each)[0] for each in (act, action("NONE"), action("NONE")))))

    shared().lose()
    fresh = seen()
    for _ in range(2):
        environment.reset(seed=2)
        environment.step(act)
        assert seen() == fresh


@pytest.mark.parametrize("env_id", SAMPLE)
def test_a_text_has_the_page_s_own_instruction_and_no_equations(env_id: str, warm: Warm) -> None:
    text = warm(env_id).description.task_text
    assert "The page's instruction is such as" in text
    assert flags(text) == []


def _played(environment: Environment, lose: Callable[[int], None]) -> list[Step]:
    rng = np.random.default_rng(0)
    environment.reset(Case(seed=11))
    steps = []
    for n in range(8):
        lose(n)
        steps.append(environment.step(environment.action_codec.sample(rng)))
        if steps[-1].terminated:
            break
    return steps


@pytest.mark.parametrize("how", ["the browser is killed", "the page crashes", "the page hangs"])
def test_an_episode_survives_the_loss_of_its_browser(
    warm: Warm, how: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Attack: loops for ever, or fills the memory. Defence: a time limit for each command and a memory
    limit for scripts; the browser is replaced, and the episode is replayed up to that step; a browser
    that has grown is replaced between episodes."""
    environment = warm("miniwob/click-checkboxes-v1")
    undisturbed = _played(environment, lambda n: None)

    def lose(n: int) -> None:
        if n == 3 and how == "the browser is killed":
            os.kill(shared().browser.pid, signal.SIGKILL)
        elif n == 3 and how == "the page hangs":
            monkeypatch.setattr(page_module, "CALL_S", 6.0)
            shared().browser.devtools.send(
                "Runtime.evaluate", shared()._session, wanted=False, expression="for (;;) {}"
            )
        elif n == 4:
            monkeypatch.undo()
        elif n == 3:
            shared().browser.devtools.send("Page.crash", shared()._session, wanted=False)

    disturbed = _played(environment, lose)
    assert len(disturbed) == len(undisturbed) > 4
    for one, other in zip(disturbed, undisturbed, strict=True):
        assert str(one) == str(other)


def test_without_a_browser_the_message_tells_what_to_do(monkeypatch: pytest.MonkeyPatch) -> None:
    chromium.program.cache_clear()
    monkeypatch.setattr(chromium, "_PROGRAMS", ())
    monkeypatch.setenv("PATH", "/nowhere")
    try:
        assert BROWSER in missing("miniwob/click-test-v1")
        with pytest.raises(WorkerError, match=r"needs .*Chromium.*EVOPOLICY_BROWSER"):
            make("miniwob/click-test-v1")
        monkeypatch.setenv(BROWSER, "/etc/passwd")
        assert "/etc/passwd" in missing("miniwob/click-test-v1")
    finally:
        chromium.program.cache_clear()
