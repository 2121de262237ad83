"""Who may have which assets: the front's side of the assets channel. Tells its thread whenever something changed."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import Final

from iris_session.front.asset_server import AssetAccess, AssetFolder, AssetServer
from iris_session.front.connections import ConnectionTable, FrontConnection
from iris_session.front.state_publisher import StatePublisher
from iris_session.link.config import MILLISECOND, SceneInfo
from iris_session.protocol.limits import Drops
from iris_session.protocol.status import AssetsReport
from iris_session.security.keyring import Keyring

PERIOD_NS: Final = 250 * MILLISECOND
#: State that left so long after its tick is late: the bar for its whole way to a client is 3 ms.
LATE_NS: Final = 2 * MILLISECOND
#: Between two turns of the loop, which come every 10 ms.
LATE_TICK_NS: Final = 25 * MILLISECOND
#: How long assets hold back then.
YIELD_NS: Final = 20 * MILLISECOND
#: Specifications of scenes before those two are served for so long after they were replaced, so that whoever hears of
#: them over a slow network gets one, however often the scene is patched; and so many of them.
REPLACED_NS: Final = 5_000 * MILLISECOND
MAX_REPLACED: Final = 64


class AssetService:
    """A `Service`. Served is what the publisher's scene and the one before it name, and specifications that were
    replaced lately. `revoked(key)`: may do nothing."""

    def __init__(
        self,
        server: AssetServer,
        clients: ConnectionTable,
        keyring: Keyring,
        drops: Drops,
        publisher: StatePublisher,
        revoked: Callable[[str], bool],
    ) -> None:
        self._server = server
        self._clients = clients
        self._keyring = keyring
        self._drops = drops
        self._publisher = publisher
        self._revoked = revoked
        self._previous: SceneInfo | None = None
        self._present: SceneInfo | None = None
        self._folders: tuple[AssetFolder, ...] = ()  # the present one is the last
        self._replaced: deque[tuple[int, AssetFolder]] = deque(maxlen=MAX_REPLACED)  # until when
        self._published = AssetAccess()
        self._counted: dict[str, int] = {}
        self._next_ns = self._ticked_ns = self._frames = 0
        server.start()

    def tick(self, now_ns: int) -> None:
        """Lets in who came and out who left, at once; gives the state its way."""
        self._yield_to_state(now_ns)
        due = now_ns >= self._next_ns
        if due:
            self._next_ns = now_ns + PERIOD_NS
            self._expire_replaced(now_ns)
            self._count_drops()
        self.sync_clients(keys=due)

    def sync_clients(self, *, keys: bool = False) -> None:
        """Tells the thread who is there, and which scene. `keys`: also when only the allow-list may have changed."""
        if self._publisher.scene is not self._present:
            self._change_scene(self._publisher.scene)
        listeners = {n: self._user_of(one) for n, one in self._clients.by_number.items() if one.admitted}
        if keys or listeners != self._published.listeners or self._folders is not self._published.stores:
            self._publish_access(listeners)

    def close(self) -> None:
        self._server.close()

    def report(self) -> AssetsReport:
        """For the status."""
        tallied = self._server.read_counters()
        return AssetsReport(
            sum(len(addresses) for _, addresses in self._folders[-1:]),
            tallied.bytes,
            tallied.requests,
            sum(tallied.reasons.values()),
            tallied.waiting,
        )

    def _yield_to_state(self, now_ns: int) -> None:
        """When state was late since the last turn, or this turn is."""
        late = 0 < self._ticked_ns < now_ns - LATE_TICK_NS
        if self._publisher.frames != self._frames:
            late |= self._publisher.newest_delay_ns > LATE_NS
        self._frames, self._ticked_ns = self._publisher.frames, now_ns
        if late:
            self._server.late_until_ns = now_ns + YIELD_NS

    def _change_scene(self, scene: SceneInfo) -> None:
        """Another scene: what only the one before the last named is served no more, but for its specification."""
        before, present = self._previous, self._present
        if before is not None and before.scene_hash in before.assets:
            self._replaced.append((self._ticked_ns + REPLACED_NS, (before.asset_root, (before.scene_hash,))))
        self._previous, self._present = present, scene
        self._update_folders()

    def _expire_replaced(self, now_ns: int) -> None:
        """Specifications that were replaced long enough ago."""
        n = len(self._replaced)
        while self._replaced and self._replaced[0][0] < now_ns:
            self._replaced.popleft()
        if len(self._replaced) < n:
            self._update_folders()

    def _update_folders(self) -> None:
        named = [(one.asset_root, one.assets) for one in (self._previous, self._present) if one is not None]
        self._folders = (*(store for _, store in self._replaced), *named)

    def _publish_access(self, listeners: dict[int, str]) -> None:
        keyring = self._keyring
        marks = (
            frozenset() if keyring.key is None else frozenset(m for m in keyring.fingerprints if not self._revoked(m))
        )
        table = AssetAccess(listeners, marks, self._folders)
        if table != self._published:
            self._published = table
            self._server.set_access(table)

    def _count_drops(self) -> None:
        for reason, count in self._server.read_counters().reasons.items():
            more = count - self._counted.get(reason, 0)
            if more:
                self._drops.count(reason, n=more)
                self._counted[reason] = count

    def _user_of(self, connection: FrontConnection) -> str:
        """The key of the TCP connections by which this connection may ask: of people behind a gateway, its."""
        if self._keyring.key is None:
            return ""
        gateway = self._clients.by_number.get(connection.gateway)
        return connection.key_id if gateway is None else gateway.key_id
