"""Starting, failing, stalling, restarting and ending the front process."""

from __future__ import annotations

import errno
import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import psutil
import pytest
import zmq
import zmq.auth

from iris_session.link import FrontConfig, FrontError, FrontLimits, FrontProcess
from iris_session.link.sockets import RESERVED_DESCRIPTORS
from iris_session.protocol.client_messages import GetSnapshot, Heartbeat, Hello, wrap_message
from iris_session.protocol.codec import decode_server, encode_client
from iris_session.protocol.entries import FrontRestarted, Join
from iris_session.protocol.server_messages import ProtocolFault, Snapshot
from iris_session.protocol.status import DeliveryBudget
from iris_session.security import KeyHome
from tests.front.altered_front import DESCRIPTORS, FEW_DESCRIPTORS, run_altered
from tests.front.process_harness import LONG_NS, ProcessClient, ProcessSession, scene
from tests.loopback import make_loopback_address

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


def wait_until_told(client: ProcessClient) -> list[str]:
    """Wait for the word of the end, which may come after the end of the front. Return the codes of all faults."""

    def codes() -> list[str]:
        client.receive()
        return [fault.code for fault in client.got(ProtocolFault)]

    wait(lambda: "session_ended" in codes(), "word of the end")
    return codes()


def test_port_in_use_error_names_the_port() -> None:
    host = make_loopback_address()  # the port before it, for the introduction, is free there
    with socket.create_server((host, 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(FrontError) as error:
            FrontProcess(FrontConfig(host=host, control_port=port, state_port=0), scene()).start()
    assert f"port {port} (control)" in str(error.value)


def test_networks_are_encrypted_with_a_key_made_on_first_use(tmp_path: Path) -> None:
    home = tmp_path / "home"
    config = FrontConfig(host="0.0.0.0", control_port=0, state_port=0, key_home=str(home))
    marks = []
    for _ in range(2):
        process = FrontProcess(config, scene())
        marks.append(process.start().key_fingerprint)
        process.close()
    assert marks[0] == marks[1] == KeyHome(home).load_server_key().fingerprint
    assert home.stat().st_mode & 0o777 == 0o700
    assert (home / "server.key_secret").stat().st_mode & 0o777 == 0o600
    assert KeyHome(home).sessions.read() == []


def test_damaged_allow_list_is_an_error_and_unchanged(tmp_path: Path) -> None:
    home = tmp_path / "home"
    KeyHome(home).load_server_key()
    damaged = home / "clients.json"
    damaged.write_text("[{")
    damaged.chmod(0o600)
    with pytest.raises(FrontError, match=r"clients\.json"):
        FrontProcess(FrontConfig(control_port=0, state_port=0, curve=True, key_home=str(home)), scene()).start()
    assert damaged.read_text() == "[{"


def test_foreign_address_is_an_error(tmp_path: Path) -> None:
    _certificate(tmp_path, "server")
    config = FrontConfig(
        host="203.0.113.9",  # TEST-NET-3, nobody's
        control_port=0,
        state_port=0,
        curve_secret_file=str(tmp_path / "server.key_secret"),
        curve_clients_dir=str(tmp_path),
    )
    with pytest.raises(FrontError, match=r"203\.0\.113\.9"):
        FrontProcess(config, scene()).start()


@pytest.mark.parametrize(
    ("secret_file", "folder", "text"),
    [
        ("server.key_secret", "missing", "missing"),
        ("nothing", ".", "nothing"),
        ("server.key", ".", "server.key"),
    ],
)
def test_unusable_keys_are_named(tmp_path: Path, secret_file: str, folder: str, text: str) -> None:
    _certificate(tmp_path, "server")
    config = FrontConfig(
        control_port=0,
        state_port=0,
        curve_secret_file=str(tmp_path / secret_file),
        curve_clients_dir=str(tmp_path / folder),
    )
    with pytest.raises(FrontError, match=text):
        FrontProcess(config, scene()).start()


def test_restarted_front_is_waited_for() -> None:
    config = FrontConfig(host=make_loopback_address(), control_port=0, state_port=0)  # no other test takes its ports
    process = FrontProcess(config, scene())
    ports = process.start()
    os.kill(process.pid, signal.SIGKILL)
    wait(lambda: not process.alive, "end")
    process.restart()
    assert process.wait_ready(60.0) == ports
    process.close()


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


def test_folder_too_long_for_a_socket_is_not_used(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    folder = tmp_path / ("x" * 100)
    folder.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(folder))
    process = FrontProcess(FrontConfig(control_port=0, state_port=0), scene())
    process.start()
    process.close()
    assert list(folder.iterdir()) == []


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


def test_clients_are_notified_when_the_session_is_closed(process_session: ProcessSession) -> None:
    session = process_session
    client = session.client()
    client.join()
    client.wait_for(DeliveryBudget)
    session.process.close(30.0)
    assert wait_until_told(client) == ["session_ended"]


def test_ctrl_c_in_the_terminal_reaches_only_the_parent(process_session: ProcessSession) -> None:
    session = process_session
    assert os.getsid(session.process.pid) == session.process.pid != os.getsid(0)


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_signals_end_the_front_cleanly(process_session: ProcessSession, number: signal.Signals) -> None:
    session = process_session
    client = session.client()
    client.join()
    os.kill(session.process.pid, number)
    wait(lambda: not session.process.alive, "end of the front")
    assert wait_until_told(client)[-1] == "session_ended"


def test_crashed_front_is_replaced_on_the_same_ports_and_tokens_stay_valid(process_session: ProcessSession) -> None:
    session = process_session
    client = session.client()
    token = client.join().resume_token
    session.once()
    ports = session.process.link.ports
    os.kill(session.process.pid, signal.SIGKILL)
    wait(lambda: not session.process.alive, "crash")
    session.process.restart()
    session.pump(lambda: session.process.link.ports is not None, "new front")
    assert session.process.link.ports == ports
    assert session.process.restarts == 1
    session.wait_entries(FrontRestarted)
    client.send(Heartbeat())
    session.pump(lambda: any(f.code == "hello" for f in client.got(ProtocolFault)), "fault from the new front")
    welcome = client.join(resume_token=token)
    assert welcome.resumed
    assert welcome.participant_id == "p1"
    assert welcome.connection_epoch == 2


def test_front_that_cannot_listen_again_says_why(process_session: ProcessSession) -> None:
    session = process_session
    address = session.host, session.ports.control
    os.kill(session.process.pid, signal.SIGKILL)
    wait(lambda: not session.process.alive, "crash")
    with socket.socket() as other:
        other.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        other.bind(address)
        other.listen()
        session.process.restart()

        def is_over() -> bool:
            session.process.link.receive()
            return not session.process.alive

        wait(is_over, "failure")
        assert f"port {address[1]}" in session.process.fault


def test_failed_start_of_a_front_is_retried(process_session: ProcessSession, monkeypatch: pytest.MonkeyPatch) -> None:
    session = process_session
    os.kill(session.process.pid, signal.SIGKILL)
    wait(lambda: not session.process.alive, "crash")
    ports = session.process.link.ports

    def refuse(*_: object, **__: object) -> None:
        raise OSError(errno.ENOMEM, os.strerror(errno.ENOMEM))

    with monkeypatch.context() as patch:
        patch.setattr(subprocess, "Popen", refuse)
        session.process.restart()
        wait(lambda: not session.process.alive, "failure")
    with pytest.raises(FrontError, match="Cannot allocate memory"):
        session.process.restart()
    assert not session.process.alive
    session.process.restart()
    session.pump(lambda: session.process.link.ports is not None, "new front")
    assert session.process.link.ports == ports


def test_hanging_front_is_replaced(process_session: ProcessSession) -> None:
    session = process_session
    client = session.client()
    token = client.join().resume_token
    session.once()
    before, hung = time.monotonic(), session.process.pid
    os.kill(hung, signal.SIGSTOP)
    session.pump(lambda: not session.process.alive, "notice")
    assert time.monotonic() - before > 1.0, "not at the first silence"
    session.process.restart()
    session.pump(lambda: session.process.link.ports is not None, "new front")
    assert gone(hung)
    assert client.join(resume_token=token).resumed


def test_stalled_authority_does_not_replace_the_front(process_session: ProcessSession) -> None:
    session = process_session
    client = session.client()
    client.join()
    os.kill(session.process.pid, signal.SIGSTOP)
    time.sleep(2.0)  # both stand still, as in a debugger
    os.kill(session.process.pid, signal.SIGCONT)
    assert session.process.alive
    session.once()
    assert session.process.alive


def test_scene_changed_during_a_restart_reaches_the_new_front(process_session: ProcessSession) -> None:
    session = process_session
    session.once()
    os.kill(session.process.pid, signal.SIGKILL)
    wait(lambda: not session.process.alive, "crash")
    session.process.restart()
    session.process.set_scene(scene(5))
    session.pump(lambda: session.process.link.ports is not None, "new front")
    client = session.client()
    client.join()
    client.send(GetSnapshot(1))
    assert len(client.wait_for(Snapshot).bodies) == 5


def test_drop_counts_survive_a_restart_of_the_front(process_session: ProcessSession) -> None:
    session = process_session
    client = session.client()
    client.join()
    client.socket.send(b"nonsense")
    assert session.wait_drops("malformed") == 1
    os.kill(session.process.pid, signal.SIGKILL)
    wait(lambda: not session.process.alive, "crash")
    session.process.restart()
    assert session.process.link.status.drops["malformed"] == 1
    client.join()
    client.socket.send(b"nonsense")
    session.pump(lambda: session.process.link.status.drops["malformed"] == 2, "sum")


def test_new_front_numbers_states_above_its_predecessor(process_session: ProcessSession) -> None:
    session = process_session
    poses = np.zeros((3, 7))
    client = session.client()
    client.join()
    session.send_state(poses)
    client.send(GetSnapshot(1))
    before = client.wait_for(Snapshot).state_seq
    assert before == 1
    os.kill(session.process.pid, signal.SIGKILL)
    wait(lambda: not session.process.alive, "crash")
    session.process.restart()
    session.pump(lambda: session.process.link.ports is not None, "new front")
    session.send_state(poses)
    client.join()
    client.send(GetSnapshot(2))
    assert client.wait_for(Snapshot, 2).state_seq > before


def test_closed_link_ends_the_front(process_session: ProcessSession) -> None:
    session = process_session
    client = session.client()
    client.join()
    session.process.link.close()
    wait(lambda: not session.process.alive, "end of the front")
    assert wait_until_told(client)[-1] == "session_ended"


def test_stalled_and_recovered_are_reported_once_each(open_process: OpenSession) -> None:
    session = open_process(stall_ns=FrontConfig().stall_ns)
    client = session.client()
    client.join()
    client.wait_for(DeliveryBudget)

    def told() -> list[str]:
        return [fault.code for fault in client.got(ProtocolFault)]

    while not told() or told()[-1] != "stalled":
        assert client.socket.poll(30_000), "no word about the stall"
        client.receive()
    assert client.socket.poll(300) == 0
    session.pump(lambda: told()[-1] == "recovered", "recovery")
    stalls = told().count("stalled")  # a machine with nothing to spare may have made others
    assert told() == ["stalled", "recovered"] * stalls


PARENT = """
import sys, time
from iris_session.link import FrontConfig, FrontProcess
from iris_session.protocol.steps import Admitted, Decision
from iris_session.protocol.entries import Join
from tests.front.process_harness import scene
process = FrontProcess(FrontConfig(control_port=0, state_port=0), scene())
print(process.start().control, process.pid, flush=True)
while True:
    joins = [e for e in process.link.poll() if isinstance(e.message, Join)]
    admitted = tuple(Admitted(e.connection, "p1", "operator", False) for e in joins)
    process.link.send_decision(0, Decision((), admitted=admitted))
    time.sleep(0.002)
"""


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM])
def test_front_ends_with_its_parent(number: signal.Signals, tmp_path: Path) -> None:
    environment = {**os.environ, "TMPDIR": str(tmp_path)}
    parent = subprocess.Popen([sys.executable, "-c", PARENT], stdout=subprocess.PIPE, text=True, env=environment)
    assert parent.stdout is not None
    port, pid = map(int, parent.stdout.readline().split())
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    client = context.socket(zmq.DEALER)
    client.linger = 0
    client.connect(f"tcp://127.0.0.1:{port}")
    client.send(encode_client(wrap_message(Hello("operator", "Ann", secret=b"s" * 16))))
    assert client.poll(30_000)
    client.recv()
    parent.send_signal(number)
    parent.wait()
    parent.stdout.close()
    wait(lambda: gone(pid), "end of the front")
    codes: list[str] = []
    while client.poll(100 if "session_ended" in codes else 30_000):
        message = decode_server(client.recv()).message
        codes += [message.code] if isinstance(message, ProtocolFault) else []
    assert codes[-1:] == ["session_ended"]
    assert list(tmp_path.iterdir()) == [], "nobody else can remove the folder of the link"
    context.destroy(linger=0)


