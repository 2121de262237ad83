"""Processes of `tools/hostile.py`: honest clients that measure, and attacks by one key.

    python tools/hostile_worker.py honest < job.json     reports once a second, one JSON line, until SIGTERM
    python tools/hostile_worker.py KIND < job.json       says `attacking`, attacks for `seconds`, prints what it counted

An attack holds listed keys and stays within what a client can send: it is no attack on the network. Its process has the
lowest priority and a bounded speed, so that the session is tested and not the processor.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import random
import signal
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Final

import msgspec
import zmq

from iris_session.client import Client, wait_any
from iris_session.client.core.state_stream import SceneState
from iris_session.client.sockets import CurveKeys
from iris_session.protocol.client_messages import (
    Acquire,
    Bye,
    ClientMessage,
    EStop,
    GetSnapshot,
    Heartbeat,
    Hello,
    Marker,
    Observation,
    Release,
    Sample,
    wrap_message,
)
from iris_session.protocol.codec import decode_server, encode_client, encode_media_frames
from iris_session.protocol.common import IDENTITY, Pose
from iris_session.protocol.server_messages import Refused, Reply, Welcome
from iris_session.protocol.status import GetStatus
from iris_session.security import KeyPair

MIB: Final = 1 << 20
SAMPLE_S: Final = 1.0 / 72.0
REPORT_S: Final = 1.0
#: A key that floods is refused for 3 s.
AFTER_BAN_S: Final = 3.5
Context = zmq.Context[zmq.Socket[bytes]]


class Key(msgspec.Struct, frozen=True):
    """A listed key. `public`, `secret`: Z85."""

    public: str
    secret: str

    @classmethod
    def generate(cls) -> Key:
        pair = KeyPair.generate()
        return cls(pair.public, pair.secret)


class Job(msgspec.Struct, frozen=True):
    """The work of one process.

    Attributes:
        host, control, state, media, ingest: Where the session listens; `control` alone for honest clients.
        server: Public key of the session.
        keys: By name of the client, or of the attacker.
        addresses: Address of each honest client, where it is not `host`.
        seconds: Length of an attack.
        robots, objects: Targets of an attack.
        allow_list: File of the allow-list.
        cpu_share: Cores that the attack "busy" uses.
    """

    host: str
    control: int
    server: str
    keys: dict[str, Key]
    state: int = 0
    media: int = 0
    ingest: int = 0
    addresses: dict[str, str] = {}
    seconds: float = 0.0
    robots: tuple[str, ...] = ()
    objects: tuple[str, ...] = ()
    allow_list: str = ""
    cpu_share: float = 0.0


# --- honest clients ---------------------------------------------------------------------------------------------------


class Honest:
    """One honest client: it sends its head and a hand, and measures the age of every state."""

    def __init__(self, job: Job, name: str) -> None:
        key = job.keys[name]
        self.name = name
        self.ages_ms: list[float] = []
        self.pause_ms = 0.0  # longest session time between two states
        self.events = 0
        self._session_time = -1
        self._next_s = 0.0
        self.client = Client(
            f"{job.addresses.get(name, job.host)}:{job.control}",
            name=name,
            devices=("head", "controller/right"),
            alignment="not_needed",
            curve=CurveKeys(job.server.encode(), key.public.encode(), key.secret.encode()),
            on_state=self._record,
            on_event=lambda _event: setattr(self, "events", self.events + 1),
        )
        self.client.open()

    def _record(self, state: SceneState) -> None:
        if state.header.session_time != self._session_time:  # else sent again: its age says nothing
            if self._session_time >= 0:
                self.pause_ms = max(self.pause_ms, (state.header.session_time - self._session_time) * 1e-6)
            self._session_time = state.header.session_time
            self.ages_ms.append(state.age_ns * 1e-6)

    def step(self) -> None:
        """Poll, and send samples when they are due."""
        self.client.poll(0.0)
        now_s = time.monotonic()
        if self.client.ready and now_s >= self._next_s:
            self._next_s = now_s + SAMPLE_S
            for device in ("head", "controller/right"):
                self.client.send_sample(device, ((0.0, 0.0, 1.5), (1.0, 0.0, 0.0, 0.0)))

    def report(self) -> dict[str, Any]:
        """Return what was seen since the last report."""
        ages, self.ages_ms = self.ages_ms, []
        pause_ms, self.pause_ms = self.pause_ms, 0.0
        events, self.events = self.events, 0
        return {
            "ready": self.client.ready,
            "generation": self.client.connection.generation,
            "ages_ms": ages,
            "pause_ms": pause_ms,
            "events": events,
        }


def run_honest(job: Job) -> None:
    """Run the honest clients until SIGTERM."""
    stopped: list[int] = []
    signal.signal(signal.SIGTERM, lambda number, _frame: stopped.append(number))
    honest = [Honest(job, name) for name in job.keys]
    next_s = time.monotonic() + REPORT_S
    while not stopped:
        wait_any([one.client for one in honest], 0.004)
        for one in honest:
            one.step()
        if time.monotonic() >= next_s:
            next_s += REPORT_S
            print(json.dumps({one.name: one.report() for one in honest}), flush=True)
    for one in honest:
        one.client.close()


# --- attacks ----------------------------------------------------------------------------------------------------------


class Attacker:
    """Sockets of one attack, and what it counted."""

    def __init__(self, job: Job) -> None:
        self.job = job
        self.context: Context = zmq.Context()
        self.counts = {"sent": 0, "welcomed": 0, "refused": 0, "denied": 0}
        self.random = random.Random(1)
        self._end_s = 0.0

    def start(self) -> None:
        """Say that the attack begins."""
        self._end_s = time.monotonic() + self.job.seconds
        print("attacking", flush=True)

    @property
    def lasts(self) -> bool:
        return time.monotonic() < self._end_s

    def paced(self, per_s: float) -> Iterator[int]:
        """Yield numbers at a rate until the end of the attack."""
        began, n = time.monotonic(), 0
        while self.lasts:
            if n < (time.monotonic() - began) * per_s:
                yield n
                n += 1
            else:
                time.sleep(0.0005)

    def open(self, kind: int, port: int, name: str = "") -> zmq.Socket[bytes]:
        """Open a socket with a key."""
        opened = self.context.socket(kind)
        opened.linger = 0
        key = self.job.keys[name] if name else next(iter(self.job.keys.values()))
        opened.curve_serverkey = self.job.server.encode()
        opened.curve_publickey, opened.curve_secretkey = key.public.encode(), key.secret.encode()
        opened.connect(f"tcp://{self.job.host}:{port}")
        return opened


class Raw:
    """A control connection without any logic."""

    def __init__(self, attacker: Attacker, name: str = "") -> None:
        self.attacker = attacker
        self.socket = attacker.open(zmq.DEALER, attacker.job.control, name)
        self.epoch = 0
        self.clock_offset_ns = 0  # session time less this clock, to a round trip

    def send(self, message: ClientMessage) -> None:
        """Send a message; one for which there is no room is lost."""
        with contextlib.suppress(zmq.Again):
            self.socket.send(encode_client(wrap_message(message, self.epoch)), zmq.DONTWAIT)
            self.attacker.counts["sent"] += 1

    def receive(self) -> None:
        """Read what came."""
        counts = self.attacker.counts
        while self.socket.poll(0):
            message = decode_server(self.socket.recv_multipart()[0]).message
            if isinstance(message, Welcome):
                self.epoch = message.connection_epoch
                self.clock_offset_ns = message.session_time - time.monotonic_ns()
                counts["welcomed"] += 1
            elif isinstance(message, Refused):
                counts["refused"] += 1
            elif isinstance(message, Reply) and not message.ok:
                counts["denied"] += 1

    def join(self, role: str = "observer", timeout_s: float = 5.0, alignment: str = "not_needed") -> bool:
        """Say hello; return whether the session welcomes us."""
        self.send(Hello(role, "mallory", alignment=alignment))
        deadline = time.monotonic() + timeout_s
        refused = self.attacker.counts["refused"]
        while not self.epoch and time.monotonic() < deadline and self.attacker.counts["refused"] == refused:
            self.socket.poll(20)
            self.receive()
        return bool(self.epoch)


def join_some(attacker: Attacker, n: int, role: str = "observer", alignment: str = "not_needed") -> list[Raw]:
    """Join with up to `n` connections of one key."""
    joined = []
    for _ in range(n):
        raw = Raw(attacker)
        if raw.join(role, alignment=alignment):
            joined.append(raw)
    return joined


def attack_connections(attacker: Attacker) -> None:
    """Open forty connections to control and to state with one key, and open those that were refused again."""
    attacker.start()
    raws = [Raw(attacker) for _ in range(40)]
    subscribers = [attacker.open(zmq.SUB, attacker.job.state) for _ in range(40)]
    for one in subscribers:
        one.subscribe(b"")
    for n in attacker.paced(40.0):
        raw = raws[n % len(raws)]
        raw.receive()
        raw.send(Heartbeat() if raw.epoch else Hello("observer", "mallory", alignment="not_needed"))
        for one in subscribers:
            while one.poll(0):
                one.recv_multipart()


def attack_messages(attacker: Attacker) -> None:
    """Send samples, snapshots, status questions and markers by eight connections, each within its own limits."""
    raws = join_some(attacker, 8)
    attacker.start()
    sample = Sample("head", "pose", 1, 0, 1, 0, 0, pose=IDENTITY, hand_joints=tuple(0.1 for _ in range(182)))
    for n in attacker.paced(8 * 640.0):
        raw = raws[n % len(raws)]
        raw.send(msgspec.structs.replace(sample, seq=n, worn=n // 8 % 2 == 0))
        if n % 512 < 8:
            raw.send(GetSnapshot(n + 1))
            raw.send(GetStatus(n + 1))
        if n % 256 < 8:
            raw.send(Marker(n + 1, "x" * 400))
        raw.receive()


def attack_leases(attacker: Attacker) -> None:
    """Acquire and release forty targets, twenty times a second by each of four connections."""
    raws = join_some(attacker, 4, "operator")
    attacker.start()
    job = attacker.job
    for n in attacker.paced(4 * 20.0):
        raw = raws[n % len(raws)]
        raw.send(Acquire(2 * n + 1, job.robots, job.objects))
        raw.send(Release(2 * n + 2))
        raw.receive()


def attack_joins(attacker: Attacker) -> None:
    """Join and leave again, as fast as answers come."""
    attacker.start()
    for _ in attacker.paced(50.0):
        raw = Raw(attacker)
        if raw.join(timeout_s=0.5):
            raw.send(Bye("again"))
        raw.socket.close(linger=50)


def attack_estops(attacker: Attacker) -> None:
    """Send e-stops as fast as the socket takes them, and again after being disconnected."""
    raw = Raw(attacker)
    raw.join()
    attacker.start()
    data = encode_client(wrap_message(EStop("flood"), raw.epoch))
    for n in attacker.paced(50_000.0):
        try:
            raw.socket.send(data, zmq.DONTWAIT)
            attacker.counts["sent"] += 1
        except zmq.Again:
            time.sleep(0.001)
        if n % 2000 == 0:
            raw.receive()
            raw.send(Hello("observer", "mallory", alignment="not_needed"))


def attack_nothing(attacker: Attacker) -> None:
    """Use the cores of `cpu_share` and send nothing: what an attacker costs by being on the same machine."""
    attacker.start()
    for _ in attacker.paced(100.0):
        until_s = time.thread_time() + 0.01 * attacker.job.cpu_share
        while time.thread_time() < until_s:
            pass


def attack_topics(attacker: Attacker) -> None:
    """Subscribe to random topics of the state socket, by forty connections, and by as many new ones after each ban."""
    attacker.start()
    subs: list[zmq.Socket[bytes]] = []
    again_s = 0.0
    for n in attacker.paced(20_000.0):
        if time.monotonic() >= again_s:
            again_s = time.monotonic() + AFTER_BAN_S
            for sub in subs:
                sub.close()
            subs = [attacker.open(zmq.XSUB, attacker.job.state) for _ in range(40)]
        with contextlib.suppress(zmq.Again):
            subs[n % len(subs)].send(b"\x01" + attacker.random.randbytes(900), zmq.DONTWAIT)
            attacker.counts["sent"] += 1


def attack_ingest_role(attacker: Attacker) -> None:
    """Hand in media with a key that is no camera's."""
    attacker.start()
    push = attacker.open(zmq.PUSH, attacker.job.ingest)
    frames = encode_media_frames("cloud", bytes(MIB), 0, 1, "bytes")
    for _ in attacker.paced(50.0):
        with contextlib.suppress(zmq.Again):
            push.send_multipart(frames, zmq.DONTWAIT)
            attacker.counts["sent"] += 1


