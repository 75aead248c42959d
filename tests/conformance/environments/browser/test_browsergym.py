"""MiniWoB++ as BrowserGym plays it, in a real browser: what its calls do, and what a text that is none does."""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from test_environment_task_texts import flags

from evopolicy_common import catalogue
from evopolicy_common.messages.environment import Case
from evopolicy_worker.environments import Environment
from evopolicy_worker.environments.browser.browsergym_calls import DEFAULTS, SIGNATURES, calls
from evopolicy_worker.environments.browser.browsergym_env import BrowserGymEnv
from evopolicy_worker.environments.browser.page import shared
from evopolicy_worker.environments.checks import conformance

pytestmark = pytest.mark.families

Warm = Callable[[str], Environment]
SAMPLE = (
    "browsergym/miniwob.click-menu-2",
    "browsergym/miniwob.choose-list",
    "browsergym/miniwob.use-colorwheel-2",
)


@pytest.fixture(scope="module", autouse=True)
def browser() -> Iterator[None]:
    """This process's browser ends with this file."""
    yield
    shared().lose()


def nodes(obs: dict[str, Any], role: str) -> list[dict[str, Any]]:
    """Nodes of the accessibility tree with that role."""
    return [each for each in json.loads(obs["axtree_object"])["nodes"] if each["role"]["value"] == role]


def bid(node: dict[str, Any]) -> str:
    return str(node["browsergym_id"])


def test_a_form_is_filled_and_sent_in_one_action_of_several_calls(warm: Warm) -> None:
    environment = warm("browsergym/miniwob.enter-password")
    obs = environment.reset(Case(seed=1))
    password = obs["goal"].split('"')[1]
    fields = nodes(obs, "textbox")
    step = environment.step("\n".join(f"fill({bid(each)!r}, {password!r})" for each in fields))
    assert [each["value"]["value"] for each in nodes(step.obs, "textbox")] == [password, password]
    assert (step.obs["last_action_error"], step.reward, step.terminated) == ("", 0.0, False)
    step = environment.step(f"click({bid(nodes(obs, 'button')[0])!r})")
    assert (step.reward, step.terminated, step.info["success"]) == (1.0, True, True)


def test_no_key_brings_back_what_was_typed_in_an_earlier_episode(warm: Warm) -> None:
    environment = warm("browsergym/miniwob.enter-text")
    (field,) = nodes(environment.reset(Case(seed=1)), "textbox")
    step = environment.step(f"click({bid(field)!r})\nkeyboard_type('kept')")
    assert nodes(step.obs, "textbox")[0]["value"]["value"] == "kept"
    (field,) = nodes(environment.reset(Case(seed=2)), "textbox")
    for keys in ("Control+z", "Control+z", "Control+y", "Control+Shift+z"):
        step = environment.step(f"click({bid(field)!r})\nkeyboard_press({keys!r})")
        assert step.obs["last_action_error"] == ""
        assert "value" not in nodes(step.obs, "textbox")[0]


@pytest.mark.parametrize("load", ["once", "each"])
@pytest.mark.parametrize(
    ("kept", "pasted"),
    [
        ("fill(F, 'kept')\npress(F, 'Control+a')\npress(F, 'Control+c')", "press(F, 'Control+v')"),
        ("mouse_drag_and_drop(5, 5, 400, 310)", "click(F, button='middle')"),
    ],
)
def test_no_paste_brings_back_a_text_of_an_earlier_episode(load: Any, kept: str, pasted: str) -> None:
    environment = BrowserGymEnv("enter-text", load=load)
    (field,) = nodes(environment.reset(seed=1)[0], "textbox")
    environment.step(kept.replace("F", repr(bid(field))))
    environment.reset(seed=2)
    obs = environment.step(pasted.replace("F", repr(bid(field))))[0]
    assert obs["last_action_error"] == ""
    assert "value" not in nodes(obs, "textbox")[0]


