"""A live session for tests of emulated headsets: real front process and real authority, with a world of plain values.

The authority's loop runs in a thread.
"""

from __future__ import annotations

import threading
import time
from collections import deque

import msgspec
import numpy as np

from iris_session.authority import Authority, AuthorityConfig
from iris_session.link import FrontConfig, FrontProcess, SceneInfo
from iris_session.protocol.client_messages import Sample
from iris_session.protocol.common import IDENTITY, Pose
from iris_session.protocol.entries import HOST, Entry
from iris_session.protocol.server_messages import BodyInfo, RobotInfo, StateHeader
from iris_session.protocol.specs import ObjectSpec, RobotSpec
from iris_session.protocol.steps import FixedView

ROBOTS = ("left", "right")
BODIES = ("left/hand", "right/hand", "hammer")
OBJECTS = (ObjectSpec("hammer", "hammer"),)
PERIOD_S = 0.004
#: Longest silence of a client, which a busy machine may stop for seconds.
PATIENCE_NS = 60_000_000_000
T_BODY_SITE = Pose((0.0, 0.0, 0.1), (1.0, 0.0, 0.0, 0.0))


def scene() -> SceneInfo:
    bodies = tuple(BodyInfo(10 + i, name, True, name == "hammer") for i, name in enumerate(BODIES))
    robots = tuple(RobotInfo(name, ("j1",), 10 + i, 10 + i, T_BODY_SITE, True) for i, name in enumerate(ROBOTS))
    poses = np.zeros((len(BODIES), 7))
    poses[:, 3] = 1.0
    return SceneInfo("hash", robots, bodies, poses.tobytes())


class LiveSession:
    """`origin_ns` and `entries` as the authority has them.

    Bodies move along x by 0.1 m/s. `assets`: addresses served from the store in `asset_root`; `scene_hash`: address of
    the specification among them.
    """

    def __init__(
        self,
        authority: AuthorityConfig | None = None,
        *,
        asset_root: str = "",
        assets: tuple[str, ...] = (),
        scene_hash: str = "hash",
        **front: object,
    ) -> None:
        self.origin_ns = time.monotonic_ns()
        settings = {"control_port": 0, "state_port": 0, "origin_ns": self.origin_ns, "session_id": "s1", **front}
        settings.setdefault("silence_ns", PATIENCE_NS)
        shown = msgspec.structs.replace(scene(), asset_root=asset_root, assets=assets, scene_hash=scene_hash)
        self.front = FrontProcess(FrontConfig(**settings), shown)  # type: ignore[arg-type]
        ports = self.front.start()
        self.address = f"{settings.get('host', '127.0.0.1')}:{ports.control}"
        self.specs = tuple(RobotSpec(name, ("j1",), ("a1",), f"{name}/tip", name) for name in ROBOTS)
        rules = authority or AuthorityConfig()  # people of these tests are in a tracking frame that is the world
        unaligned = (*rules.unaligned, "operator", "director")
        rules = msgspec.structs.replace(rules, unaligned=unaligned, heartbeat_timeout_ns=PATIENCE_NS)
        self.authority = Authority(rules, self.specs, OBJECTS)
        self.view = FixedView(
            tips=dict.fromkeys(ROBOTS, IDENTITY), q=dict.fromkeys(ROBOTS, (0.0,)), objects={"hammer": IDENTITY}
        )
        self.entries: list[Entry] = []
        self.commands: dict[str, str] = {}
        self.poses = np.zeros((len(BODIES), 7))
        self._inject: deque[Entry] = deque()  # other threads append
        self._scene_epoch = 1
        self._paused = threading.Event()
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    @property
    def now_ns(self) -> int:
        return time.monotonic_ns() - self.origin_ns

    def submit(self, message: object) -> None:
        """Submit a message of the session's owner."""
        self._inject.append(Entry(HOST, HOST, self.now_ns, message))  # type: ignore[arg-type]

    def submit_from_front(self, message: object) -> None:
        """Submit an entry of the front about the first participant who sent a sample."""
        joined = next(entry for entry in self.entries if isinstance(entry.message, Sample))
        self._inject.append(Entry(joined.connection, joined.connection, self.now_ns, message))  # type: ignore[arg-type]

    def pause_steps(self, paused: bool) -> None:
        """Stop the whole authority, as a user's script in a debugger does."""
        (self._paused.set if paused else self._paused.clear)()

    def messages_of(self, kind: type) -> list[Entry]:
        return [entry for entry in self.entries if isinstance(entry.message, kind)]

    def _run(self) -> None:
        step, next_state = 0, 0
        while not self._stop.wait(PERIOD_S):
            if self._paused.is_set():
                continue
            if not self.front.alive:
                self.front.restart()
            inject = [self._inject.popleft() for _ in range(len(self._inject))]
            entries = [*inject, *self.front.link.poll()]
            self.entries += entries
            now = self.now_ns
            decision = self.authority.step(now, entries, 1, self.view)
            self.commands = {command.robot: command.kind for command in decision.commands}
            self._scene_epoch = decision.scene_epoch
            step += 1
            self.front.link.send_decision(step, decision)
            if now >= next_state:
                next_state = now + 15_000_000
                self.poses[:] = (0.1 * now / 1e9, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)
                self.front.link.send_state(
                    StateHeader(decision.scene_epoch, 0, step, now / 1e9, self.now_ns, 0, 0, 0), self.poses.copy()
                )

    def close(self) -> None:
        self._stop.set()
        self._thread.join()
        self.front.close()
