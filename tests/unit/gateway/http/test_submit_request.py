"""Parsing of `POST /submit` bodies."""

from __future__ import annotations

import json
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from evopolicy_common.errors import RequestError
from evopolicy_gateway.submits.submit_request import MAX_BODY_BYTES, Bounds, parse

BOUNDS = Bounds(n_env_instances=64, min_episodes=1, max_episodes=128, remaining_budget=100)


def asked(env_instances: Any, bounds: Bounds = BOUNDS) -> tuple[int, ...]:
    return parse(json.dumps({"env_instances": env_instances}).encode(), bounds)


def refusal(body: bytes, bounds: Bounds = BOUNDS) -> RequestError:
    with pytest.raises(RequestError) as caught:
        parse(body, bounds)
    return caught.value


def status_of(env_instances: Any, bounds: Bounds = BOUNDS) -> str:
    return refusal(json.dumps({"env_instances": env_instances}).encode(), bounds).status


@given(st.lists(st.integers(0, 63), min_size=1, max_size=100))
def test_a_list_keeps_its_order_and_repeats(ids: list[int]) -> None:
    assert asked(ids) == tuple(ids)


@given(st.lists(st.tuples(st.integers(0, 63), st.integers(0, 5)), min_size=1, max_size=15))
def test_a_text_of_ranges_means_the_ids_it_names(parts: list[tuple[int, int]]) -> None:
    ranges = [(first, min(63, first + more)) for first, more in parts]
    text = ",".join(f"{a}-{b}" if a != b else f" {a} " for a, b in ranges)
    assert asked(text) == tuple(i for a, b in ranges for i in range(a, b + 1))


@given(
    st.one_of(
        st.binary(max_size=200), st.text(max_size=200).map(lambda text: text.encode("utf-8", "surrogatepass"))
    )
)
def test_any_bytes_are_parsed_or_refused_with_one_of_two_statuses(body: bytes) -> None:
    try:
        ids = parse(body, BOUNDS)
    except RequestError as error:
        status, message = error.status, error.message
    else:
        status, message = "ok", "taken" if all(0 <= i < 64 for i in ids) else ""
    assert status in ("ok", "budget_invalid", "invalid_env_instance")
    assert message


@given(st.text(alphabet="0123456789-, x", max_size=60))
def test_any_text_gives_at_most_a_submits_worth_of_known_ids(text: str) -> None:
    try:
        ids = asked(text)
    except RequestError:
        return
    assert 1 <= len(ids) <= 100
    assert all(0 <= i < 64 for i in ids)


def test_fields_that_are_not_known_are_ignored() -> None:
    assert parse(b'{"env_instances": [0], "wait": false, "comment": null}', BOUNDS) == (0,)


@pytest.mark.parametrize(
    "body",
    [
        *(b"", b"{", b"[0]", b"null", b"3", b"{}", b'{"env_instances": null}', b'{"env_instances": {}}'),
        *(b'{"env_instances": 3}', b'{"env_instance": [1]}'),
        *(b"\xff\xfe", b'{"env_instances": [NaN]}', b"[" * 100_000),
    ],
)
def test_a_broken_form_is_budget_invalid(body: bytes) -> None:
    error = refusal(body)
    assert error.status == "budget_invalid"
    assert "env_instances" in error.message


@pytest.mark.parametrize("value", [[], "", "  ", [0] * 101, "0-63,0-63", [0] * 129])
def test_a_number_of_episodes_out_of_bounds_is_budget_invalid(value: Any) -> None:
    assert status_of(value) == "budget_invalid"


@pytest.mark.parametrize(
    "value",
    [
        *([64], [-1], [0, 1.0], [True], ["3"], [None], [[0]], [10**30]),
        *("64", "-1", "3-1", "0--3", "1-", "a", "0,,1", "0,", "0x1", "1 2", "٣", "0-999999999999", "9" * 500),
    ],
)
def test_a_wrong_id_is_an_invalid_env_instance(value: Any) -> None:
    assert status_of(value) == "invalid_env_instance"


def test_messages_name_the_value_and_the_remedy() -> None:
    assert "'7-3'" in refusal(b'{"env_instances": "0,7-3"}').message
    assert "'3-7'" in refusal(b'{"env_instances": "0,7-3"}').message
    assert "env_instances[1] is 64" in refusal(b'{"env_instances": [0, 64]}').message
    assert "0 to 63" in refusal(b'{"env_instances": [0, 64]}').message
    assert "101 episodes asked for" in refusal(json.dumps({"env_instances": [0] * 101}).encode()).message


def test_a_spent_budget_says_so() -> None:
    spent = Bounds(n_env_instances=64, min_episodes=4, max_episodes=128, remaining_budget=3)
    error = refusal(b'{"env_instances": "0-3"}', spent)
    assert error.status == "budget_invalid"
    assert "spent" in error.message


def test_a_submit_below_the_minimum_is_budget_invalid() -> None:
    assert (
        status_of([1, 2], Bounds(n_env_instances=9, min_episodes=3, max_episodes=9, remaining_budget=9))
        == "budget_invalid"
    )


def test_a_body_that_is_too_long_is_refused_whatever_it_holds() -> None:
    body = b'{"env_instances": [0' + b" " * MAX_BODY_BYTES + b"]}"
    assert refusal(body).status == "budget_invalid"
    assert "1,048,576" in refusal(body).message


def test_the_longest_text_of_ranges_is_counted_without_being_written_out() -> None:
    body = json.dumps({"env_instances": ",".join(["0-63"] * 150_000)}).encode()
    assert len(body) < MAX_BODY_BYTES
    assert refusal(body).message.startswith("9600000 episodes")


@settings(max_examples=50, deadline=None)
@given(
    st.sampled_from(['{"env_instances": "%s"}', '{"env_instances": ["%s"]}', "%s", '{"%s": 1}']),
    st.lists(st.sampled_from([" ", "7", "-", ",", "99", "x"]), max_size=6),
)
def test_no_refusal_repeats_a_long_request(form: str, pieces: list[str]) -> None:
    message = ""
    try:
        parse(
            (form % "".join(piece * (300_000 if piece in " x" else 1) for piece in pieces)).encode()[
                :MAX_BODY_BYTES
            ],
            BOUNDS,
        )
    except RequestError as error:
        message = error.message
    assert len(message) < 600
