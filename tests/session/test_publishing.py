"""Media from the session's own process: while the session ends, and under reserved names."""

from __future__ import annotations

from typing import Any

import pytest

from iris_session import SceneBuilder, ScenePublisher, SessionConfig
from iris_session.session.session_base import SessionBase


class Closing(SessionBase):
    """A session whose front has ended, and whose recorder has not."""

    clock = staticmethod(lambda: 0)
    _stepper = None

    def _require_started(self) -> Any:
        class Processes:
            front = None

            def own_stream_names(self) -> frozenset[str]:
                return frozenset()

        return Processes()


def test_publish_media_during_close_raises() -> None:
    assert not Closing().publish_media("cloud", b"points")


@pytest.mark.usefixtures("simulation")
def test_stream_names_of_deformables_are_reserved() -> None:
    scene = SceneBuilder()
    scene.add_deformable("cloth", [(0, 0, 1), (0, 1, 1), (1, 0, 1)], [(0, 1, 2)])
    config = SessionConfig(control_port=0, state_port=0, beacon_port=0, record=False, web=False)
    with ScenePublisher(scene, config) as session:
        with pytest.raises(ValueError, match="'deformable-0'"):
            session.publish_media("deformable-0", b"points")
        session.publish_media("deformable-1", b"points")  # of nothing here
