"""The process of model cameras: `python -m iris_session.cameras.process`, with `PicturesStart` on standard input.

It joins the session in the role `camera`, sees the states that clients see, and publishes pictures of them. It runs at
low priority, beside the session and not in it: a picture that takes long makes no tick late. For another model the
session starts another process.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Final

from iris_session.cameras.drawing import CameraDrawing, SeenState
from iris_session.client.client import Client
from iris_session.client.core.state_stream import SceneState
from iris_session.client.deformables import Deformables
from iris_session.client.errors import ClientError
from iris_session.cloud.model_camera import PicturesStart
from iris_session.cloud.process import CONNECT_S, POLL_S, REPORT_S, OnReport, SessionSink, join_session, run_process
from iris_session.journal.rows import unpack_model
from iris_session.physics.load import decode_model
from iris_session.protocol.status import DeliveryBudget
from iris_session.replay.pictures import PictureError

#: Name of the participant.
NAME: Final = "pictures"
#: Time between two looks for a newer state [s].
STATE_POLL_S: Final = 0.002


class StateWatch:
    """The newest state of a client, with the bodies that its poses are of. `on_state` runs in the client's thread."""

    def __init__(self, client: Client) -> None:
        self._client = client
        self.newest: SeenState | None = None

    def on_state(self, state: SceneState) -> None:
        """Take a state of the client."""
        poses = self._client.scene.poses
        if poses is not None:
            self.newest = SeenState(state.header.session_time, poses, self._client.mirror.bodies)


def run_pictures(start: PicturesStart, client: Client, on_report: OnReport, is_ending: Callable[[], bool]) -> str:
    """Publish pictures until the end.

    Args:
        start: Cameras and model.
        client: In role `camera`, not connected yet; it is closed at the end.
        on_report: Called about once a second.
        is_ending: Asked several times a second.

    Returns:
        Why it ended by itself, empty otherwise.
    """
    watch = StateWatch(client)
    client.on_state = watch.on_state
    model = decode_model(unpack_model(start.packed_model))
    try:
        drawing = CameraDrawing(model, start.cameras, SessionSink(client), plain=start.plain)
    except PictureError as error:
        return str(error)
    try:
        client.open()
        client.start()
        shapes = Deformables(client) if model.nflex else None
        return _publish(start, client, watch, drawing, shapes, on_report, is_ending)
    except ClientError as error:
        return str(error)
    finally:
        client.close()
        drawing.close()


def _publish(
    start: PicturesStart,
    client: Client,
    watch: StateWatch,
    drawing: CameraDrawing,
    shapes: Deformables | None,
    on_report: OnReport,
    is_ending: Callable[[], bool],
) -> str:
    session_id, report_at = "", 0.0
    while not is_ending():
        connected = client.wait_for(lambda one: one.ready, CONNECT_S)
        welcome = client.connection.welcome
        if connected and welcome is not None and welcome.session_id != session_id:
            drawing.restart_clock()
            session_id, watch.newest = welcome.session_id, None
        if connected:
            if fault := find_taken_stream(start, client.media.delivery):
                return fault
            state, now_ns = watch.newest, client.session_now_ns()
            if shapes is not None:
                shapes.update()
                state = state._replace(vertices=shapes.vertices) if state is not None else None
            wait_s = drawing.find_wait_s(now_ns)
            if state is None or wait_s > 0.0 or not drawing.poll(state, now_ns):
                time.sleep(min(max(wait_s, STATE_POLL_S), POLL_S))
        if time.monotonic() >= report_at:
            report_at = time.monotonic() + REPORT_S
            on_report(drawing.make_report(client.session_now_ns(), connected=connected))
    return ""


def find_taken_stream(start: PicturesStart, delivery: DeliveryBudget | None) -> str:
    """Return one line for people about a stream that another source has, empty while there is none."""
    ours = {one.stream for one in start.cameras}
    taken = [one for one in (delivery.streams if delivery else ()) if one.taken_by and one.stream in ours]
    return f"the stream {taken[0].stream!r} has another source already, {taken[0].taken_by}: end it" if taken else ""


def run_start(start: PicturesStart, on_report: OnReport, is_ending: Callable[[], bool]) -> str:
    """Publish pictures in the session of a start configuration; return why it ended by itself."""
    return join_session(start, NAME, on_report, lambda client: run_pictures(start, client, on_report, is_ending))


if __name__ == "__main__":
    run_process(PicturesStart, run_start)