@pytest.mark.parametrize(
    ("name", "act"),
    [
        ("choose-date", "mouse_click(80, 100)"),
        ("terminal", "mouse_click(100, 150) keyboard_down('Control') keyboard_press('a')"),
        ("use-colorwheel", "mouse_click(84, 112) mouse_click(84, 196)"),
        ("use-colorwheel-2", "mouse_click(84, 112) mouse_click(84, 196)"),
    ],
)
def test_an_episode_leaves_nothing_in_its_page(warm: Warm, name: str, act: str) -> None:
    environment = warm(f"browsergym/miniwob.{name}")

    def seen() -> list[str]:
        first = environment.reset(Case(seed=1))
        second = environment.step("mouse_click(100, 150) keyboard_type('ls')").obs
        return [
            each[key] for each in (first, second) for key in ("axtree_object", "extra_element_properties")
        ]

    undisturbed = seen()
    environment.reset(Case(seed=2))
    environment.step(act)
    assert seen() == undisturbed


@pytest.mark.parametrize(
    ("page", "seed", "before", "then"),
    [
        # The mouse moves the focus, and a ring shows the next one or does not.
        ("enter-text", 1, "mouse_click(100, 100)", "focus('15')"),
        ("enter-text", 1, "mouse_click(100, 100)", "keyboard_press('Tab')"),
        ("enter-text", 1, "focus('15') keyboard_down('Space')", "mouse_move(80, 135)"),
        ("enter-text", 1, "mouse_down(200, 200, 'middle') mouse_down(100, 200)", "mouse_move(80, 135)"),
        # A field remembers what was selected in it.
        ("use-spinner", 1, "mouse_dblclick(30, 105)", "focus('18')"),
        # Whether a place between two pixels is in the line above depends on earlier drags.
        ("click-dialog-2", 31001, "drag_and_drop('17', '23')", "drag_and_drop('17', '23')"),
        # Boxes with errors of rounding, and a listener that stays.
        ("click-button", 31001, "mouse_click(230, 16)", "noop()"),
        ("search-engine", 31001, "click('16')", "noop()"),
    ],
)
def test_a_reused_page_looks_like_a_fresh_one(page: str, seed: int, before: str, then: str) -> None:
    environment = BrowserGymEnv(page, screenshot=True, **catalogue.entry(f"browsergym/miniwob.{page}").kwargs)

    def seen() -> str:
        state = hashlib.sha256()
        conformance.add(state, environment.reset(seed=seed)[0])
        conformance.add(state, environment.step(then)[0])
        return state.hexdigest()

    shared().lose()
    fresh = seen()
    for other in (seed, seed + 1, seed, seed + 1):
        environment.reset(seed=other)
        environment.step(before)
        assert seen() == fresh


def test_the_mouse_does_not_rest_on_a_scrollbar(warm: Warm) -> None:
    warm("browsergym/miniwob.enter-text").reset(Case(seed=1))
    assert shared().run("document.documentElement.scrollWidth > innerWidth")
    shared().rest()
    time.sleep(0.4)
    assert shared().run("scrollX") == 0


@pytest.mark.parametrize("button", ["left", "middle", "right"])
@pytest.mark.parametrize("way", ["click", "hold", "drag"])
def test_a_press_on_a_scrollbar_does_nothing(warm: Warm, way: str, button: str) -> None:
    for name, x, y in (("enter-time", 492, 312), ("email-inbox", 212, 276)):
        environment = warm(f"browsergym/miniwob.{name}")
        environment.reset(Case(seed=1))
        act = {
            "click": f"mouse_click({x}, {y}, {button!r})",
            "hold": f"mouse_down({x}, {y}, {button!r})",
            "drag": f"mouse_down({x}, {y - 100}, {button!r}) mouse_up({x}, {y}, {button!r})",
        }[way]
        assert shared().run(f"__evopolicy.bar({x}, {y})")
        step = environment.step(act)
        time.sleep(0.6)
        assert step.obs["last_action_error"] == ""
        assert json.loads(environment.step("noop()").obs["extra_element_properties"]) == json.loads(
            step.obs["extra_element_properties"]
        )
        assert not shared().run(
            "[...document.querySelectorAll('*')].some((e) => e.scrollTop || e.scrollLeft)"
        )


@pytest.mark.parametrize("page", ["copy-paste", "text-editor"])
def test_a_text_that_grows_with_each_paste_stays_short(page: str) -> None:
    environment = BrowserGymEnv(page)
    tree = json.loads(environment.reset(seed=1)[0]["axtree_object"])["nodes"]
    field = next(bid(each) for each in tree if any(each["name"] == "editable" for each in each["properties"]))
    keys = ("Control+a", "Control+c", "ArrowRight", *["Control+v"] * 9)
    for _ in range(9):
        step = environment.step(
            "\n".join([f"focus({field!r})", *(f"keyboard_press({each!r})" for each in keys)])
        )
    assert 5_000 < len(step[0]["axtree_object"]) < 400_000
    assert step[2] is False