class Relay:
    """Forward one TCP connection, up to so many bytes: what comes after them never arrives."""

    def __init__(self, host: str, port: int, max_bytes: int) -> None:
        self._target, self._max_bytes = (host, port), max_bytes
        self._server = socket.create_server((host, 0))
        self.port = int(self._server.getsockname()[1])
        self.n_bytes = 0
        self.closed = False
        threading.Thread(target=self._run, daemon=True).start()

    def _run(self) -> None:
        theirs, _ = self._server.accept()
        with theirs, socket.create_connection(self._target) as front:
            threading.Thread(target=self._copy_back, args=(front, theirs), daemon=True).start()
            with contextlib.suppress(OSError):
                while self.n_bytes < self._max_bytes and (data := theirs.recv(65536)):
                    front.sendall(data)
                    self.n_bytes += len(data)
                while not self.closed:
                    time.sleep(0.05)
        self.closed = True

    def _copy_back(self, front: socket.socket, theirs: socket.socket) -> None:
        with contextlib.suppress(OSError):
            while data := front.recv(65536):
                theirs.sendall(data)
        self.closed = True


def attack_unfinished(attacker: Attacker) -> None:
    """Hold unfinished messages in the front: six connections of cameras' keys, each within the bound of one."""
    job = attacker.job
    attacker.start()
    names = list(job.keys)
    relays: list[tuple[Relay, zmq.Socket[bytes]]] = []
    for n in attacker.paced(20.0):
        alive = [one for one in relays if not one[0].closed]
        for _, push in [one for one in relays if one[0].closed]:
            push.close()
        relays = alive
        if len(relays) < 6:
            relay = Relay(job.host, job.ingest, 50 * MIB)
            push = attacker.context.socket(zmq.PUSH)
            push.linger = 0
            key = job.keys[names[n % len(names)]]
            push.curve_serverkey, push.reconnect_ivl = job.server.encode(), -1
            push.curve_publickey, push.curve_secretkey = key.public.encode(), key.secret.encode()
            push.connect(f"tcp://{job.host}:{relay.port}")
            with contextlib.suppress(zmq.Again):
                push.send_multipart([bytes(MIB)] * 60, zmq.DONTWAIT, copy=False)
                attacker.counts["sent"] += 1
            relays.append((relay, push))
    attacker.counts["held_mib"] = sum(relay.n_bytes for relay, _ in relays) // MIB


