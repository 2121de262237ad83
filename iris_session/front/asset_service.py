"""Who may have which assets: the front's side of the assets channel. Tells its thread whenever something changed."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import Final

from iris_session.front.asset_server import AssetServer, Store, Table
from iris_session.front.connections import ClientTable, Connection
from iris_session.front.state_publisher import StatePublisher
from iris_session.link.config import MILLISECOND, SceneInfo
from iris_session.protocol.status import AssetsReport
from iris_session.protocol.token_bucket import Drops
from iris_session.security.keyring import Keyring

LOOK_NS: Final = 250 * MILLISECOND
#: State that left so long after its tick is late: the bar for its whole way to a client is 3 ms.
LATE_NS: Final = 2 * MILLISECOND
#: Between two turns of the loop, which come every 10 ms.
LATE_TURN_NS: Final = 25 * MILLISECOND
#: How long assets hold back then.
YIELD_NS: Final = 20 * MILLISECOND
#: Specifications of scenes before those two are served for so long after they were replaced, so that whoever hears of
#: them over a slow network gets one, however often the scene is patched; and so many of them.
REPLACED_NS: Final = 5_000 * MILLISECOND
MAX_REPLACED: Final = 64


class AssetDesk:
    """A `Service`. Served is what the publisher's scene and the one before it name, and specifications that were
    replaced lately. `revoked(key)`: may do nothing."""

    def __init__(
        self,
        server: AssetServer,
        clients: ClientTable,
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
        self._before: SceneInfo | None = None
        self._present: SceneInfo | None = None
        self._stores: tuple[Store, ...] = ()  # the present one is the last
        self._replaced: deque[tuple[int, Store]] = deque(maxlen=MAX_REPLACED)  # until when
        self._told = Table()
        self._counted: dict[str, int] = {}
        self._next_ns = self._turned_ns = self._frames = 0
        server.start()

    def turn(self, now_ns: int) -> None:
        """Lets in who came and out who left, at once; gives the state its way."""
        self._give_way(now_ns)
        due = now_ns >= self._next_ns
        if due:
            self._next_ns = now_ns + LOOK_NS
            self._forget(now_ns)
            self._count()
        self.look(keys=due)

    def look(self, *, keys: bool = False) -> None:
        """Tells the thread who is there, and which scene. `keys`: also when only the allow-list may have changed."""
        if self._publisher.scene is not self._present:
            self._change(self._publisher.scene)
        listeners = {n: self._user_of(one) for n, one in self._clients.by_number.items() if one.admitted}
        if keys or listeners != self._told.listeners or self._stores is not self._told.stores:
            self._tell(listeners)

    def close(self) -> None:
        self._server.close()

    def report(self) -> AssetsReport:
        """For the status."""
        tallied = self._server.tallied()
        return AssetsReport(
            sum(len(addresses) for _, addresses in self._stores[-1:]),
            tallied.bytes,
            tallied.requests,
            sum(tallied.reasons.values()),
            tallied.waiting,
        )

    def _give_way(self, now_ns: int) -> None:
        """When state was late since the last turn, or this turn is."""
        late = 0 < self._turned_ns < now_ns - LATE_TURN_NS
        if self._publisher.frames != self._frames:
            late |= self._publisher.newest_delay_ns > LATE_NS
        self._frames, self._turned_ns = self._publisher.frames, now_ns
        if late:
            self._server.late_until_ns = now_ns + YIELD_NS

    def _change(self, scene: SceneInfo) -> None:
        """Another scene: what only the one before the last named is served no more, but for its specification."""
        before, present = self._before, self._present
        if before is not None and before.scene_hash in before.assets:
            self._replaced.append((self._turned_ns + REPLACED_NS, (before.asset_root, (before.scene_hash,))))
        self._before, self._present = present, scene
        self._serve()

    def _forget(self, now_ns: int) -> None:
        """Specifications that were replaced long enough ago."""
        n = len(self._replaced)
        while self._replaced and self._replaced[0][0] < now_ns:
            self._replaced.popleft()
        if len(self._replaced) < n:
            self._serve()

    def _serve(self) -> None:
        named = [(one.asset_root, one.assets) for one in (self._before, self._present) if one is not None]
        self._stores = (*(store for _, store in self._replaced), *named)

    def _tell(self, listeners: dict[int, str]) -> None:
        keyring = self._keyring
        marks = (
            frozenset() if keyring.key is None else frozenset(m for m in keyring.fingerprints if not self._revoked(m))
        )
        table = Table(listeners, marks, self._stores)
        if table != self._told:
            self._told = table
            self._server.publish(table)

    def _count(self) -> None:
        for reason, count in self._server.tallied().reasons.items():
            more = count - self._counted.get(reason, 0)
            if more:
                self._drops.count(reason, n=more)
                self._counted[reason] = count

    def _user_of(self, connection: Connection) -> str:
        """The key of the TCP connections by which this connection may ask: of people behind a gateway, its."""
        if self._keyring.key is None:
            return ""
        gateway = self._clients.by_number.get(connection.gateway)
        return connection.key_id if gateway is None else gateway.key_id
