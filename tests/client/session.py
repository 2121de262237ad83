"""A session for client tests: real front and real authority on in-memory sockets, in simulated time.

Bodies are plain values that move along x by 0.1 m/s. Assets and media come from the test, without the front.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from types import TracebackType
from typing import Any, Final, Self

import msgspec
import numpy as np
import pytest

from iris_session.assets.errors import AssetStoreError
from iris_session.assets.store import AssetStore
from iris_session.authority import Authority, AuthorityConfig
from iris_session.client import Client, assets, endpoint_resolver
from iris_session.client import client as client_module
from iris_session.front import context as front_context
from iris_session.link import FrontConfig, Ports, SceneInfo
from iris_session.protocol.assets import AssetChunk, AssetRefused, AssetRequest
from iris_session.protocol.client_messages import Control
from iris_session.protocol.codec import decode_asset_request, encode_asset_header, encode_media_header, encode_server
from iris_session.protocol.common import IDENTITY, Pose
from iris_session.protocol.entries import HOST, Entry, SceneLoaded, ScenePatched
from iris_session.protocol.media import MediaHeader, make_topic
from iris_session.protocol.names import PROTOCOL_VERSION, AssetRefusal, BudgetClass
from iris_session.protocol.server_messages import BodyInfo, RobotInfo, ServerEnvelope, ServerMessage, StateHeader
from iris_session.protocol.specs import ObjectSpec, RobotSpec
from iris_session.protocol.status import DeliveryBudget
from iris_session.protocol.steps import FixedView
from tests.rig import front as rig_front
from tests.rig.front import RigFrontProcess, install_front
from tests.rig.network import Network, RigClientSockets, refuse_introduction
from tests.rig.simulation import SECOND, Simulation, simulate_modules

ADDRESS: Final = "127.0.0.1:7721"
ROBOTS: Final = ("left", "right")
BODIES: Final = ("left/hand", "right/hand", "hammer")
OBJECTS: Final = (ObjectSpec("hammer", "hammer"),)
STEP_NS: Final = 4_000_000
STATE_NS: Final = 15_000_000
T_BODY_SITE: Final = Pose((0.0, 0.0, 0.1), (1.0, 0.0, 0.0, 0.0))

AssetAnswers = Callable[[AssetRequest], Sequence[Sequence[bytes]]]


def make_scene() -> SceneInfo:
    bodies = tuple(BodyInfo(10 + i, name, True, name == "hammer") for i, name in enumerate(BODIES))
    robots = tuple(RobotInfo(name, ("j1",), 10 + i, 10 + i, T_BODY_SITE, True) for i, name in enumerate(ROBOTS))
    poses = np.zeros((len(BODIES), 7))
    poses[:, 3] = 1.0
    return SceneInfo("hash", robots, bodies, poses.tobytes())


def make_chunk(request: AssetRequest, total: int, data: bytes, **other: Any) -> list[bytes]:
    """Return the frames of a chunk that answers a request; `other` replaces fields of its header."""
    header = AssetChunk(PROTOCOL_VERSION, request.request_id, request.address, request.offset, total)
    return [encode_asset_header(msgspec.structs.replace(header, **other)), data]


def refuse_asset(request: AssetRequest, reason: str) -> list[bytes]:
    """Return the frame of a refusal that answers a request."""
    return [encode_asset_header(AssetRefused(PROTOCOL_VERSION, request.request_id, request.address, reason))]


class MemoryAssets:
    """The assets channel of a client's sockets: every request is answered at once by `answers`.

    Attributes:
        requests: Requests of the client.
        bytes_sent: Bytes of assets that came to the client.
        cuts: After each of these totals of `bytes_sent` the connection ends; what has not been read is lost.
        opened: Number of connections.
    """

    def __init__(self) -> None:
        self.answers: AssetAnswers = lambda request: [refuse_asset(request, AssetRefusal.UNKNOWN)]
        self.requests: list[AssetRequest] = []
        self.cuts: list[int] = []
        self.bytes_sent = self.opened = 0
        self.is_open = self.has_ended = False
        self._messages: list[list[memoryview]] = []

    def open(self) -> None:
        if not self.is_open:
            self.is_open, self.has_ended = True, False
            self.opened += 1

    def close(self) -> None:
        self.is_open = self.has_ended = False
        self._messages.clear()

    def send(self, data: bytes) -> bool:
        request = decode_asset_request(data)
        self.requests.append(request)
        if self.has_ended:
            return True  # on its way to nobody
        for frames in self.answers(request):
            self.bytes_sent += sum(map(len, frames[1:]))
            if self.cuts and self.bytes_sent >= self.cuts[0]:
                self.cuts.pop(0)
                self.has_ended = True
                self._messages.clear()
                break
            self._messages.append([memoryview(one) for one in frames])
        return True

    def drain(self) -> list[list[memoryview]]:
        """Return a few messages, as come in one round."""
        drained, self._messages = self._messages[:4], self._messages[4:]
        return drained


class InlineWorkers(assets.AssetWorkers):
    """Does the work of the threads at once, in the thread that polls."""

    def __init__(self, owner: assets.ClientAssets, wake: Callable[[], None]) -> None:
        super().__init__(owner, wake, threads=0)

    def _submit(self, address: str, work: Callable[[], assets.Result], size: int = 0) -> None:
        self._results.put(self._run_job(address, work, size))
        self._wake()


class MemorySockets(RigClientSockets):
    """In place of `ClientSockets`: those of the rig, with assets and media.

    Attributes:
        assets: The assets channel.
        topics: Subscribed prefixes of media topics.
        published: Streams and frames that the client has published.
    """

    def __init__(self, network: Network, seed: int) -> None:
        super().__init__(network, "lan", seed)
        self.assets = MemoryAssets()
        self.topics: set[bytes] = set()
        self.published: list[tuple[str, list[bytes]]] = []
        self._media: list[list[bytes]] = []

    def wake(self) -> None:
        self._arrive()

    def send_to_client(self, message: ServerMessage, epoch: int) -> None:
        """Deliver a control message that the front does not send in these tests."""
        self._control.append([encode_server(ServerEnvelope(PROTOCOL_VERSION, epoch, message))])
        self._arrive()

    @property
    def has_assets(self) -> bool:  # type: ignore[override]
        return self.assets.is_open

    def open_assets(self, port: int) -> None:
        assert port
        self.assets.open()

    def close_assets(self) -> None:
        self.assets.close()

    def send_assets(self, data: bytes) -> bool:
        sent = self.assets.send(data)
        self._arrive()
        return sent

    def poll_assets_disconnect(self) -> bool:
        ended, self.assets.has_ended = self.assets.has_ended, False
        return ended

    def drain_assets(self) -> list[list[memoryview]]:
        return self.assets.drain()

    @property
    def has_media(self) -> bool:  # type: ignore[override]
        return bool(self.topics)

    def subscribe_media(self, port: int, topics: Sequence[bytes]) -> None:
        assert port
        self.topics.update(topics)

    def unsubscribe_media(self, topic: bytes) -> None:
        self.topics.discard(topic)

    def push_media(self, topic: bytes, frames: Sequence[bytes]) -> None:
        if any(topic.startswith(one) for one in self.topics):
            self._media.append([topic, *frames])
            self._arrive()

    def drain_media(self) -> list[list[bytes]]:
        drained, self._media = self._media, []
        return drained

    def send_media(self, port: int, stream: str, frames: Sequence[bytes]) -> bool:
        assert port
        self.published.append((stream, [bytes(one) for one in frames]))
        return True

    def close_media(self) -> None:
        self.topics.clear()
        self._media.clear()


class _FrontSockets(rig_front._RigSockets):
    """Those of the rig, with ports for media and assets."""

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        self.ports = Ports("127.0.0.1", 7721, 7722, media=7723, media_ingest=7724, assets=7725)


class ClientSession:
    """A session whose clients live in the same simulated time.

        with ClientSession() as session:
            ann = session.join("ann")

    Args:
        authority: Rules of the authority. People of these tests are in a tracking frame that is the world.
        store: Assets that clients may fetch, as far as they are in `assets`.
        assets: Addresses that are served.
        scene_hash: Content hash of the specification.
        front: Fields of `FrontConfig`.

    Attributes:
        entries: What the authority has received.
        commands: Kind of the present command, by robot.
        clients: Clients that have joined, also those that have left.
    """

    def __init__(
        self,
        authority: AuthorityConfig | None = None,
        *,
        store: AssetStore | None = None,
        assets: Sequence[str] = (),
        scene_hash: str = "hash",
        **front: Any,
    ) -> None:
        self.simulation = Simulation(1)
        self.network = Network(self.simulation)
        self.origin_ns = self.simulation.now_ns
        rules = authority or AuthorityConfig()
        rules = msgspec.structs.replace(rules, unaligned=(*rules.unaligned, "operator", "director"))
        self.specs = tuple(RobotSpec(name, ("j1",), ("a1",), f"{name}/tip", name) for name in ROBOTS)
        self.authority = Authority(rules, self.specs, OBJECTS)
        self.view = FixedView(
            tips=dict.fromkeys(ROBOTS, IDENTITY), q=dict.fromkeys(ROBOTS, (0.0,)), objects={"hammer": IDENTITY}
        )
        self.scene = msgspec.structs.replace(make_scene(), scene_hash=scene_hash)
        self.store, self.assets = store, tuple(assets)
        self.entries: list[Entry] = []
        self.commands: dict[str, str] = {}
        self.clients: list[Client] = []
        self.budget = DeliveryBudget(BudgetClass.FULL)
        self.paused = False
        self._config = FrontConfig(origin_ns=self.origin_ns, session_id="s1", **front)
        self._patch = pytest.MonkeyPatch()
        self._poses = np.zeros((len(BODIES), 7))
        self._y = np.zeros(len(BODIES))
        self._pending: list[Entry] = []
        self._step_number = self._next_state_ns = self._links = 0
        self._frame_numbers: dict[str, int] = {}

    def __enter__(self) -> Self:
        patch = self._patch
        simulate_modules(self.simulation, patch)
        install_front(self.network, patch)
        patch.setattr(front_context, "FrontSockets", _FrontSockets)
        patch.setattr(client_module, "ClientSockets", self._make_sockets)
        patch.setattr(assets, "AssetWorkers", InlineWorkers)
        patch.setattr(endpoint_resolver, "request_introduction", refuse_introduction)
        self.front = RigFrontProcess(self._config, self.scene, self.simulation)
        self.front.start()
        self._step()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        try:
            for client in self.clients:
                client.close()
            self.front.close()
        finally:
            self._patch.undo()

    @property
    def now_ns(self) -> int:
        """Session time."""
        return self.simulation.now_ns - self.origin_ns

    def run(self, seconds: float) -> None:
        """Let the session go on without polling clients."""
        self.simulation.run(self.simulation.now_ns + round(seconds * SECOND))

    # --- clients --------------------------------------------------------------------------------------------------

    def make_client(self, name: str = "ann", **settings: Any) -> Client:
        """Make a client that is not connected; it is closed at the end."""
        client = Client(ADDRESS, name=name, **{"alignment": "not_needed", **settings})
        self.clients.append(client)
        return client

    def join(self, name: str = "ann", **settings: Any) -> Client:
        return self.make_client(name, **settings).connect()

    def sockets_of(self, client: Client) -> MemorySockets:
        sockets = client._sockets
        assert isinstance(sockets, MemorySockets)
        return sockets

    def _make_sockets(self) -> MemorySockets:
        self._links += 1
        sockets = MemorySockets(self.network, self._links)
        sockets.assets.answers = self.answer_asset
        return sockets

    # --- the session ----------------------------------------------------------------------------------------------

    def submit(self, message: Any) -> None:
        """Submit a message of the session's owner."""
        self._pending.append(Entry(HOST, HOST, self.now_ns, message))

    def change_scene(self, scene_hash: str, assets: Sequence[str] = (), cause: str = "patch") -> None:
        """Change the look of the scene, load another one (`new_scene`), or change the served assets (empty cause)."""
        self.assets = tuple(assets)
        self._show(msgspec.structs.replace(self.scene, scene_hash=scene_hash), cause)

    def load_reordered(self, *names: str) -> None:
        """Load a scene with the same bodies in another order. From the first call on, their y identifies them."""
        known = {body.name: body for body in make_scene().bodies}
        self._show(msgspec.structs.replace(self.scene, bodies=tuple(known[name] for name in names)), "new_scene")

    def _show(self, scene: SceneInfo, cause: str) -> None:
        self.scene = scene
        self.front.set_scene(scene)
        if cause == "patch":
            self.submit(ScenePatched((), scene.scene_hash))
        elif cause:
            self.submit(SceneLoaded(scene.scene_hash, self.specs, OBJECTS))
            self._y = np.array([body.id for body in scene.bodies], np.float64)

    def reset(self) -> None:
        self.submit(Control(0, "reset"))

    def kill_front(self) -> None:
        """End the front at once; the session replaces it."""
        self.front.kill()

    def messages_of(self, kind: type) -> list[Any]:
        """Return the messages of a type that the authority has received."""
        return [entry.message for entry in self.entries if isinstance(entry.message, kind)]

    def _step(self) -> None:
        self.simulation.call_at(self.simulation.now_ns + STEP_NS, self._step)
        if self.paused:
            return
        self.front.poll(self.now_ns)  # it is started again when it has ended
        pending, self._pending = self._pending, []
        entries = [*pending, *self.front.link.poll()]
        self.entries += entries
        decision = self.authority.step(self.now_ns, entries, 1, self.view)
        self.commands = {command.robot: command.kind for command in decision.commands}
        self._step_number += 1
        self.front.link.send_decision(self._step_number, decision)
        if self.now_ns >= self._next_state_ns:
            self._next_state_ns = self.now_ns + STATE_NS
            self._poses[:] = (0.1 * self.now_ns / 1e9, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)
            self._poses[:, 1] = self._y
            header = StateHeader(decision.scene_epoch, 0, self._step_number, self.now_ns / 1e9, self.now_ns, 0, 0, 0)
            self.front.link.send_state(header, self._poses.copy())
        self._report_budgets()

    # --- assets and media -----------------------------------------------------------------------------------------

    def answer_asset(self, request: AssetRequest) -> list[list[bytes]]:
        """Answer as the front does: a chunk of an asset that is served, or a refusal."""
        try:
            if self.store is None or request.address not in self.assets:
                return [refuse_asset(request, AssetRefusal.UNKNOWN)]
            data = bytes(self.store.view(request.address))
        except AssetStoreError:
            return [refuse_asset(request, AssetRefusal.UNKNOWN)]
        if request.offset > len(data):
            return [refuse_asset(request, AssetRefusal.BAD_RANGE)]
        return [make_chunk(request, len(data), data[request.offset : request.offset + request.length])]

    def _report_budgets(self) -> None:
        for client in self.clients:
            connection = client.connection
            if connection.is_joined and connection.latest.get(DeliveryBudget) != self.budget:
                self.sockets_of(client).send_to_client(self.budget, connection.connection_epoch)

    def publish_media(
        self, stream: str, data: bytes, *, epoch: int = 1, encoding: str = "bytes", capture_ns: int | None = None
    ) -> None:
        """Send a frame of a stream to the clients that subscribe to it."""
        number = self._frame_numbers[stream] = self._frame_numbers.get(stream, 0) + 1
        captured = self.now_ns if capture_ns is None else capture_ns
        head = encode_media_header(
            MediaHeader(stream, BudgetClass.FULL, epoch, number, captured, self.now_ns, encoding)
        )
        for client in self.clients:
            topic = make_topic(client.connection.connection_epoch, stream) + b"full"
            self.sockets_of(client).push_media(topic, [head, data])
