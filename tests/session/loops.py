"""What the tests of loops with a helper thread share: the thread is real, so they wait for what it does."""

from __future__ import annotations

import time
from collections.abc import Callable

from iris_session.session.stepper import Stepper


def wait_for(condition: Callable[[], object]) -> None:
    """Until it is so; fails after ten seconds."""
    until = time.monotonic() + 10.0
    while not condition():
        assert time.monotonic() < until
        time.sleep(0.001)


class Watch:
    """In place of the processes, which these tests do not need."""

    def supervise(self, stepper: Stepper) -> None:
        pass
