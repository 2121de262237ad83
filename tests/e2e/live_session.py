"""A session that tests command by lines, and a Python client beside it, each a process.

    python -m tests.e2e.live_session serve SCENE INTERFACE RECORDING
    python -m tests.e2e.live_session watch ADDRESS CODE

The session changes its scene, says what has happened, and keeps what it has published, to be compared with what
arrives. The client receives the cloth and the cloud. Both answer each line of their input by a line of JSON.
"""

from __future__ import annotations

import contextlib
import json
import queue
import ssl
import sys
import threading
import urllib.request
from collections.abc import Callable
from typing import Any, Final

import mujoco
import numpy as np
from numpy.typing import NDArray

from iris_session import Client, Session, SessionConfig, StreamInfo, encode_cloud
from iris_session.authority import AuthorityConfig
from iris_session.client.deformables import Deformables
from iris_session.demo.named_scenes import NamedScene, scene_by_name
from iris_session.demo.scenes import n_arms_scene
from iris_session.link import front_process
from iris_session.protocol.common import Pose
from iris_session.protocol.scene import AddVisual, Geometry, SetVisual, Visual
from iris_session.protocol.server_messages import StateHeader
from iris_session.session.deformables import list_deformables

LONG_NS: Final = 60 * 1_000_000_000
#: A participant that is silent for so long has left, as far as others can see [ns].
HEARTBEAT_NS: Final = 15 * 1_000_000_000
#: For the gateway to start, and for the Python client to join [s].
WAIT_S: Final = 60.0
CLOTH: Final = "flex-0"
CLOUD: Final = "room"
HZ: Final = 60.0
#: A cloth that hangs on two corners, and a pendulum.
CLOTH_MODEL: Final = """
<mujoco>
  <option timestep="0.005" integrator="discrete" solver="CG"/>
  <worldbody>
    <body name="pendulum" pos="0 1 1">
      <joint axis="0 1 0"/><geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.02"/>
    </body>
    <flexcomp name="cloth" type="grid" dim="2" count="12 12 1" spacing="0.08 0.08 0.08" pos="0 0 1" radius="0.005"
              mass="0.3">
      <edge equality="true"/><pin id="0 11"/>
    </flexcomp>
  </worldbody>
</mujoco>
"""
GREEN: Final = (0.0, 0.8, 0.2, 1.0)
LAMP_POSITION: Final = (0.1, 0.2, 1.3)
#: The cloud: a lattice of 100 x 100 points, which moves with its number.
SIDE: Final = 100
SPACING_M: Final = 0.02
CLOUDS: Final = 32


def make_cloud(number: int) -> NDArray[np.float64]:
    """Return the points of a cloud."""
    x, y = np.divmod(np.arange(SIDE * SIDE, dtype=np.float64), SIDE)
    height = np.full_like(x, 1.0 + 0.01 * (number % CLOUDS))
    return np.stack([SPACING_M * x - 1.0, SPACING_M * y - 1.0, height], axis=-1)


