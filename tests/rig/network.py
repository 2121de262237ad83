"""Sockets in memory: those of the front, and one `ClientSockets` per client, with a link between them.

A link delays by the conditions of `netsim`, keeps the order of bytes as TCP does, loses nothing until it is cut, and
has room for a few messages: what does not fit is refused to the sender, as ZeroMQ does.
"""

from __future__ import annotations

import errno
import struct
from collections import deque
from collections.abc import Callable, Sequence
from typing import Any, Final

import zmq

from iris_session.netsim.profiles import DOWN, UP, LinkConditions, load_profile
from iris_session.protocol.server_messages import TOPIC_ROBOTS
from tests.rig.simulation import Simulation

#: Above every file descriptor of this process, so that no call of the system finds one.
FIRST_DESCRIPTOR: Final = 1_000_000
#: Messages on their way to one client: of control those that ZeroMQ and TCP hold, of state two on each side.
CONTROL_ROOM: Final = 1024
STATE_ROOM: Final = 4
MAX_DRAIN: Final = 64


class Frame:
    """A received frame, as pyzmq gives one with `copy=False`."""

    def __init__(self, data: bytes, descriptor: int, *, more: bool) -> None:
        self.buffer = memoryview(data)
        self.bytes = data
        self.more = more
        self._descriptor = descriptor

    def get(self, option: Any) -> Any:
        if option == zmq.SRCFD:
            return self._descriptor
        raise zmq.ZMQError(zmq.EINVAL)


class Inbox:
    """A socket that receives: messages of frames, and the descriptor that each came from."""

    def __init__(self) -> None:
        self._messages: deque[tuple[list[bytes], int]] = deque()
        self._rest: deque[Frame] = deque()
        self.on_message: Callable[[], None] = lambda: None
        self.closed = False
        self.peer: Inbox | None = None

    def push(self, frames: Sequence[bytes], descriptor: int = 0) -> None:
        self._messages.append(([bytes(one) for one in frames], descriptor))
        self.on_message()

    def get(self, option: Any) -> int:
        if option != zmq.EVENTS:
            return 0
        return int(zmq.POLLIN) if self._messages or self._rest else 0

    def recv_multipart(self, _flags: int = 0) -> list[bytes]:
        return self._messages.popleft()[0]

    def recv(self, _flags: int = 0, *, copy: bool = True) -> Any:
        if not self._rest:
            frames, descriptor = self._messages.popleft()
            self._rest += [Frame(one, descriptor, more=i < len(frames)) for i, one in enumerate(frames, 1)]
        frame = self._rest.popleft()
        return frame.bytes if copy else frame

    def send_multipart(self, frames: Sequence[bytes], _flags: int = 0) -> None:
        """Send to the other end of a pair; to nobody when that is gone."""
        if self.peer is not None:
            self.peer.push(frames)

    def close(self, linger: int = 0) -> None:
        if self.peer is not None:
            self.peer.peer = None
            self.peer = None


def make_pair() -> tuple[Inbox, Inbox]:
    """Return the two ends of a connection between processes of one machine, which delays nothing."""
    one, other = Inbox(), Inbox()
    one.peer, other.peer = other, one
    return one, other


class Monitor(Inbox):
    """Reports opened and closed TCP connections, as the monitor of a socket does."""

    def report(self, event: int, descriptor: int) -> None:
        self.push([struct.pack("=HI", event, descriptor), b""])


class Connection:
    """A TCP connection of a client's control socket to a front, with the routing id that the front gives it."""

    def __init__(self, sockets: RigClientSockets, front: FrontEnd, descriptor: int) -> None:
        self.sockets = sockets
        self.front = front
        self.descriptor = descriptor
        self.routing_id = b"\0" + struct.pack(">I", descriptor)
        self.address = (sockets.host_address, descriptor % 50_000 + 1024)
        self.in_flight = 0
        self.is_open = True


class FrontEnd:
    """The sockets for clients of one front: `Network` delivers to them."""

    def __init__(self, network: Network) -> None:
        self.network = network
        self.control, self.monitor = _Router(self), Monitor()
        self.state, self.state_monitor = _Publisher(self), Monitor()
        self.connections: dict[bytes, Connection] = {}
        self.is_listening = True


class _Router(Inbox):
    def __init__(self, front: FrontEnd) -> None:
        super().__init__()
        self._front = front

    def send_multipart(self, frames: Sequence[bytes], _flags: int = 0) -> None:
        connection = self._front.connections.get(bytes(frames[0]))
        if connection is None:
            raise zmq.ZMQError(zmq.EHOSTUNREACH)
        if connection.in_flight >= CONTROL_ROOM:
            raise zmq.ZMQError(zmq.EAGAIN)
        connection.in_flight += 1
        copies = [bytes(one) for one in frames[1:]]
        connection.sockets.link.send(DOWN, lambda: connection.sockets.receive_control(connection, copies))