def test_an_option_is_selected_by_its_label(warm: Warm) -> None:
    environment = warm("browsergym/miniwob.choose-list")
    obs = environment.reset(Case(seed=2))
    wanted = obs["goal"].removeprefix("Select ").removesuffix(" from the list and click Submit.")
    (box,) = nodes(obs, "combobox")
    step = environment.step(f"select_option({bid(box)!r}, {wanted!r})")
    assert nodes(step.obs, "combobox")[0]["value"]["value"] == wanted
    assert environment.step(f"click({bid(nodes(obs, 'button')[0])!r})").reward == 1.0


def test_a_click_by_place_is_a_click_on_what_is_there(warm: Warm) -> None:
    environment = warm("browsergym/miniwob.click-test-2")
    obs = environment.reset(Case(seed=3))
    target = next(each for each in nodes(obs, "button") if each["name"]["value"] in obs["goal"])
    x, y, width, height = json.loads(obs["extra_element_properties"])[bid(target)]["bbox"]
    assert environment.step(f"mouse_click({x + width / 2}, {y + height / 2})").reward == 1.0


def test_a_drawing_that_the_page_fills_later_is_an_image(warm: Warm) -> None:
    obs = warm("browsergym/miniwob.stock-market").reset(Case(seed=1))
    (drawing,) = nodes(obs, "image")
    children = [each for each in nodes(obs, "graphics-symbol") if each["parentId"] == drawing["nodeId"]]
    assert children


@pytest.mark.parametrize(
    ("action", "error"),
    [
        ("", "empty action"),
        ("I would click the button", "no function call"),
        ("__import__('os').system('true')", "'__import__': it does not exist"),
        ("click(button)", "no function call"),
        ("click(__import__('os'))", "'__import__': it does not exist"),
        ("goto('http://localhost')", "leaves the page"),
        ("jump('1')", "does not exist"),
        ("click()", "misses its argument 'bid'"),
        ("click('1', '2', [], 4)", "click takes bid"),
        ("click(12)", "not of the right type"),
        ("mouse_click(1e999, 0)", "not of the right type"),
        ("keyboard_type('\\ud800')", "not of the right type"),
        ("click('999999')", "Could not find"),
        ("fill('10', 'a')", "not an <input>"),
        ("fill('8', 'a')", "not visible"),
        ("select_option('14', 'a')", "not a <select>"),
        ("check('14')", "no checkbox"),
        ("keyboard_press('Nonsense')", "Unknown key"),
        ("keyboard_press('')", "Unknown key"),
        ("keyboard_press('Shift+')", "Unknown key"),
        ("click('14', modifiers=['Caps'])", "modifiers has 'Caps'"),
        ("click('14', button='fourth')", "left, middle or right"),
        ("noop()\n" * 40, "32 are the limit"),
        ("(" * 4000, "no function call"),
    ],
)
def test_what_cannot_be_done_is_reported_and_the_episode_goes_on(warm: Warm, action: str, error: str) -> None:
    """Attack: opens windows, blocks with `alert`, or navigates to another page, also through a policy's
    clicks and keys. Defence: one window; dialogs are dismissed; navigation ends the episode; calls such
    as `goto` are refused."""
    environment = warm("browsergym/miniwob.enter-text")
    environment.reset(Case(seed=1))
    step = environment.step(action)
    assert error in step.obs["last_action_error"]
    assert (step.reward, step.terminated) == (0.0, False)
    assert environment.step("noop(100)").obs["last_action_error"] == ""


def test_every_call_can_be_made(warm: Warm) -> None:
    environment = warm("browsergym/miniwob.enter-text")
    obs = environment.reset(Case(seed=1))
    field = bid(nodes(obs, "textbox")[0])
    values = {"key": "a", "key_comb": "Control+a", "value": "b", "text": "c"}
    values |= dict.fromkeys(("bid", "from_bid", "to_bid"), field)
    skipped = {"report_infeasible", "select_option", "check", "uncheck"}
    for name in SIGNATURES.keys() - skipped:
        given = [f"{each}={values.get(each, 50)!r}" for each in SIGNATURES[name] if each not in DEFAULTS]
        step = environment.step(f"{name}({', '.join(given)})")
        assert step.obs["last_action_error"] == "", name
    step = environment.step("report_infeasible('no')")
    assert (step.reward, step.terminated) == (0.0, True)


