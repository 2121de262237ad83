"""Renders one moment of a recording to a picture, by re-simulating its journal up to there.

    MUJOCO_GL=egl python tools/render_recording.py sessions/*-handover/session.rrd docs/img/handover.png

The moment is the middle of the first handover, or `--at` seconds of session time. Heads and hands of the participants
are drawn where the session had them. Only recordings of class `closed` can be re-simulated.
"""

from __future__ import annotations

import argparse
from itertools import takewhile
from pathlib import Path
from typing import Any

import cv2
import mujoco
import numpy as np

from iris_session.protocol.entries import decode_entries
from iris_session.protocol.names import Device
from iris_session.protocol.server_messages import Handover, PresenceItem
from iris_session.recording import CLOSED, Recording
from iris_session.session.verification import ReplayCore

#: The detector reports a handover when the receiver has held the object alone for this long [s].
REPORTED_AFTER_S = 0.1
#: Colours of participants in the order of their names, RGB.
COLOURS = ((0.90, 0.62, 0.0), (0.34, 0.71, 0.91), (0.0, 0.62, 0.45), (0.80, 0.47, 0.65))
HEAD_SIZE = (0.08, 0.05, 0.04)  # half extents of the box drawn for a headset [m]
HAND_SIZE = (0.02, 0.02, 0.05)


def moment_ns(recording: Recording) -> int:
    """Session time of the middle of the first handover. Raises `SystemExit` when there is none."""
    for event in recording.events():
        if isinstance(event.body, Handover):
            return event.session_time - int(REPORTED_AFTER_S * 1e9) - event.body.duration_ns // 2
    raise SystemExit("no handover in this recording: give --at SECONDS")


def simulate(recording: Recording, until_ns: int) -> ReplayCore:
    """The session at `until_ns`, from the last keyframe before."""
    core = ReplayCore(recording.header, recording.model)
    rows = {row.step: row for row in takewhile(lambda row: row.now_ns <= until_ns, recording.rows())}
    newest = max((k for k in recording.keyframes() if k.step in rows), key=lambda k: k.step, default=None)
    if newest is not None:
        core.restore(newest)
    for step, row in rows.items():
        if newest is not None and step <= newest.step:
            continue
        core.step(row.now_ns, decode_entries(row.entries), row.n_ticks)
    return core


def people(recording: Recording, at_ns: int) -> list[PresenceItem]:
    """Newest pose of every head and hand of those who moved in the quarter second before."""
    newest: dict[tuple[str, str], PresenceItem] = {}
    for state in takewhile(lambda state: state.session_time <= at_ns, recording.states()):
        newest.update({(item.participant, item.device): item for item in state.presence})
    return [item for item in newest.values() if item.capture_ns > at_ns - 250_000_000]


def draw_people(scene: mujoco.MjvScene, presence: list[PresenceItem]) -> None:
    """Adds a box per head and hand."""
    names = sorted({item.participant for item in presence})
    for item in presence:
        geom: Any = scene.geoms[scene.ngeom]
        matrix = np.empty(9)
        mujoco.mju_quat2Mat(matrix, np.array(item.pose.q))
        size = HEAD_SIZE if item.device == Device.HEAD else HAND_SIZE
        colour = (*COLOURS[names.index(item.participant) % len(COLOURS)], 1.0)
        mujoco.mjv_initGeom(
            geom, mujoco.mjtGeom.mjGEOM_BOX, np.array(size), np.array(item.pose.p), matrix, np.array(colour, np.float32)
        )
        scene.ngeom += 1


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recording", type=Path)
    parser.add_argument("picture", type=Path)
    parser.add_argument("--at", type=float, help="session time [s]")
    parser.add_argument("--size", type=int, nargs=2, default=(960, 600), metavar=("WIDTH", "HEIGHT"))
    parser.add_argument("--lookat", type=float, nargs=3, default=(0.0, -0.4, 0.3), metavar=("X", "Y", "Z"))
    parser.add_argument("--camera", type=float, nargs=3, default=(90.0, -36.0, 1.95), metavar=("AZ", "EL", "DISTANCE"))
    options = parser.parse_args()
    width, height = options.size
    with Recording.open(options.recording) as recording:
        if recording.header.recording_class != CLOSED:
            raise SystemExit("this recording is of class open: its physics is not ours to re-simulate")
        at_ns = moment_ns(recording) if options.at is None else int(options.at * 1e9)
        core = simulate(recording, at_ns).core
        presence = people(recording, at_ns)
    model = core.world.data.model
    model.vis.global_.offwidth, model.vis.global_.offheight = width, height
    camera = mujoco.MjvCamera()
    camera.lookat, (camera.azimuth, camera.elevation, camera.distance) = options.lookat, options.camera
    with mujoco.Renderer(model, height, width) as renderer:
        renderer.update_scene(core.world.data, camera)
        draw_people(renderer.scene, presence)
        image = renderer.render()
    options.picture.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(options.picture), image[..., ::-1], [cv2.IMWRITE_PNG_COMPRESSION, 9])
    print(f"{options.picture}: {at_ns * 1e-9:.2f} s, {options.picture.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    main()