class _Publisher(Inbox):
    def __init__(self, front: FrontEnd) -> None:
        super().__init__()
        self._front = front

    def send_multipart(self, frames: Sequence[bytes], _flags: int = 0) -> None:
        copies = [bytes(one) for one in frames]
        for connection in self._front.connections.values():
            sockets = connection.sockets
            is_subscribed = sockets.connection is connection and sockets.subscribed is self._front
            is_subscribed &= sockets.reads_robots or copies[0] != TOPIC_ROBOTS
            if is_subscribed and sockets.states_in_flight < STATE_ROOM:
                sockets.states_in_flight += 1
                sockets.link.send(DOWN, lambda sockets=sockets: sockets.receive_state(copies))  # type: ignore[misc]


class Link:
    """The path between one client and the session's machine. `cut` breaks it, `restore` mends it."""

    def __init__(self, simulation: Simulation, profile: str, seed: int) -> None:
        self._simulation = simulation
        self._conditions = LinkConditions(load_profile(profile), seed)
        self._start_ns = simulation.now_ns
        self._last_ns = {UP: 0, DOWN: 0}
        self.stalled_until_ns = 0

    def send(self, direction: str, deliver: Callable[[], None]) -> None:
        """Deliver after the delay of the link, in the order of these calls."""
        now_ns = self._simulation.now_ns - self._start_ns
        self._conditions.advance(now_ns)
        leaves_ns = now_ns
        if self._conditions.is_stalled(direction, now_ns):
            leaves_ns = min(self._conditions.find_next_change_ns(now_ns), now_ns + 60_000_000_000)
        arrives_ns = self._start_ns + leaves_ns + self._conditions.compute_delay_ns(direction, now_ns)
        arrives_ns = max(arrives_ns, self.stalled_until_ns, self._last_ns[direction])
        self._last_ns[direction] = arrives_ns
        self._simulation.call_at(arrives_ns, deliver)

    def stall(self, seconds: float) -> None:
        """Let nothing pass for a while; then everything arrives at once."""
        self.stalled_until_ns = self._simulation.now_ns + round(seconds * 1e9)


class Network:
    """All links to one session's machine, and the front that listens there now."""

    def __init__(self, simulation: Simulation) -> None:
        self.simulation = simulation
        self.front: FrontEnd | None = None
        self.connections: dict[int, Connection] = {}  # by descriptor
        self._next_descriptor = FIRST_DESCRIPTOR

    def listen(self) -> FrontEnd:
        """Open the sockets of a new front."""
        self.front = FrontEnd(self)
        return self.front

    def end_front(self) -> None:
        """Close every connection and the listening sockets, as the end of a process does."""
        front, self.front = self.front, None
        if front is not None:
            front.is_listening = False
            for connection in list(front.connections.values()):
                self.close(connection)

    def try_port(self, *_: object) -> Inbox:
        """Open and forget a TCP connection, as commands do to see whether anything listens."""
        if self.front is None:
            raise ConnectionRefusedError(errno.ECONNREFUSED, "Connection refused")
        return Inbox()

    def connect(self, sockets: RigClientSockets) -> Connection | None:
        """Open a TCP connection to the present front; `None` while there is none."""
        front = self.front
        if front is None:
            return None
        self._next_descriptor += 1
        connection = Connection(sockets, front, self._next_descriptor)
        self.connections[connection.descriptor] = front.connections[connection.routing_id] = connection
        front.monitor.report(int(zmq.EVENT_ACCEPTED), connection.descriptor)
        return connection

    def close(self, connection: Connection, *, notify: bool = True) -> None:
        """Close a TCP connection. `notify`: also the client notices."""
        if not connection.is_open:
            return
        connection.is_open = False
        connection.front.connections.pop(connection.routing_id, None)
        self.connections.pop(connection.descriptor, None)
        connection.front.monitor.report(int(zmq.EVENT_DISCONNECTED), connection.descriptor)
        if notify:
            connection.sockets.link.send(DOWN, lambda: connection.sockets.lose_connection(connection))

    def abandon(self, connection: Connection) -> None:
        """End a TCP connection at the client's side alone, as a change of its address does: the front is not told."""
        sockets = connection.sockets
        sockets.link.send(DOWN, lambda: sockets.lose_connection(connection))

    # --- in place of the functions of `link.sockets` that ask the system ----------------------------------------------

    def peer_of(self, descriptor: int) -> tuple[str, int]:
        connection = self.connections.get(descriptor)
        return ("", 0) if connection is None else connection.address

    def close_tcp(self, descriptor: int, peer: tuple[str, int], *, discard: bool = False) -> bool:
        connection = self.connections.get(descriptor)
        if connection is None or connection.address != peer:
            return False
        self.close(connection)
        return True

    def tcp_counts(self, descriptor: int) -> None:
        """Return `None`: there are no counts of the system."""

    def pace_tcp(self, descriptor: int, peer: tuple[str, int], bytes_per_s: float) -> None:
        """Do nothing: the rig has no media."""


