"""Media from a session's own process, while the session ends."""

from __future__ import annotations

from typing import Any

from iris_session.runtime.publishing import Publishing


class Closing(Publishing):
    """A session whose front has ended, and whose recorder has not."""

    clock = staticmethod(lambda: 0)
    _stepper = None

    def _live(self) -> Any:
        class Processes:
            front = None

        return Processes()


def test_a_camera_thread_that_goes_on_while_the_session_is_closed_is_told_so() -> None:
    assert not Closing().publish_media("cloud", b"points")