class Served:
    """The session. Commands are done between two steps of it, in its thread."""

    def __init__(self, scene: NamedScene, name: str, interface: str, recording: str) -> None:
        authority = AuthorityConfig(
            freshness_ns=LONG_NS, gap_ns=LONG_NS, grace_ns=10 * LONG_NS, heartbeat_timeout_ns=HEARTBEAT_NS
        )
        config = SessionConfig(
            name=name,
            interfaces=(interface,),
            record=recording or False,
            anchors=scene.anchors,
            anchor_sizes=scene.anchor_sizes,
            adapt_media=False,
            authority=authority,
        )
        self.session = Session(scene.model, config=config)
        self._lines: queue.SimpleQueue[str] = queue.SimpleQueue()
        self._is_cloth = name == "cloth"
        self._poses: dict[int, NDArray[np.float64]] = {}
        self._vertices: dict[int, NDArray[np.float64]] = {}
        self._clouds: dict[int, int] = {}
        colors = np.full((SIDE * SIDE, 3), 128, np.uint8)
        self._encoded = [encode_cloud(make_cloud(k), colors) for k in range(CLOUDS)] if self._is_cloth else []

    def run(self) -> None:
        with self.session.signals(), self.session as session:
            threading.Thread(target=self._read_commands, daemon=True).start()
            session.run(until=self._begin)
            session.run(until=self._do_commands)

    def _read_commands(self) -> None:
        """Let the gateway start, which it does for the first connection: headsets wait for 8 s only."""
        web = self.session.processes.web
        assert web is not None
        context = ssl.create_default_context()
        context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
        with contextlib.suppress(OSError):  # a busy gateway may refuse it: it has started then
            urllib.request.urlopen(f"{web.address}v1/info", timeout=WAIT_S, context=context).close()
        answer("serve", address=self.session.address)
        read_lines(self._lines.put)

    def _begin(self) -> bool:
        stepper = self.session.stepper
        if self._is_cloth:
            stepper.on_state = self._keep_state
            stepper.on_publish.append(self._keep_media)
        return True

    def _do_commands(self) -> bool:
        while not self._lines.empty():
            name, *arguments = self._lines.get().split()
            if name == "quit":
                return True
            getattr(self, f"_do_{name}")(*arguments)
        return False

    # --- commands -----------------------------------------------------------------------------------------------------

    def _do_patch(self) -> None:
        """Paint the hammer green, and add a lamp."""
        spec = self.session.scene
        assert spec is not None
        hammer = next(body.id for body in spec.bodies if body.name == "hammer")
        painted = [visual.id for visual in spec.visuals if visual.body == hammer]
        lamp = 1 + max(visual.id for visual in spec.visuals)
        pose = Pose(LAMP_POSITION, (1.0, 0.0, 0.0, 0.0))
        sphere = Geometry("sphere", (0.1, 0.1, 0.1))
        self.session.patch_scene(
            *(SetVisual(visual, rgba=GREEN) for visual in painted),
            AddVisual(Visual(lamp, 0, "lamp", pose, 0, sphere, -1, GREEN)),
        )
        answer("patch", hash=self._scene_hash, painted=painted, lamp=lamp)

    def _do_scene(self) -> None:
        """Load another scene. `left` and `right` are in both."""

        def finish() -> None:
            loading.result()
            answer("scene", hash=self._scene_hash)

        loading = self.session.load_scene(n_arms_scene(2, objects=3).compile())
        threading.Thread(target=finish, daemon=True).start()

    def _do_events(self) -> None:
        answer("events", kinds=[type(event.body).__name__ for event in self.session.recent_events()])

    def _do_truth(self, path: str) -> None:
        """Write what was published so far."""
        np.savez(
            path,
            ticks=list(self._poses),
            poses=list(self._poses.values()),
            cloth_ns=list(self._vertices),
            cloth=list(self._vertices.values()),
            cloud_ns=list(self._clouds),
            cloud=list(self._clouds.values()),
        )
        answer("truth")

    @property
    def _scene_hash(self) -> str:
        newest = self.session.processes.scenes.newest
        assert newest is not None
        return newest.info.scene_hash

    # --- what is published --------------------------------------------------------------------------------------------

    def _keep_state(self, header: StateHeader, poses: NDArray[np.float64]) -> None:
        self._poses[header.tick] = poses.copy()

    def _keep_media(self, scene_epoch: int, end_ns: int, shown_ns: int) -> None:
        """Keep the published vertices, publish a cloud, and let gravity turn, so that nothing comes to rest."""
        world = self.session.stepper.core.world
        self._vertices[shown_ns] = np.array(list_deformables(world)[0].vertices())
        number = len(self._clouds)
        info = StreamInfo("Room", "remote", None, HZ)
        cloud = self._encoded[number % CLOUDS]
        if self.session.publish_media(CLOUD, cloud, capture_ns=shown_ns, encoding="cloud", info=info):
            self._clouds[shown_ns] = number
        t = 1e-9 * shown_ns
        world.model.opt.gravity[:] = 4.0 * np.sin(2.0 * t), 4.0 * np.cos(1.3 * t), -9.81


class Watcher:
    """The Python client: what it has received, by time of capture."""

    def __init__(self, client: Client) -> None:
        self._client = client
        self._shapes = Deformables(client)
        self._cloud = client.media.cloud(CLOUD)
        self._cloth: dict[int, NDArray[np.float32]] = {}
        self._points: dict[int, NDArray[np.float32]] = {}

    def poll(self) -> None:
        self._client.poll(0.002)
        for name in self._shapes.update():
            self._cloth[self._shapes.capture_ns[name]] = self._shapes.vertices[name].copy()
        if (cloud := self._cloud.poll()) is not None:
            self._points[cloud.times.capture_ns] = cloud.positions

    def write(self, path: str) -> None:
        np.savez(
            path,
            cloth_ns=list(self._cloth),
            cloth=list(self._cloth.values()),
            cloud_ns=list(self._points),
            cloud=list(self._points.values()),
        )


def watch(address: str, code: str) -> None:
    """Receive until a file is asked for."""
    lines: queue.SimpleQueue[str] = queue.SimpleQueue()
    threading.Thread(target=read_lines, args=(lines.put,), daemon=True).start()
    client = Client(address, role="observer", name="watcher", join_code=code)
    client.connect(WAIT_S)
    watcher = Watcher(client)
    answer("watch")
    while lines.empty():
        watcher.poll()
    watcher.write(lines.get().split()[1])
    answer("write")
    client.close()


def read_lines(take: Callable[[str], None]) -> None:
    for line in sys.stdin:
        take(line)
    take("quit")


def answer(command: str, **fields: Any) -> None:
    print(json.dumps({"command": command, "ok": True, **fields}), flush=True)


def main(what: str, *arguments: str) -> None:
    front_process.HANGING_NS = front_process.STARVED_NS = LONG_NS  # type: ignore[misc]
    if what == "watch":
        watch(*arguments)
        return
    name, interface, recording = arguments
    scene = NamedScene(mujoco.MjModel.from_xml_string(CLOTH_MODEL)) if name == "cloth" else scene_by_name(name)
    Served(scene, name, interface, recording).run()


if __name__ == "__main__":
    main(*sys.argv[1:])
