"""The front as a part of the rig: the real `Front` on in-memory sockets, in place of its process."""

from __future__ import annotations

import sys
import threading
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import msgspec
import pytest

from iris_session.front import context as front_context
from iris_session.front import loop as front_loop
from iris_session.front.context import WatchedSocket
from iris_session.front.loop import SERVICES_PERIOD_NS, Front
from iris_session.front.media.scheduler import MediaScheduler
from iris_session.link import FrontConfig, Ports, SceneInfo
from iris_session.link import messages as link
from iris_session.link.config import FrontStart
from iris_session.link.front_link import FrontLink
from iris_session.protocol.limits import Drops
from iris_session.protocol.names import FaultCode
from iris_session.protocol.server_messages import ProtocolFault
from iris_session.security.keyring import Keyring
from tests.rig.network import FrontEnd, Inbox, Network, make_pair
from tests.rig.simulation import SECOND, Simulation

#: From the end of a front until its successor listens: a process has to start [ns].
START_NS = SECOND // 4
#: The network of the rig that runs, for its fronts.
_network: list[Network] = []
#: The front's ends of links that were opened and not taken yet, by endpoint.
_links: dict[str, Inbox] = {}


class _RigSockets:
    """In place of `FrontSockets`."""

    def __init__(self, start: FrontStart, drops: object, on_key_refused: object) -> None:
        network = _network[-1]
        end = network.listen()
        self._end: FrontEnd = end
        self.context = None
        self.link, self.link_monitor = _links.pop(start.link_endpoint), Inbox()
        self.control = WatchedSocket(end.control, end.monitor)  # type: ignore[arg-type]
        self.state = WatchedSocket(end.state, end.state_monitor)  # type: ignore[arg-type]
        self.keyring, self.authenticator, self.listeners = Keyring(), None, ()
        self.ports = Ports("127.0.0.1", 7721, 7722)

    def open_state(self, _port: int) -> WatchedSocket:
        return self.state

    def close(self) -> None:
        """The network closes the connections when the process ends."""


class RigLink(FrontLink):
    """The authority's end of the link, in memory."""

    def _listen(self, endpoint: str) -> Any:
        ours, theirs = make_pair()
        _links[endpoint] = theirs
        return ours


class NoMedia:
    """In place of the proxy of media, whose thread and sockets the rig does not have."""

    def __init__(self) -> None:
        self.lock = threading.Lock()
        self.scheduler = MediaScheduler()

    def start(self) -> None: ...

    def close(self) -> None: ...

    def pop_floods(self) -> list[Any]:
        return []

    def list_pending(self) -> list[Any]:
        return []

    def release_memory(self) -> str:
        return ""


class NoAssets:
    """In place of the server of assets."""

    late_until_ns = sent_bytes = requests = pending_readers = 0

    def __init__(self) -> None:
        self.drops = Drops()

    def start(self) -> None: ...

    def close(self) -> None: ...

    def set_access(self, access: object) -> None: ...

    def list_pending(self) -> list[Any]:
        return []


class RigFrontProcess:
    """In place of `FrontProcess`: a front that the rig runs whenever something has come for it."""

    def __init__(self, config: FrontConfig, scene: SceneInfo, simulation: Simulation) -> None:
        limits = msgspec.structs.replace(config.limits, memory_bytes=1 << 50)  # the memory is that of the whole run
        self._config = msgspec.structs.replace(config, limits=limits)
        self._simulation = simulation
        self.scene = scene
        self.anchors = config.anchors
        self.link = RigLink(config, lambda: simulation.now_ns)
        self.front: Front | None = None
        self.restarts = -1
        self._dies_at: int | None = None
        self._is_due = self._is_starting = False
        #: The front does nothing until then.
        self.stands_until_ns = 0

    pid = 0

    def start(self) -> Ports:
        self._spawn(self._open_link())
        self.link.receive()
        assert self.link.ports is not None
        return self.link.ports

    def poll(self, now_ns: int) -> list[str]:
        if self.front is not None or self._is_starting:
            return []
        start, self._is_starting = self._open_link(), True
        self._simulation.call_at(self._simulation.now_ns + START_NS, lambda: self._spawn(start))
        return ["the front process ended with status -9 (SIGKILL); it is started again"]

    def kill(self) -> None:
        """End the front at once, as SIGKILL does: what it has not sent is lost, every connection closes."""
        self.front = None
        _network[-1].end_front()

    def set_scene(self, scene: SceneInfo) -> None:
        self.scene = scene
        self.link.send_scene(scene)

    def publish_media(self, stream: str, frames: bytes | Mapping[str, bytes], *_: Any, **__: Any) -> bool:
        return False

    def close(self, timeout_s: float = 0.0) -> None:
        self.link.send_end()
        if self.front is not None:
            self._run_front()
            self.front = None
        _network[-1].end_front()
        self.link.close()

    def _open_link(self) -> FrontStart:
        self.restarts += 1
        endpoint = self.link.open(Path(f"/rig/front-{self.restarts}"))
        config = msgspec.structs.replace(self._config, anchors=self.anchors)
        return FrontStart(config, self.scene, endpoint, 0, self.link.handback)

    def _spawn(self, start: FrontStart) -> None:
        self._is_starting = False
        front = self.front = Front(start)
        # As `Front.run` begins.
        front._link.send_multipart((link.READY, link.encoder.encode(front._context.ports)))
        end = _network[-1].front
        assert end is not None
        for socket in (front._link, end.control, end.monitor):
            socket.on_message = self._wake_front  # type: ignore[union-attr]
        self._tick(front)

    def _wake_front(self) -> None:
        if not self._is_due:
            self._is_due = True
            self._simulation.call_at(self._simulation.now_ns, self._run_front)

    def _run_front(self) -> None:
        self._is_due = self._simulation.now_ns < self.stands_until_ns
        if self._is_due:
            self._simulation.call_at(self.stands_until_ns, self._run_front)
            return
        front = self.front
        while front is not None and front is self.front and not front.ended and front._run_once():
            pass
        if front is not None and front.ended:  # as `Front.run` ends
            text = f"the session has ended: {front.ended}"
            front._downlink.broadcast(ProtocolFault(FaultCode.SESSION_ENDED, text))

    def _tick(self, front: Front) -> None:
        if front is self.front and not front.ended:
            self._run_front()
            due_ns = max(self._simulation.now_ns + SERVICES_PERIOD_NS, self.stands_until_ns)
            self._simulation.call_at(due_ns, lambda: self._tick(front))


def install_front(network: Network, patch: pytest.MonkeyPatch) -> None:
    """Let fronts have the sockets of the rig, and no thread."""
    patch.setattr(sys.modules[__name__], "_network", [network])
    patch.setattr(front_context, "FrontSockets", _RigSockets)
    patch.setattr(front_loop, "_make_media_proxy", lambda context, sockets: NoMedia())
    patch.setattr(front_loop, "_make_asset_server", lambda context, sockets: NoAssets())
    patch.setattr(front_loop, "ThreadPoolExecutor", lambda *_: None)
    patch.setattr(front_loop, "make_discovery_services", lambda *_: [])
    patch.setattr(front_loop, "lower_named_thread_priority", lambda _: None)
    patch.setattr(front_loop, "is_parent", lambda _: True)
    for name, module in list(sys.modules.items()):
        if name.startswith(("iris_session.front", "iris_session.link.tcp_guard")):
            for function in ("peer_of", "close_tcp", "tcp_counts", "pace_tcp"):
                if hasattr(module, function):
                    patch.setattr(module, function, getattr(network, function))
