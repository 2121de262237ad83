"""Film strips: pictures of an episode at even distances, side by side, drawn from its recorded states.

They are for people who choose. What an export draws is simulated again, and exact.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Final

import mujoco
import numpy as np
from numpy.typing import NDArray

from iris_session.dataset.cameras import CameraSpec, make_view
from iris_session.dataset.posed_scene import PosedScene
from iris_session.recording import Recording
from iris_session.replay.pictures import Image, Renderer, SceneBounds, open_gl, require_shapes
from iris_session.rrd.batches import RecordedState

#: Pictures of an episode, and their size.
N_PICTURES: Final = 7
WIDTH: Final = 160
HEIGHT: Final = 120


def draw_strips(
    path: str | Path, spans_ns: Sequence[tuple[int, int]], cameras: Sequence[CameraSpec] = ()
) -> Iterator[tuple[int, int, Image]]:
    """Draw the film strips of a recording.

    Args:
        path: First file of the recording.
        spans_ns: Session times of the beginning and end of each episode [ns].
        cameras: Those that see it; none: a view of all that moves in the episode.

    Yields:
        Index of the span, index of the camera, and the strip: uint8, shape
        (HEIGHT, N_PICTURES * WIDTH, 3), RGB. Episodes in a scene that was loaded later have none.

    Raises:
        DatasetError: The scene has no such camera.
        PictureError: The scene has nothing that MuJoCo can draw, or there is no OpenGL.
        PhysicsError: The model is of another version of MuJoCo.
        NotARecordingError: The file cannot be read.
    """
    with Recording.open(path, warn=False) as recording:
        scene = PosedScene(recording)
        require_shapes(scene.model, recording)
        moments = _find_moments(recording, spans_ns)
        views = [(make_view(scene.model, camera), camera.fovy) for camera in cameras]
        gl: Any = open_gl(WIDTH, HEIGHT)
        try:
            renderer = Renderer(scene.model, WIDTH, HEIGHT, [], plain=True)
            try:
                for i, states in enumerate(moments):
                    if not states or any(state.bodies != scene.bodies for state in states):
                        continue
                    for j, (view, fovy) in enumerate(views or [(_make_view(scene, states), 0.0)]):
                        yield i, j, _draw(scene, renderer, states, view, fovy)
            finally:
                renderer.close()
        finally:
            gl.free()


def _find_moments(recording: Recording, spans_ns: Sequence[tuple[int, int]]) -> list[list[RecordedState]]:
    """Return the states at the moments of each strip: the newest at that time, or the first of all."""
    due: NDArray[np.float64] = (np.arange(N_PICTURES) + 0.5) / N_PICTURES
    times = [(begin + share * (end - begin), i) for i, (begin, end) in enumerate(spans_ns) for share in due]
    times.sort(reverse=True)
    found: list[list[RecordedState]] = [[] for _ in spans_ns]
    before: RecordedState | None = None
    for state in recording.states():
        while times and state.session_time > times[-1][0]:
            found[times.pop()[1]].append(before or state)
        before = state
    for _, i in reversed(times if before is not None else []):
        assert before is not None
        found[i].append(before)
    return found


def _make_view(scene: PosedScene, states: Sequence[RecordedState]) -> mujoco.MjvCamera:
    bounds = SceneBounds(scene.bodies)
    bounds.positions = [state.poses[bounds.rows, :3] for state in states]
    scene.show(states[0].poses)
    return bounds.make_camera(scene.model, scene.data, WIDTH / HEIGHT)


def _draw(
    scene: PosedScene, renderer: Renderer, states: Sequence[RecordedState], view: mujoco.MjvCamera, fovy: float
) -> Image:
    images = []
    for state in states:
        scene.show(state.poses)
        images.append(renderer.draw(scene.data, view, fovy=fovy))
    return np.concatenate(images, axis=1)
