"""The budget ledger against a simple model, and what it refuses."""

from __future__ import annotations

import hypothesis.strategies as st
import pytest
from hypothesis import given
from hypothesis.stateful import RuleBasedStateMachine, invariant, rule

from evopolicy_coordinator.core.contract.reasons import REFUSALS, NotDoneError
from evopolicy_coordinator.core.structures import InvariantError
from evopolicy_coordinator.core.structures.ledger import Ledger, check_request

GRANTED = 40


class LedgerAgainstModel(RuleBasedStateMachine):
    """The model: each submit's size and what became of it."""

    def __init__(self) -> None:
        super().__init__()
        self.ledger = Ledger(GRANTED)
        self.sizes: dict[int, int] = {}
        self.fates: dict[int, str] = {}

    def _charged(self) -> int:
        return sum(n for submit, n in self.sizes.items() if self.fates[submit] != "refunded")

    @rule(submit=st.integers(0, 12), n=st.integers(-1, GRANTED + 1))
    def reserve(self, submit: int, n: int) -> None:
        open_already = self.fates.get(submit) == "reserved"
        if n < 1 or n > GRANTED - self._charged() or open_already:
            with pytest.raises(InvariantError):
                self.ledger.reserve(submit, n)
        elif submit not in self.fates:
            self.ledger.reserve(submit, n)
            self.sizes[submit], self.fates[submit] = n, "reserved"

    @rule(submit=st.integers(0, 12), fate=st.sampled_from(["settled", "refunded"]))
    def end(self, submit: int, fate: str) -> None:
        act = self.ledger.settle if fate == "settled" else self.ledger.refund
        if self.fates.get(submit) == "reserved":
            act(submit)
            self.fates[submit] = fate
        else:
            with pytest.raises(InvariantError):
                act(submit)

    @invariant()
    def agrees_with_the_model(self) -> None:
        by_fate = {
            fate: sum(n for submit, n in self.sizes.items() if self.fates[submit] == fate)
            for fate in ("reserved", "settled")
        }
        assert (self.ledger.reserved, self.ledger.settled) == (by_fate["reserved"], by_fate["settled"])
        assert self.ledger.available == GRANTED - self._charged()
        assert self.ledger.spent == self._charged()


TestLedgerAgainstModel = LedgerAgainstModel.TestCase


@given(ids=st.lists(st.integers(-3, 12), max_size=12), available=st.integers(0, 12))
def test_a_request_is_refused_exactly_when_it_breaks_a_bound(ids: list[int], available: int) -> None:
    refused = None
    try:
        check_request(tuple(ids), n_cases=10, minimum=2, maximum=8, available=available)
    except NotDoneError as error:
        refused = error.reason
    inside = all(0 <= case_id < 10 for case_id in ids)
    fits = 2 <= len(ids) <= min(8, available)
    assert (refused is None) == (inside and fits)
    if refused is not None:
        assert REFUSALS[refused.code][0] == ("budget_invalid" if inside else "invalid_env_instance")
