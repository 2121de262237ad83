"""Media from a session's own process: while the session ends, and under names that are taken."""

from __future__ import annotations

from typing import Any

import pytest

from iris_session import SceneBuilder, ScenePublisher, SessionConfig
from iris_session.session.owner import Owner


class Closing(Owner):
    """A session whose front has ended, and whose recorder has not."""

    clock = staticmethod(lambda: 0)
    _stepper = None

    def _require_started(self) -> Any:
        class Processes:
            front = None

            def own_stream_names(self) -> frozenset[str]:
                return frozenset()

        return Processes()


def test_a_camera_thread_that_goes_on_while_the_session_is_closed_is_told_so() -> None:
    assert not Closing().publish_media("cloud", b"points")


def test_streams_of_what_bends_are_the_sessions_own() -> None:
    scene = SceneBuilder()
    scene.add_deformable("cloth", [(0, 0, 1), (0, 1, 1), (1, 0, 1)], [(0, 1, 2)])
    config = SessionConfig(control_port=0, state_port=0, beacon_port=0, record=False)
    with ScenePublisher(scene, config) as session:
        with pytest.raises(ValueError, match="'deformable-0' carries the vertices of a deformable of the scene"):
            session.publish_media("deformable-0", b"points")
        session.publish_media("deformable-1", b"points")  # of nothing here
