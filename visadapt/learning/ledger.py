"""The ledger: every step of a target, and what it was for."""

from __future__ import annotations

from dataclasses import dataclass, field


class BudgetExceeded(RuntimeError):
    """More steps of the target were asked for than the budget has left."""


@dataclass
class Ledger:
    """Counts the steps of a target. Only the final evaluation is free, and is not entered."""

    budget: int  # steps of the target allowed in all
    entries: list[tuple[str, int]] = field(default_factory=list)  # (purpose, steps), in order

    @property
    def used(self) -> int:
        """Steps counted so far."""
        return sum(steps for _, steps in self.entries)

    @property
    def left(self) -> int:
        """Steps that may still be taken."""
        return self.budget - self.used

    def count(self, purpose: str, steps: int) -> None:
        """Enter `steps` of the target; raises BudgetExceeded, and enters none, where the budget has fewer left."""
        if steps > self.left:
            raise BudgetExceeded(f"{purpose}: {steps} target steps asked for, {self.left} of {self.budget} are left")
        self.entries.append((purpose, steps))
