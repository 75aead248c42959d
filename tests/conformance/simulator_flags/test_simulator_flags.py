"""Disguised simulators are flagged, honest agents are not; `simulator_rates.py` prints both rates."""

from __future__ import annotations

from simulator_rates import agents, corpus, examples, library, rate


def test_simulators_at_hand_are_flagged() -> None:
    assert rate(corpus("tuned", "simulators")).passed == []


def test_most_simulators_that_were_held_out_are_flagged() -> None:
    found = rate(corpus("held_out", "simulators"))
    assert len(found.flagged) + len(found.passed) >= 15
    assert len(found.flagged) >= 13, found.passed


def test_honest_agents_are_not_flagged() -> None:
    for part in ("tuned", "held_out"):
        found = rate(corpus(part, "honest"))
        assert len(found.passed) >= 15
        assert found.flagged == []


def test_our_examples_and_agents_raise_no_false_alarm() -> None:
    assert rate(examples(rehearsing=False)).flagged == []
    assert rate(agents()).flagged == []


def test_examples_that_play_in_a_model_are_flagged() -> None:
    assert rate(examples(rehearsing=True)).passed == []


def test_environments_of_a_library_are_flagged_without_their_imports() -> None:
    found = rate(library())
    assert len(found.flagged) >= 8, found.passed