def test_a_snapshot_of_the_documents_comes_on_request_and_repeats() -> None:
    environment = BrowserGymEnv("enter-text", dom_object=True)

    def episode(seed: int) -> list[str]:
        first, _ = environment.reset(seed=seed)
        (field,) = nodes(first, "textbox")
        second = environment.step(f"fill({bid(field)!r}, 'typed')")[0]
        assert second.keys() == environment.observation_space.spaces.keys()  # type: ignore[attr-defined]
        return [first["dom_object"], second["dom_object"]]

    first = episode(1)
    episode(2)
    assert episode(1) == first
    shot = json.loads(first[1])
    strings, document = shot["strings"], shot["documents"][0]
    names = [strings[each] for each in document["nodes"]["nodeName"]]
    assert {"HTML", "BODY", "INPUT", "BUTTON", "SCRIPT"} <= set(names)
    values = document["nodes"]["inputValue"]
    typed = {
        names[index]: strings[value] for index, value in zip(values["index"], values["value"], strict=True)
    }
    assert typed["INPUT"] == "typed"
    assert not any("function" in each for each in strings)
    assert (
        len(document["nodes"]["backendNodeId"]) == len(set(document["nodes"]["backendNodeId"])) == len(names)
    )
    assert "dom_object" not in BrowserGymEnv("enter-text").observation_space.spaces  # type: ignore[attr-defined]


@pytest.mark.parametrize(
    ("pressed", "typed"),
    [
        ("keyboard_press('Shift+a') keyboard_press('Shift+1') keyboard_press('Shift+KeyB')", "A!B"),
        ("keyboard_down('Shift') keyboard_press('a') keyboard_up('Shift') keyboard_press('a')", "Aa"),
        (
            "keyboard_press('+') keyboard_press('Shift++') keyboard_press('Numpad7') keyboard_press('é')",
            "++7é",
        ),
        ("keyboard_type('aB é中😀')", "aB é中😀"),
        (
            "keyboard_type('ab') keyboard_press('Control+a') keyboard_press('Backspace') keyboard_type('c')",
            "c",
        ),
    ],
)
def test_keys_type_what_they_do_in_browsergym(warm: Warm, pressed: str, typed: str) -> None:
    environment = warm("browsergym/miniwob.enter-text")
    (field,) = nodes(environment.reset(Case(seed=1)), "textbox")
    step = environment.step(f"focus({bid(field)!r}) {pressed}")
    assert step.obs["last_action_error"] == ""
    assert nodes(step.obs, "textbox")[0]["value"]["value"] == typed


def test_options_of_a_list_are_clicked_also_several_with_a_key_held(warm: Warm) -> None:
    environment = warm("browsergym/miniwob.click-scroll-list")
    first, *_, last = nodes(environment.reset(Case(seed=1)), "option")

    def selected(step: Any) -> list[str]:
        assert step.obs["last_action_error"] == ""
        return [
            bid(option)
            for option in nodes(step.obs, "option")
            if any(each["name"] == "selected" and each["value"]["value"] for each in option["properties"])
        ]

    assert selected(environment.step(f"click({bid(first)!r})")) == [bid(first)]
    step = environment.step(f"click({bid(last)!r})")
    assert selected(step) == [bid(last)]
    properties = json.loads(step.obs["extra_element_properties"])
    assert (properties[bid(first)]["visibility"], properties[bid(last)]["visibility"]) == (0, 1)
    x, y, width, height = properties[bid(last)]["bbox"]
    above = f"mouse_click({x + width / 2}, {y - height / 2})"
    assert len(selected(environment.step(f"keyboard_down('Control') {above} keyboard_up('Control')"))) == 2
    assert len(selected(environment.step(above))) == 1


def test_keys_find_an_option_by_the_episode_s_time(warm: Warm) -> None:
    environment = warm("browsergym/miniwob.choose-list")

    def chosen(pause_s: float, steps: int) -> str:
        (box,) = nodes(environment.reset(Case(seed=2)), "combobox")
        shared().run(
            "document.querySelector('select').innerHTML = '<option>x</option><option>ab</option><option>b</option>'"
        )
        environment.step(f"focus({bid(box)!r}) keyboard_press('a')")
        time.sleep(pause_s)
        for _ in range(steps):
            environment.step("mouse_move(5, 5)")
        return str(nodes(environment.step("keyboard_press('b')").obs, "combobox")[0]["value"]["value"])

    assert [chosen(0.0, 0), chosen(1.2, 0), chosen(0.0, 5)] == ["ab", "ab", "b"]


