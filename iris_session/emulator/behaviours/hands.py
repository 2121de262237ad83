"""A person who does something with each hand: one behaviour per hand, side by side."""

from __future__ import annotations

from collections.abc import Sequence

from iris_session.emulator.behaviours.base import Behaviour, HandInput, OperatorView


class Hands:
    """Several behaviours as one: done when all are, failed when one is. `phase`: that of the first not yet done."""

    def __init__(self, hands: Sequence[Behaviour]) -> None:
        self._hands = tuple(hands)
        self.phase = self._hands[0].phase
        self.done = False
        self.failed = ""

    def update(self, view: OperatorView) -> tuple[HandInput, ...]:
        """The inputs of all hands; see `Behaviour.update`."""
        inputs = tuple(hand_input for hand in self._hands for hand_input in hand.update(view))
        self.phase = next((hand.phase for hand in self._hands if not hand.done), "done")
        self.done = all(hand.done for hand in self._hands)
        self.failed = next((hand.failed for hand in self._hands if hand.failed), "")
        return inputs