def attack_observations(attacker: Attacker) -> None:
    """Observe the sheet from ever new viewpoints, by six connections: each estimate takes milliseconds."""
    raws = join_some(attacker, 6, alignment="measured")
    attacker.start()
    for n in attacker.paced(6 * 30.0):
        raw, shot = raws[n % len(raws)], n // len(raws)
        x, y, z = (attacker.random.gauss(0.0, 0.002) for _ in range(3))
        viewpoint, now_ns = shot // 5, time.monotonic_ns() + raw.clock_offset_ns
        angle = 0.7 * viewpoint
        head = Pose((0.8 * math.cos(angle), 0.8 * math.sin(angle) - 0.45, 0.6), (1.0, 0.0, 0.0, 0.0))
        raw.send(Sample("head", "pose", shot + 1, now_ns, 1, 0, 0, pose=head))
        sheet = Pose((x, y - 0.45, z), (1.0, 0.0, 0.0, 0.0))
        raw.send(Observation("table", "qr", sheet, now_ns, 0, viewpoint, 0.16))
        raw.receive()


def attack_descriptors(attacker: Attacker) -> None:
    """Open plain TCP connections to every port, as fast as they are taken, and keep them open."""
    job = attacker.job
    attacker.start()
    opened: list[socket.socket] = []
    for n in attacker.paced(400.0):
        port = (job.control, job.state, job.media, job.ingest)[n % 4]
        with contextlib.suppress(OSError):
            opened.append(socket.create_connection((job.host, port), 0.5))
            attacker.counts["sent"] += 1
        if len(opened) >= 900:
            for one in opened[:300]:
                one.close()
            del opened[:300]