def test_a_held_arrow_counts_by_the_episodes_clock(warm: Warm) -> None:
    environment = warm("browsergym/miniwob.guess-number")

    def counted(pause_s: float, then: str) -> list[str]:
        obs = environment.reset(Case(seed=1))
        (field,) = nodes(obs, "spinbutton")
        left, top, width, height = json.loads(obs["extra_element_properties"])[bid(field)]["bbox"]
        found = []
        for act in (f"mouse_down({left + width - 12}, {top + height / 4})", "noop(0)", then, "noop(0)"):
            (field,) = nodes(environment.step(act).obs, "spinbutton")
            time.sleep(pause_s)
            found.append(field["value"]["value"])
        return found

    for pause_s in (0.0, 0.5):
        assert counted(pause_s, "noop(0)") == ["1", "5", "9", "13"]
        assert counted(pause_s, "mouse_up(5, 5)") == ["1", "5", "5", "5"]


def test_nothing_is_typed_elsewhere_when_a_field_cannot_be_filled(warm: Warm) -> None:
    environment = warm("browsergym/miniwob.enter-password")
    one, other = nodes(environment.reset(Case(seed=1)), "textbox")
    environment.step(f"fill({bid(one)!r}, 'kept')")
    shared().run(f"document.querySelector('[bid=\"{bid(other)}\"]').style.visibility = 'hidden'")
    step = environment.step(f"focus({bid(one)!r}) fill({bid(other)!r}, 'lost')")
    assert "not visible" in step.obs["last_action_error"]
    assert [each["value"]["value"] for each in nodes(step.obs, "textbox")] == ["kept"]


def test_calls_are_found_in_other_words_and_never_run() -> None:
    text = """I'd click('3') now: fill('4', "two
lines")  # click('5')
```
hover(
    bid='6',  # the second
)```"""
    assert [(name, *given.values()) for name, given in calls(text)] == [
        ("click", "3", "left", []),
        ("fill", "4", "two\nlines"),
        ("hover", "6"),
    ]
    assert calls("click('3')\nfill(bid='4', value='x')") == [
        ("click", {"bid": "3", "button": "left", "modifiers": []}),
        ("fill", {"bid": "4", "value": "x"}),
    ]


@pytest.mark.parametrize("env_id", SAMPLE)
def test_the_random_actions_of_checks_are_calls_that_do_something(env_id: str, warm: Warm) -> None:
    rng = np.random.default_rng(1)
    errors = []
    for seed in range(6):
        obs = warm(env_id).reset(Case(seed=seed))
        for _ in range(5):
            action = warm(env_id).draw(rng, obs)
            assert calls(action)
            step = warm(env_id).step(action)
            obs = step.obs
            errors.append(obs["last_action_error"])
            if step.terminated:
                break
    assert errors.count("") > 0.7 * len(errors)


@pytest.mark.parametrize("env_id", SAMPLE)
def test_an_environment_keeps_what_the_interface_promises(env_id: str) -> None:
    assert conformance.play_checked(env_id, 10).verdict(None) == "ok"


@pytest.mark.parametrize("env_id", SAMPLE)
def test_the_goal_names_what_the_page_only_shows(env_id: str, warm: Warm) -> None:
    environment = warm(env_id)
    assert flags(environment.description.task_text) == []
    goals = [environment.reset(Case(seed=seed))["goal"] for seed in range(6)]
    assert all(goals)
    if "colorwheel" in env_id:
        assert all("#" in goal for goal in goals)
    if "menu-2" in env_id:
        assert all(goal.count('"') == 4 for goal in goals)


def test_the_two_families_have_the_same_pages_but_three() -> None:
    suites = catalogue.suites()
    ours = {each.removeprefix("miniwob/").removesuffix("-v1") for each in suites["miniwob"].environments}
    theirs = {each.removeprefix("browsergym/miniwob.") for each in suites["browsergym"].environments}
    assert (len(ours), len(theirs), theirs - ours) == (128, 125, set())
