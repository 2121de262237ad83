"""The front process and real sockets: floods of connections, CURVE keys, revocation, the state socket opened anew."""

from __future__ import annotations

import os
import socket
from pathlib import Path

import numpy as np
import pytest
import zmq

from iris_session.link import FrontLimits
from iris_session.protocol.client_messages import EStop, Hello, Marker
from iris_session.protocol.entries import Lost
from iris_session.protocol.limits import MAX_CONTROL_BYTES
from iris_session.protocol.names import FaultCode, RefusalCode
from iris_session.protocol.server_messages import ProtocolFault, Refused
from iris_session.security import KeyPair
from iris_session.system.priority import LOW_PRIORITY_NICE
from tests.front.lab import Lab, Open

pytestmark = pytest.mark.e2e


def is_closed(tcp: socket.socket) -> bool:
    tcp.setblocking(False)
    try:
        while tcp.recv(65536):
            pass
    except BlockingIOError:
        return False
    except OSError:
        return True
    return True


def test_floods_of_unauthenticated_connections_keep_no_known_key_out_and_end(
    open_process: Open, tmp_path: Path
) -> None:
    """Half-open TCP connections on every socket, unfinished handshakes, unknown keys, and a frame that is too large."""
    limits = FrontLimits(unauthenticated=64, hello_timeout_ns=6_000_000_000)
    lab = Lab(lambda **config: open_process(limits=limits, **config), tmp_path / "home")
    session = lab.session
    ports = (session.ports.control, session.ports.state, session.ports.assets)
    crowd = [socket.create_connection((session.host, port)) for port in ports for _ in range(100)]
    for tcp in crowd[::3]:
        tcp.sendall(b"\xff" + bytes(8) + b"\x7f")  # the beginning of a greeting
    for tcp in crowd[1::3]:
        tcp.sendall(os.urandom(200))
    unknown = [lab.client(KeyPair.generate()) for _ in range(20)]
    for client in unknown:
        client.send(Hello("operator", "Eve"))
    ann, client = lab.allowed("ann")
    state = session.subscriber(curve=lab.curve(ann))

    def has_state() -> bool:
        session.send_state(np.zeros((3, 7)))
        return bool(state.poll(0))

    session.pump(has_state, "state")
    huge = lab.client(KeyPair.generate())
    huge.socket.send(b"x" * (MAX_CONTROL_BYTES + 1))
    client.send(EStop())
    session.wait_entries(EStop, connection=client.epoch)
    assert session.wait_drops("strangers_too_many") > 0
    assert not [entry for entry in session.entries if isinstance(entry.message, Lost)]
    assert unknown[0].wait_for(Refused).code == RefusalCode.UNPAIRED
    session.pump(lambda: all(is_closed(tcp) for tcp in crowd), "all of them are closed")
    lab.client(KeyPair.generate())  # which says no hello
    assert session.wait_drops("no_hello") > 0
    for tcp in crowd:
        tcp.close()


def test_a_revoked_key_is_refused_and_the_state_socket_is_opened_anew(process_lab: Lab) -> None:
    lab, session = process_lab, process_lab.session
    ann, ann_client = lab.allowed("ann")
    bob, bob_client = lab.allowed("bob")
    curves = [lab.curve(pair) for pair in (ann, bob, KeyPair.generate())]
    ann_state, bob_state, eve_state = (session.subscriber(curve=curve) for curve in curves)
    monitor = bob_state.get_monitor_socket(zmq.EVENT_DISCONNECTED)

    def has_state(sub: zmq.Socket[bytes]) -> bool:
        session.send_state(np.zeros((3, 7)))
        return bool(sub.poll(0))

    session.pump(lambda: has_state(ann_state) and has_state(bob_state), "state for both")
    assert not eve_state.poll(50), "an unknown key gets no state"
    lab.home.clients.revoke_key("ann")
    assert ann_client.wait_for(ProtocolFault).code == FaultCode.REVOKED
    session.pump(lambda: bool(monitor.poll(0)), "the state socket is closed")
    for sub in (ann_state, bob_state):
        while sub.poll(50):
            sub.recv_multipart()
    session.pump(lambda: has_state(bob_state), "state for bob again")
    assert not ann_state.poll(50)
    assert lab.refused(lab.client(ann), Hello("operator", "ann")).code == RefusalCode.UNPAIRED
    bob_client.send(Marker(1, "still here"))
    session.wait_entries(Marker)
    bob_state.disable_monitor()
    monitor.close()
    tasks = Path(f"/proc/{session.process.pid}/task").iterdir()
    names = {(task / "comm").read_text().strip(): int(task.name) for task in tasks}
    loop, media = (os.getpriority(os.PRIO_PROCESS, one) for one in (session.process.pid, names["ZMQbg/IO/1"]))
    assert media == min(19, loop + LOW_PRIORITY_NICE), "media are decrypted after other work"
