"""Which assets are served: those of two scenes, and for a while the specifications before them."""

from __future__ import annotations

import zmq

from iris_session.front.asset_server import AssetAccess
from iris_session.front.asset_service import LATE_NS, LATE_TICK_NS, PERIOD_NS, REPLACED_NS, AssetService
from iris_session.front.connections import FrontConnection, Peer, Route
from iris_session.front.state_publisher import StatePublisher
from iris_session.link.config import SceneInfo
from iris_session.protocol.client_messages import Hello
from iris_session.protocol.limits import Drops
from iris_session.security import AllowedKey, KeyPair
from iris_session.security.keyring import Keyring
from tests.front.fakes import make_context

ROOT = "/store"


class FakeServer:
    """In place of the thread: keeps what it is server, at the time that it is."""

    def __init__(self) -> None:
        self.table = AssetAccess()
        self.late_until_ns = self.sent_bytes = self.requests = self.pending_readers = 0
        self.drops = Drops()

    def start(self) -> None: ...

    def set_access(self, access: AssetAccess) -> None:
        self.table = access

    @property
    def served(self) -> set[str]:
        return {address for root, addresses in self.table.folders for address in addresses if root == ROOT}


class AssetServiceRig:
    def __init__(self, keyring: Keyring | None = None) -> None:
        context: zmq.Context[zmq.Socket[bytes]] = zmq.Context.instance()
        self.publisher = StatePublisher(context.socket(zmq.PUB), look(0), lambda: 0)
        self.publisher.replace_socket(None)
        self.server = FakeServer()
        front = make_context(self, lambda: 0, keyring=keyring, publisher=self.publisher)
        self.clients, self.tokens = front.connections, front.tokens
        self.service = AssetService(front, self.server)  # type: ignore[arg-type]

    def join(self, number: int, key: str, gateway: int = 0, role: str = "observer") -> None:
        route, peer = Route(b"%d" % number), Peer(number, key)
        connection = FrontConnection(number, route, peer, ("127.0.0.1", 1), key, Hello(role, "Ann"), gateway)
        connection.admitted = True
        self.clients.add(connection)

    def show(self, info: SceneInfo) -> set[str]:
        self.publisher.set_scene(info)
        self.service.sync_clients()
        return self.server.served


def look(number: int) -> SceneInfo:
    return SceneInfo(f"look{number}", asset_root=ROOT, assets=(f"look{number}", f"mesh{number}"))


def test_current_and_previous_scene_are_served_and_of_older_ones_their_specifications() -> None:
    rig = AssetServiceRig()
    assert rig.show(look(0)) == {"look0", "mesh0"}
    assert rig.show(look(1)) == {"look0", "mesh0", "look1", "mesh1"}
    assert rig.show(look(2)) == {"look0", "look1", "mesh1", "look2", "mesh2"}
    assert rig.service.report().served == 2
    plain = SceneInfo("a model")
    rig.show(plain)
    rig.show(look(3))
    assert rig.show(look(4)) == {"look0", "look1", "look2", "look3", "mesh3", "look4", "mesh4"}, "it offers nothing"


def test_specifications_replaced_long_ago_are_not_served() -> None:
    rig = AssetServiceRig()
    rig.service.tick(0)
    for number in range(3):
        rig.show(look(number))
    rig.service.tick(REPLACED_NS)
    assert "look0" in rig.server.served
    rig.show(look(3))
    rig.service.tick(REPLACED_NS + PERIOD_NS)
    assert rig.server.served >= {"look1", "look2", "look3"}
    assert "look0" not in rig.server.served
    rig.service.tick(2 * REPLACED_NS + PERIOD_NS)
    assert rig.server.served == {"look2", "mesh2", "look3", "mesh3"}


def test_access_is_by_own_key_or_gateway_key_and_never_by_revoked_keys() -> None:
    listed = {mark: AllowedKey(mark, "") for mark in ("ann", "gate", "eve")}
    rig = AssetServiceRig(Keyring(KeyPair.generate(), read=lambda: listed))
    rig.join(1, "ann")
    rig.join(2, "gate", role="gateway")
    rig.join(3, "bob", gateway=2)
    rig.tokens.revoke_key("eve")
    rig.service.tick(0)
    assert rig.server.table.allowed_keys == {"ann", "gate"}
    assert rig.server.table.clients == {1: "ann", 2: "gate", 3: "gate"}
    assert rig.server.table.gateways == {2}
    rig.tokens.revoke_key("ann")
    rig.service.tick(PERIOD_NS)
    assert rig.server.table.allowed_keys == {"gate"}


def test_assets_yield_when_state_or_loop_is_late() -> None:
    rig = AssetServiceRig()
    now_ns, steps = 1, rig.publisher

    def yields(after_ns: int, *, delay_ns: int | None) -> bool:
        """Poll so long after the last time, with a state sent so late, or without one."""
        nonlocal now_ns
        now_ns += after_ns
        if delay_ns is not None:
            steps.frames += 1
            steps._delays.append((now_ns, delay_ns))
        rig.server.late_until_ns = 0
        rig.service.tick(now_ns)
        return rig.server.late_until_ns > now_ns

    assert not yields(0, delay_ns=None)
    assert not yields(LATE_TICK_NS, delay_ns=LATE_NS)
    assert yields(1, delay_ns=LATE_NS + 1)
    assert not yields(1, delay_ns=None), "of a state that was late long ago"
    assert yields(LATE_TICK_NS + 1, delay_ns=None)
    assert yields(LATE_TICK_NS + 1, delay_ns=0), "state in time does not make up for a loop that was late"
