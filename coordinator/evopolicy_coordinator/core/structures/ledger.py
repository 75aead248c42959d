"""A run's episode budget: reserve, then settle or refund, each exactly once.

Rules that this module owns:
- `available + reserved + settled == granted`, always.
- A reservation is named by its submit. A second reservation of the same submit, or settling an unreserved one, is a bug
  and raises InvariantError.
- A submit that the protocol refuses is refused before anything is reserved.
"""

from __future__ import annotations

from evopolicy_coordinator.core.contract.reasons import NotDoneError
from evopolicy_coordinator.core.structures import InvariantError


class Ledger:
    """Counts train episodes; knows nothing of their use."""

    def __init__(self, granted: int) -> None:
        self.granted = granted
        self.available = granted
        self.settled = 0
        self._reservations: dict[int, int] = {}

    @property
    def reserved(self) -> int:
        """Episodes of submits without a verdict."""
        return sum(self._reservations.values())

    @property
    def spent(self) -> int:
        """Episodes that no later submit can use: reserved or settled."""
        return self.granted - self.available

    def reserve(self, submit_index: int, n: int) -> None:
        """Set `n` episodes aside for a submit. Raises InvariantError when `n` is not 1 … `available`, or the
        submit has a reservation."""
        if n < 1 or n > self.available or submit_index in self._reservations:
            raise InvariantError(f"cannot reserve {n} for submit {submit_index}: {self}")
        self.available -= n
        self._reservations[submit_index] = n

    def settle(self, submit_index: int) -> None:
        """Charge a submit's reservation. Raises InvariantError when it has none."""
        self.settled += self._take(submit_index)

    def refund(self, submit_index: int) -> None:
        """Give a submit's reservation back. Raises InvariantError when it has none."""
        self.available += self._take(submit_index)

    def _take(self, submit_index: int) -> int:
        n = self._reservations.pop(submit_index, None)
        if n is None:
            raise InvariantError(f"nothing is reserved for submit {submit_index}: {self}")
        return n

    def __repr__(self) -> str:
        return (
            f"Ledger(granted={self.granted}, available={self.available}, reserved={self._reservations}, "
            f"settled={self.settled})"
        )


def check_request(
    env_instances: tuple[int, ...], *, n_cases: int, minimum: int, maximum: int, available: int
) -> None:
    """Raises NotDoneError if these train cases cannot be played. Checks in the protocol's order."""
    n = len(env_instances)
    for case_id in env_instances:
        if not 0 <= case_id < n_cases:
            raise NotDoneError("unknown_case", case=case_id, last=n_cases - 1)
    if n < minimum:
        raise NotDoneError("too_few", n=n, least=minimum)
    if n > maximum:
        raise NotDoneError("too_many", n=n, most=maximum)
    if n > available:
        raise NotDoneError("over_budget", n=n, remaining=available)