class RigClientSockets:
    """In place of `ClientSockets`: control and state of one client. Media and assets are not carried."""

    has_media = has_assets = False

    def __init__(self, network: Network, profile: str, seed: int) -> None:
        self._network = network
        self._simulation = network.simulation
        self.link = Link(network.simulation, profile, seed)
        self.host_address = f"192.0.2.{1 + seed % 250}"
        self.connection: Connection | None = None
        self.subscribed: FrontEnd | None = None
        self.reads_robots = False
        self.states_in_flight = 0
        self.on_arrival: Callable[[], None] = lambda: None
        self._control: list[list[bytes]] = []
        self._state: list[list[bytes]] = []
        self._is_lost = self._has_arrived = False

    def _arrive(self) -> None:
        self._has_arrived = True
        self.on_arrival()

    # --- connections ------------------------------------------------------------------------------------------------

    def set_target(self, host: str, control_port: int, curve: object) -> None:
        """The session is where the network has it."""

    def open_control(self) -> None:
        self._end_connection()
        self._control, self._is_lost = [], False
        self.connection = self._network.connect(self)

    def open_state(self, port: int, generation: int, robots: bool = False) -> None:
        self.reads_robots = robots
        if self.connection is not None:
            self.subscribed = self.connection.front

    def lose_connection(self, connection: Connection) -> None:
        if connection is self.connection:
            self.connection, self._is_lost = None, True
            self._arrive()

    def disconnect(self) -> None:
        self.close()

    def close(self) -> None:
        self._end_connection()
        self.subscribed = None

    def _end_connection(self) -> None:
        """End the connection, which the front learns after what was sent over it."""
        if self.connection is not None:
            connection, self.connection = self.connection, None
            self.link.send(UP, lambda: self._network.close(connection, notify=False))

    # --- messages ---------------------------------------------------------------------------------------------------

    def send_control(self, data: bytes) -> bool:
        if self.connection is None:
            self.connection = self._network.connect(self)  # as ZeroMQ, which tries again
        connection = self.connection
        if connection is None:
            return False

        def deliver() -> None:
            if connection.is_open:
                connection.front.control.push([connection.routing_id, data], connection.descriptor)

        self.link.send(UP, deliver)
        return True

    def receive_control(self, connection: Connection, frames: list[bytes]) -> None:
        connection.in_flight -= 1
        if connection is self.connection:
            self._control.append(frames)
            self._arrive()

    def receive_state(self, frames: list[bytes]) -> None:
        self.states_in_flight -= 1
        if self.subscribed is not None and self.subscribed.is_listening:
            self._state.append(frames)
            self._arrive()

    def drain_control(self) -> list[list[bytes]]:
        drained, self._control = self._control[:MAX_DRAIN], self._control[MAX_DRAIN:]
        return drained

    def drain_state(self) -> list[list[bytes]]:
        drained, self._state = self._state, []
        return drained

    @property
    def has_state(self) -> bool:
        return bool(self._state)

    def poll_disconnect(self) -> bool:
        lost, self._is_lost = self._is_lost, False
        return lost

    def wait(self, timeout_ns: int, *, sending: bool) -> None:
        """Let the rig go on until something has arrived here, at most for `timeout_ns`."""
        self._has_arrived = False
        self._simulation.run(self._simulation.now_ns + timeout_ns, lambda: self._has_arrived)

    def wake(self) -> None: ...

    def clear_wake(self) -> None: ...

    def register_wake(self, poller: object) -> None: ...

    def enable_wake_registration(self) -> None: ...

    # --- media and assets: none -------------------------------------------------------------------------------------

    def subscribe_media(self, port: int, topics: Sequence[bytes]) -> None: ...

    def unsubscribe_media(self, topic: bytes) -> None: ...

    def drain_media(self) -> list[list[bytes]]:
        return []

    def close_media(self) -> None: ...

    def close_assets(self) -> None: ...

    def poll_assets_disconnect(self) -> bool:
        return False

    def drain_assets(self) -> list[list[memoryview]]:
        return []


def refuse_introduction(*_: object) -> Any:
    """Answer as a port without an introduction does: clients of loopback then connect without encryption."""
    raise ConnectionRefusedError
    yield