def attack_allow_list(attacker: Attacker) -> None:
    """Rename the allow-list away for a second, again and again, as an editor or a network disk does."""
    path = Path(attacker.job.allow_list)
    attacker.start()
    for _ in attacker.paced(0.5):
        away = path.with_suffix(".away")
        path.rename(away)
        time.sleep(1.0)
        away.rename(path)
        attacker.counts["sent"] += 1


ATTACKS: Final[dict[str, Callable[[Attacker], None]]] = {
    "connections": attack_connections,
    "messages": attack_messages,
    "leases": attack_leases,
    "joins": attack_joins,
    "estops": attack_estops,
    "busy": attack_nothing,
    "topics": attack_topics,
    "ingest_role": attack_ingest_role,
    "unfinished": attack_unfinished,
    "observations": attack_observations,
    "descriptors": attack_descriptors,
    "allow_list": attack_allow_list,
}


def main() -> int:
    job = msgspec.json.decode(sys.stdin.buffer.read(), type=Job)
    if sys.argv[1] == "honest":
        run_honest(job)
        return 0
    os.nice(19)
    attacker = Attacker(job)
    ATTACKS[sys.argv[1]](attacker)
    print(json.dumps(attacker.counts), flush=True)
    os._exit(0)  # sockets of an attack may have much to send


if __name__ == "__main__":
    sys.exit(main())
