"""Render a recording to a picture or an animation, by simulating its journal again.

    MUJOCO_GL=egl python tools/render_recording.py sessions/*-handover/session.rrd handover.png
    MUJOCO_GL=egl python tools/render_recording.py sessions/*-handover/session.rrd handover.webp

A `.png` shows one moment: the middle of the first handover, or `--at` seconds of session time. A `.webp` or `.gif`
shows the seconds around it (`--before`, `--after`) at `--fps`, played `--speed` times as fast. Heads and hands of the
participants are drawn where the session had them, in the colour of the robot that they drive. Only recordings of class
`closed` can be simulated again.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import cv2
import mujoco
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from iris_session.protocol.entries import decode_entries
from iris_session.protocol.names import Device
from iris_session.protocol.server_messages import Handover, LeaseChanged, LeasesChanged, PresenceItem
from iris_session.recording import CLOSED, Recording
from iris_session.session.verification import ReplayCore

SECOND = 1_000_000_000
Colours = dict[str, tuple[float, float, float]]
#: A handover is reported when the receiver has held the object alone for this long [s].
REPORTED_AFTER_S = 0.1
#: Presence older than this is not drawn: its device is not tracked any more [ns].
PRESENCE_NS = SECOND // 4
#: Colours of participants in the order of the robots that they drive, RGB (Okabe and Ito 2008).
COLOURS = ((0.20, 0.55, 0.90), (0.90, 0.50, 0.05), (0.0, 0.62, 0.45), (0.80, 0.47, 0.65))
#: Participants without a robot.
OBSERVER = (0.55, 0.57, 0.60)
VISOR = (0.10, 0.10, 0.12, 1.0)
SPHERE, BOX = mujoco.mjtGeom.mjGEOM_ELLIPSOID, mujoco.mjtGeom.mjGEOM_BOX
#: Shapes of a head (x forward) and of a hand: geometry, half extents [m], offset in the device's frame [m], visor.
HEAD = ((SPHERE, (0.085, 0.07, 0.10), (-0.06, 0.0, 0.0), False), (BOX, (0.035, 0.065, 0.04), (0.01, 0.0, 0.01), True))
HAND = ((SPHERE, (0.05, 0.04, 0.025), (0.0, 0.0, 0.0), False), (SPHERE, (0.018, 0.018, 0.06), (0.0, 0.0, -0.03), False))


def find_handover(recording: Recording) -> int:
    """Return the session time of the middle of the first handover [ns]. Raises `SystemExit` when there is none."""
    for event in recording.events():
        if isinstance(event.body, Handover):
            return event.session_time - int(REPORTED_AFTER_S * SECOND) - event.body.duration_ns // 2
    raise SystemExit("no handover in this recording: give --at SECONDS")


def simulate(recording: Recording, times_ns: Sequence[int]) -> Iterator[tuple[int, ReplayCore]]:
    """Yield the session at each of `times_ns` (ascending), from the last keyframe before the first of them."""
    core = ReplayCore(recording.header, recording.model)
    rows = [row for row in recording.rows() if row.now_ns <= times_ns[-1]]
    reached = {row.step for row in rows if row.now_ns <= times_ns[0]}
    newest = max((k for k in recording.keyframes() if k.step in reached), key=lambda k: k.step, default=None)
    if newest is not None:
        core.restore(newest)
        rows = [row for row in rows if row.step > newest.step]
    pending = list(times_ns)
    for row in rows:
        while pending and row.now_ns > pending[0]:
            yield pending.pop(0), core
        core.step(row.now_ns, decode_entries(row.entries), row.n_ticks)
    for time_ns in pending:
        yield time_ns, core


class PresenceTrack:
    """The newest pose of every head and hand, at ascending times."""

    def __init__(self, recording: Recording) -> None:
        self._states = iter(recording.states())
        self._ahead = next(self._states, None)
        self._newest: dict[tuple[str, str], PresenceItem] = {}

    def advance(self, time_ns: int) -> list[PresenceItem]:
        """Return the poses in force at `time_ns`."""
        while self._ahead is not None and self._ahead.session_time <= time_ns:
            self._newest.update({(item.participant, item.device): item for item in self._ahead.presence})
            self._ahead = next(self._states, None)
        return [item for item in self._newest.values() if item.capture_ns > time_ns - PRESENCE_NS]


def choose_colours(recording: Recording) -> Colours:
    """Return a colour per participant: that of the first robot that they held."""
    robots = [robot.name for robot in recording.header.robots]
    colours: Colours = {}
    for event in recording.events():
        body = event.body
        changes = body.to_single_changes() if isinstance(body, LeasesChanged) else (body,)
        for change in changes:
            if isinstance(change, LeaseChanged) and change.lease.holder and change.lease.target in robots:
                colours.setdefault(change.lease.holder, COLOURS[robots.index(change.lease.target) % len(COLOURS)])
    return colours


def draw_presence(scene: mujoco.MjvScene, presence: Sequence[PresenceItem], colours: Colours) -> None:
    """Add a headset and controllers per participant to the scene."""
    for item in presence:
        rotation = np.empty(9)
        mujoco.mju_quat2Mat(rotation, np.array(item.pose.q))
        colour = (*colours.get(item.participant, OBSERVER), 1.0)
        for kind, size, offset, is_visor in HEAD if item.device == Device.HEAD else HAND:
            geom: Any = scene.geoms[scene.ngeom]
            p_world = np.array(item.pose.p) + rotation.reshape(3, 3) @ np.array(offset)
            rgba = np.array(VISOR if is_visor else colour, np.float32)
            mujoco.mjv_initGeom(geom, kind, np.array(size), p_world, rotation, rgba)
            scene.ngeom += 1


def render(recording: Recording, times_ns: Sequence[int], options: argparse.Namespace) -> Iterator[NDArray[np.uint8]]:
    """Yield one RGB image per time."""
    width, height = options.size
    camera = mujoco.MjvCamera()
    camera.lookat, (camera.azimuth, camera.elevation, camera.distance) = options.lookat, options.camera
    presence, colours = PresenceTrack(recording), choose_colours(recording)
    renderer: mujoco.Renderer | None = None
    for time_ns, core in simulate(recording, times_ns):
        data = core.core.world.data
        if renderer is None:
            data.model.vis.global_.offwidth, data.model.vis.global_.offheight = width, height
            renderer = mujoco.Renderer(data.model, height, width)
        renderer.update_scene(data, camera)
        draw_presence(renderer.scene, presence.advance(time_ns), colours)
        yield renderer.render().copy()
    if renderer is not None:
        renderer.close()


def write_animation(path: Path, images: Sequence[NDArray[np.uint8]], frame_ms: int) -> None:
    """Write an endless animation, format by the suffix of `path`."""
    frames = [Image.fromarray(image) for image in images]
    if path.suffix == ".gif":
        palette = frames[len(frames) // 2].quantize(200)
        frames = [frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
        frames[0].save(path, save_all=True, append_images=frames[1:], duration=frame_ms, loop=0, optimize=True)
    else:
        frames[0].save(path, save_all=True, append_images=frames[1:], duration=frame_ms, loop=0, quality=60, method=6)


def main() -> None:
    """Run the command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recording", type=Path)
    parser.add_argument("picture", type=Path, help="FILE.png, FILE.webp or FILE.gif")
    parser.add_argument("--at", type=float, help="session time [s]; default: the middle of the first handover")
    parser.add_argument("--before", type=float, default=7.0, help="seconds before it in an animation")
    parser.add_argument("--after", type=float, default=3.0, help="seconds after it in an animation")
    parser.add_argument("--fps", type=float, default=12.0, help="pictures per second of an animation")
    parser.add_argument("--speed", type=float, default=2.0, help="how many times as fast as it was")
    parser.add_argument("--size", type=int, nargs=2, default=(960, 600), metavar=("WIDTH", "HEIGHT"))
    parser.add_argument("--lookat", type=float, nargs=3, default=(0.0, -0.35, 0.22), metavar=("X", "Y", "Z"))
    parser.add_argument("--camera", type=float, nargs=3, default=(90.0, -34.0, 1.8), metavar=("AZ", "EL", "DISTANCE"))
    options = parser.parse_args()
    animated = options.picture.suffix in (".webp", ".gif")
    with Recording.open(options.recording) as recording:
        if recording.header.recording_class != CLOSED:
            raise SystemExit("recording of class open: its physics cannot be simulated again")
        at_ns = find_handover(recording) if options.at is None else int(options.at * SECOND)
        times_ns = [at_ns]
        if animated:
            step_ns = int(options.speed * SECOND / options.fps)
            start_ns = at_ns - int(options.before * SECOND)
            times_ns = list(range(max(start_ns, 0), at_ns + int(options.after * SECOND), step_ns))
        images = list(render(recording, times_ns, options))
    options.picture.parent.mkdir(parents=True, exist_ok=True)
    if animated:
        write_animation(options.picture, images, round(1000 / options.fps))
    else:
        cv2.imwrite(str(options.picture), images[0][..., ::-1], [cv2.IMWRITE_PNG_COMPRESSION, 9])
    print(f"{options.picture}: {at_ns * 1e-9:.2f} s, {options.picture.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    main()
