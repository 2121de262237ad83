"""Access to assets: which clients may fetch which assets. Updates the thread of `asset_server` on every change."""

from __future__ import annotations

from collections import deque
from typing import Final

from iris_session.front.asset_server import AssetAccess, AssetFolder, AssetServer
from iris_session.front.context import FrontContext
from iris_session.link.config import MILLISECOND, SceneInfo
from iris_session.protocol.names import Role
from iris_session.protocol.status import AssetsReport

PERIOD_NS: Final = 250 * MILLISECOND
#: State sent so long after its tick is late: the limit for its whole way to a client is 3 ms.
LATE_NS: Final = 2 * MILLISECOND
#: A tick of the loop that is so long after the one before is late: they come every 10 ms.
LATE_TICK_NS: Final = 25 * MILLISECOND
#: How long assets yield then.
YIELD_NS: Final = 20 * MILLISECOND
#: Specifications of earlier scenes are served for so long after they were replaced, so that a client on a slow network
#: gets one however often the scene is patched; and so many of them.
REPLACED_NS: Final = 5_000 * MILLISECOND
MAX_REPLACED: Final = 64


class AssetService:
    """Decide which assets are served to whom. A `Service`.

    Served are the assets of the present scene and of the one before, and specifications that were replaced lately.
    """

    def __init__(self, context: FrontContext, server: AssetServer) -> None:
        self._context = context
        self._server = server
        self._previous: SceneInfo | None = None
        self._present: SceneInfo | None = None
        self._folders: tuple[AssetFolder, ...] = ()  # the present one is the last
        self._replaced: deque[tuple[int, AssetFolder]] = deque(maxlen=MAX_REPLACED)  # until when
        self._published = AssetAccess()
        self._counted: dict[str, int] = {}
        self._next_ns = self._ticked_ns = self._frames = 0
        server.start()

    def tick(self, now_ns: int) -> None:
        """Take over which clients are admitted, and let assets yield to late state."""
        self._yield_to_state(now_ns)
        due = now_ns >= self._next_ns
        if due:
            self._next_ns = now_ns + PERIOD_NS
            self._expire_replaced(now_ns)
            self._count_drops()
        self.sync_clients(keys=due)

    def sync_clients(self, *, keys: bool = False) -> None:
        """Update the thread's clients and scene. `keys`: also if only the allow-list may have changed."""
        if self._context.publisher.scene is not self._present:
            self._change_scene(self._context.publisher.scene)
        listeners = {
            n: self._context.find_channel_key(one)
            for n, one in self._context.connections.by_number.items()
            if one.admitted
        }
        if keys or listeners != self._published.clients or self._folders is not self._published.folders:
            self._publish_access(listeners)

    def close(self) -> None:
        self._server.close()

    def report(self) -> AssetsReport:
        """Return the counters for the status."""
        server = self._server
        return AssetsReport(
            sum(len(addresses) for _, addresses in self._folders[-1:]),
            server.sent_bytes,
            server.requests,
            sum(dict(server.drops.by_reason).values()),
            server.pending_readers,
        )

    def _yield_to_state(self, now_ns: int) -> None:
        """Let assets yield if state was late since the last tick, or this tick is."""
        late = 0 < self._ticked_ns < now_ns - LATE_TICK_NS
        if self._context.publisher.frames != self._frames:
            late |= self._context.publisher.newest_delay_ns > LATE_NS
        self._frames, self._ticked_ns = self._context.publisher.frames, now_ns
        if late:
            self._server.late_until_ns = now_ns + YIELD_NS

    def _change_scene(self, scene: SceneInfo) -> None:
        """Serve another scene. Assets of the scene before the last are served no longer, except its specification."""
        before, present = self._previous, self._present
        if before is not None and before.scene_hash in before.assets:
            self._replaced.append((self._ticked_ns + REPLACED_NS, (before.asset_root, (before.scene_hash,))))
        self._previous, self._present = present, scene
        self._update_folders()

    def _expire_replaced(self, now_ns: int) -> None:
        """Stop serving specifications that were replaced long enough ago."""
        n = len(self._replaced)
        while self._replaced and self._replaced[0][0] < now_ns:
            self._replaced.popleft()
        if len(self._replaced) < n:
            self._update_folders()

    def _update_folders(self) -> None:
        named = [(one.asset_root, one.assets) for one in (self._previous, self._present) if one is not None]
        self._folders = (*(store for _, store in self._replaced), *named)

    def _publish_access(self, listeners: dict[int, str]) -> None:
        keyring = self._context.keyring
        keys: frozenset[str] = frozenset()
        if keyring.key is not None:
            keys = frozenset(key for key in keyring.fingerprints if not self._context.tokens.is_revoked(key))
        connections = self._context.connections.by_number
        gateways = frozenset(n for n in listeners if connections[n].hello.role == Role.GATEWAY)
        access = AssetAccess(listeners, keys, self._folders, gateways)
        if access != self._published:
            self._published = access
            self._server.set_access(access)

    def _count_drops(self) -> None:
        for reason, count in dict(self._server.drops.by_reason).items():
            more = count - self._counted.get(reason, 0)
            if more:
                self._context.drops.count(reason, n=more)
                self._counted[reason] = count
