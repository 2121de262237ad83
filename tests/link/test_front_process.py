"""The front as a process: how it starts, ends, and is replaced after a crash or when it hangs.

`test_front_supervision.py` has what decides about it.
"""

from __future__ import annotations

import os
import signal
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import zmq
import zmq.auth

from iris_session.link import FrontConfig, FrontProcess
from iris_session.protocol.client_messages import GetSnapshot, Heartbeat, Hello, wrap_message
from iris_session.protocol.codec import encode_client
from iris_session.protocol.entries import FrontRestarted, Join
from iris_session.protocol.server_messages import ProtocolFault, Snapshot
from iris_session.security import KeyHome
from tests.front.process_harness import ProcessSession, scene

pytestmark = pytest.mark.e2e
OpenSession = Callable[..., ProcessSession]


def gone(pid: int) -> bool:
    """Return whether a process has ended; a zombie counts, its parent has not collected it yet."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] == "Z"
    except FileNotFoundError:
        return True


def wait(condition: Callable[[], bool], what: str) -> None:
    deadline = time.monotonic() + 60
    while not condition():
        assert time.monotonic() < deadline, f"no {what}"
        time.sleep(0.005)


def test_networks_are_encrypted_with_a_key_made_on_first_use(tmp_path: Path) -> None:
    home = tmp_path / "home"
    process = FrontProcess(FrontConfig(host="0.0.0.0", control_port=0, state_port=0, key_home=str(home)), scene())
    mark = process.start().key_fingerprint
    process.close()
    assert mark == KeyHome(home).load_server_key().fingerprint
    assert home.stat().st_mode & 0o777 == 0o700
    assert (home / "server.key_secret").stat().st_mode & 0o777 == 0o600
    assert KeyHome(home).sessions.read() == []


def test_close_ends_the_process_and_leaves_no_file(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    process = FrontProcess(FrontConfig(control_port=0, state_port=0), scene())
    process.start()
    (folder,) = tmp_path.iterdir()
    assert folder.stat().st_mode & 0o777 == 0o700
    pid = process.pid
    process.close()
    process.close()
    assert gone(pid)
    assert list(tmp_path.iterdir()) == []


def test_ipv6(open_process: OpenSession) -> None:
    session = open_process(host="::1")
    assert session.ports.host == "[::1]"
    with session.context.socket(zmq.DEALER) as client:
        client.linger = 0
        client.ipv6 = True
        client.connect(f"tcp://{session.ports.host}:{session.ports.control}")
        client.send(encode_client(wrap_message(Hello("operator", "Ann", secret=b"s" * 16))))
        session.wait_entries(Join)
        session.pump(lambda: bool(client.poll(0)), "welcome over IPv6")


def test_crashed_front_is_replaced_and_its_successor_knows_what_it_knew(process_session: ProcessSession) -> None:
    """The same ports, resume tokens, counters and the number of the newest state; and a scene that came meanwhile."""
    session = process_session
    client = session.client()
    token = client.join().resume_token
    client.socket.send(b"nonsense")
    assert session.wait_drops("malformed") == 1
    session.send_state(np.zeros((3, 7)))
    session.once()
    ports = session.process.link.ports
    os.kill(session.process.pid, signal.SIGKILL)
    wait(lambda: session.process.poll(time.monotonic_ns()), "crash")
    session.process.set_scene(scene(5))
    session.pump(lambda: session.process.link.ports is not None, "new front")
    assert session.process.link.ports == ports
    assert session.process.restarts == 1
    session.wait_entries(FrontRestarted)
    client.send(Heartbeat())
    session.pump(lambda: any(f.code == "hello" for f in client.got(ProtocolFault)), "fault from the new front")
    welcome = client.join(resume_token=token)
    assert (welcome.resumed, welcome.participant_id, welcome.connection_epoch) == (True, "p1", 2)
    client.socket.send(b"nonsense")
    session.pump(lambda: session.process.link.status.drops["malformed"] == 2, "sum")
    session.send_state(np.zeros((5, 7)))
    client.send(GetSnapshot(1))
    snapshot = client.wait_for(Snapshot)
    assert len(snapshot.bodies) == 5
    assert snapshot.state_seq > 1


def test_hanging_front_is_replaced(process_session: ProcessSession) -> None:
    session = process_session
    client = session.client()
    token = client.join().resume_token
    session.once()
    before, hung = time.monotonic(), session.process.pid
    os.kill(hung, signal.SIGSTOP)
    session.pump(lambda: session.process.poll(time.monotonic_ns()), "notice")
    assert time.monotonic() - before > 1.0, "not at the first silence"

    def has_new_front() -> bool:
        session.process.poll(time.monotonic_ns())
        return session.process.link.ports is not None

    session.pump(has_new_front, "new front")
    assert gone(hung)
    assert client.join(resume_token=token).resumed