def test_curve_accepts_only_allowed_keys_and_identifies_clients_by_key(
    open_process: OpenSession, tmp_path: Path
) -> None:
    keys = tmp_path / "clients"
    keys.mkdir()
    server_public, _ = _certificate(tmp_path, "server")
    ann = _certificate(keys, "ann")
    eve = _certificate(tmp_path, "eve")
    session = open_process(curve_secret_file=str(tmp_path / "server.key_secret"), curve_clients_dir=str(keys))
    assert session.ports.key_fingerprint
    allowed = session.client(curve=(server_public, *ann))
    again = session.client(curve=(server_public, *ann))
    allowed.send(Hello("operator", "Ann"))  # no secret: the key is the identity
    again.send(Hello("operator", "Ann"))
    first, second = (e.message for e in session.wait_entries(Join, 2))
    assert isinstance(first, Join)
    assert isinstance(second, Join)
    assert first.key_id == second.key_id
    subs = [session.subscriber(curve=(server_public, *keys)) for keys in (ann, eve)]
    poses = np.zeros((3, 7))

    def state_comes() -> bool:
        session.send_state(poses)
        return bool(subs[0].poll(0))

    session.pump(state_comes, "encrypted state")
    assert not subs[1].poll(0)
    unknown = session.client(curve=(server_public, *eve))
    unknown.send(Hello("operator", "Eve"))
    assert session.wait_drops("unknown_key") >= 1
    (keys / "eve.key").write_bytes((tmp_path / "eve.key").read_bytes())
    late = session.client(curve=(server_public, *eve))
    late.send(Hello("operator", "Eve"))
    session.wait_entries(Join, 3)
    plain = session.client()
    plain.send(Hello("operator", "Mallory", secret=b"s" * 16))
    late.send(Heartbeat(), epoch=3)
    session.wait_entries(Heartbeat)
    assert len(session.wait_entries(Join)) <= 4
    assert "Mallory" not in {e.message.name for e in session.wait_entries(Join) if isinstance(e.message, Join)}


def _certificate(folder: Path, name: str) -> tuple[bytes, bytes]:
    zmq.auth.create_certificates(folder, name)
    (folder / f"{name}.key_secret").chmod(0o600)
    public, secret = zmq.auth.load_certificate(folder / f"{name}.key_secret")
    assert secret is not None
    return public, secret


def test_few_descriptors_are_kept_for_clients(open_process: OpenSession, monkeypatch: pytest.MonkeyPatch) -> None:
    """As many connections that say nothing as the system gives descriptors: most are closed, and a client joins."""
    run_altered(monkeypatch, FEW_DESCRIPTORS)
    session = open_process(limits=FrontLimits(hello_timeout_ns=LONG_NS))  # they are closed for being too many alone
    silent = [socket.create_connection((session.host, session.ports.state)) for _ in range(DESCRIPTORS)]
    session.wait_drops("strangers_too_many")
    session.client().join()
    front = psutil.Process(session.process.pid)
    session.pump(lambda: front.num_fds() < DESCRIPTORS - RESERVED_DESCRIPTORS, "descriptors that are free")
    for one in silent:
        one.close()
