"""The client: the thin shell of `Connection` with sockets and a clock, put together of its parts.

It has no thread of its own: `poll` drives everything, and every waiting call polls. `start` is for those who want a
thread: from then on only that thread touches the sockets, and callbacks run in it.
"""

from __future__ import annotations

import os
import secrets
import threading
from collections.abc import Callable, Sequence
from typing import Self

from iris_session.client.arguments import encode_checked, to_names
from iris_session.client.core.connection import ClientConnection
from iris_session.client.core.state_stream import SceneState
from iris_session.client.core.status import ConnectionPhase
from iris_session.client.driving import DEFAULT_TIMEOUT_S, Driving
from iris_session.client.errors import NotConnectedError
from iris_session.client.identity import Identity
from iris_session.client.joining import parse_connect_request
from iris_session.client.reporting import ArrivalMeter, Reporting
from iris_session.client.requests import Requests
from iris_session.client.sampling import Sampling
from iris_session.client.sheet_observer import Looking
from iris_session.client.sockets import ClientSockets, CurveKeys
from iris_session.protocol.client_messages import ClientMessage, EStop, Hello
from iris_session.protocol.common import Denial
from iris_session.protocol.names import AlignmentKind, Role
from iris_session.protocol.server_messages import Event, Feedback

#: Roles that have no headset, so nothing to align.
UNALIGNED_ROLES = frozenset({Role.AGENT, Role.LEADER, Role.GATEWAY, Role.RECORDER, Role.CAMERA, Role.SOURCE})


class Client(Driving, Requests, Looking, Sampling, Reporting):
    """A participant of a session.

    `address`: `HOST:PORT` of the control channel, or the `iris://` URI of a pairing code; `session`: name of a session
    to find on the network instead. Neither: the session on this machine. `join_code`: from `iris-session pair`, for
    the first time at an encrypted session. `devices`: tracked sources of input that samples will name.
    `alignment`: `measured` or `not_needed` (default: by role). `identity`: an `Identity`, a file that keeps one across
    restarts, or `None` for this process only. `curve`: keys of your own instead of those in the home of keys.
    `on_state(state)`, `on_event(event)`, `on_feedback(feedback)`: called from `poll` (or the thread of `start`).
    `on_missed(first, last)`: between two events, numbers of those that this client lost (its link took nothing for a
    while, or was another one); what came of them is known. `on_denial(denial)`: of a message that waits for no answer.

        with Client("127.0.0.1:7721", role="agent", name="policy", devices=("target",)) as client:
            client.acquire(["left"])
            client.wait_for(lambda c: c.tip_pose("left") is not None)
            target = client.tip_pose("left")  # T_world_tip: move it
            for i in range(90):  # the clutch must be seen open once; after 150 ms without a sample the robot holds
                client.send_sample("target", target, robots=["left"], clutch=i > 0)
                client.sleep(1 / 60)
    """

    def __init__(
        self,
        address: str = "",
        *,
        session: str = "",
        role: str = Role.OPERATOR,
        name: str = "",
        devices: str | Sequence[str] = (),
        capabilities: Sequence[str] = (),
        alignment: str | None = None,
        identity: Identity | str | os.PathLike[str] | None = None,
        curve: CurveKeys | None = None,
        join_code: str = "",
        software: str = "iris-session",
        on_state: Callable[[SceneState], None] | None = None,
        on_event: Callable[[Event], None] | None = None,
        on_missed: Callable[[int, int], None] | None = None,
        on_feedback: Callable[[Feedback], None] | None = None,
        on_denial: Callable[[Denial], None] | None = None,
    ) -> None:
        self._wanted = parse_connect_request(address, session, curve, join_code)
        #: `HOST:PORT`, as soon as it is known.
        self.address = str(self._wanted.address or f"session {session!r}")
        if alignment is None:
            alignment = AlignmentKind.NOT_NEEDED if role in UNALIGNED_ROLES else AlignmentKind.MEASURED
        if identity is None:
            identity = Identity.in_memory()
        elif not isinstance(identity, Identity):
            identity = Identity.from_file(os.fspath(identity))
        hello = Hello(
            role=role,
            name=name or role,
            software=software,
            devices=to_names("devices", devices),
            # The session keeps our alignment over a lost connection only while this `run` lasts.
            capabilities=(*capabilities, f"run:{secrets.token_hex(8)}"),
            alignment=alignment,
        )
        encode_checked(hello)
        self.connection = ClientConnection(hello, identity)
        self.on_state = on_state
        self.on_event = on_event
        self.on_missed = on_missed
        self.on_feedback = on_feedback
        self.on_denial = on_denial
        self.feedback: dict[str, Feedback] = {}
        self._state: SceneState | None = None
        self._session_id = ""
        self._seq = {}
        self._arrivals = ArrivalMeter()
        self._generation = 0
        self._sockets = ClientSockets()
        self._init_media()
        self._init_assets()
        self._init_looking()
        self._lock = threading.RLock()
        self._changed = threading.Condition(self._lock)
        self._thread: threading.Thread | None = None
        self._stopping = False
        self._crash: BaseException | None = None

    # --- life ---------------------------------------------------------------------------------------------------------

    def connect(self, timeout_s: float = DEFAULT_TIMEOUT_S) -> Self:
        """Joins the session and waits for snapshot and clock.

        Raises `RefusedError` (or `VersionError`) when the session says no, `TrustError` when its key is not the one
        that is trusted, `NotConnectedError` when nobody answers.
        """
        self.open()
        if not self.wait_for(lambda client: client.ready, timeout_s):
            raise NotConnectedError(f"no session let us in at {self.why_not_in(f'within {timeout_s:g} s')}")
        return self

    def open(self) -> None:
        """Begins to join, without waiting: `poll` goes on with it until `ready`."""
        with self._lock:
            if self.connection.phase is ConnectionPhase.CLOSED:
                raise NotConnectedError(self.connection.describe())
            if self.connection.phase in (ConnectionPhase.IDLE, ConnectionPhase.REFUSED) and self._meeting is None:
                self._begin_meeting()
                self._step_meeting()

    def close(self) -> None:
        """Leaves at once: leases are released without grace. Stops the thread of `start`."""
        with self._lock:
            self._stopping = True
            thread = self._thread
        if thread is not None and thread is not threading.current_thread():
            self._sockets.wake()
            thread.join()
        workers = None
        with self._lock:
            if self.connection.phase is not ConnectionPhase.CLOSED:
                self._end_meeting()
                workers = self._end_assets()
                self.connection.close()
                self._flush()
                self._sockets.close()
            self._changed.notify_all()
        if workers is not None:
            workers.close()

    def __enter__(self) -> Self:
        if self.ready:
            return self
        try:
            return self.connect()
        except BaseException:
            self.close()
            raise

    def __exit__(self, *_: object) -> None:
        self.close()

    def start(self) -> Self:
        """Starts the only thread there is: it polls until `close`. `poll` must not be called from then on."""
        with self._lock:
            if self._thread is None:
                self._thread = threading.Thread(target=self._run, name=f"iris-client-{self.name}", daemon=True)
                self._thread.start()
        return self

    # --- what it is ---------------------------------------------------------------------------------------------------

    @property
    def ready(self) -> bool:
        """Joined, with snapshot and clock. False while reconnecting, and after the thread of `start` ended."""
        return self.connection.phase is ConnectionPhase.READY and self._crash is None

    @property
    def name(self) -> str:
        return self.connection.hello.name

    @property
    def worn(self) -> bool:
        """Whether somebody wears the headset. Set it; heartbeats and samples tell it."""
        return self.connection.worn

    @worn.setter
    def worn(self, worn: bool) -> None:
        self.connection.worn = worn

    @property
    def tracking_epoch(self) -> int:
        """Jumps of our tracking frame so far; `new_tracking_frame` counts one more."""
        return self.connection.tracking_epoch

    # --- sending ------------------------------------------------------------------------------------------------------

    def send(self, message: ClientMessage) -> bool:
        """Sends any message. Samples without a connection are dropped and counted (false); others then raise."""
        with self._lock:
            if not isinstance(message, EStop):  # that one leaves as long as there is a socket
                self._check_thread()
            queued = self.connection.send(message)
            self._send_soon()
            self._check_thread()
            return queued
