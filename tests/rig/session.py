"""`Rig`: one session, its front and its participants, in simulated time; and `Hand`, which drives a robot in it."""

from __future__ import annotations

import contextlib
import io
import socket
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final, Self, TypeVar

import mujoco
import pytest

from anchors.pose import PoseTuple, distance
from iris_session.cli import control as _control  # noqa: F401  (commands import their modules late: simulated too)
from iris_session.cli import status as _status  # noqa: F401
from iris_session.cli.main import main
from iris_session.client import Client, ClientError, endpoint_resolver
from iris_session.client import client as client_module
from iris_session.client.core.status import ConnectionPhase
from iris_session.demo.scenes import scene_path
from iris_session.emulator.operator import EmulatedOperator
from iris_session.emulator.specs import HeadsetSpec
from iris_session.physics import Pacer
from iris_session.protocol.server_messages import Event
from iris_session.session import processes
from iris_session.session.config import SessionConfig
from iris_session.session.session import PAUSED_STEP_S, Session
from tests.rig.front import RigFrontProcess, install_front
from tests.rig.journal import Journal
from tests.rig.network import Link, Network, RigClientSockets, refuse_introduction
from tests.rig.simulation import SECOND, Simulation, simulate_modules

ADDRESS: Final = "127.0.0.1:7721"
DEVICES: Final = ("desktop", "head", "joints", "target")
SAMPLE_NS: Final = SECOND // 72
T = TypeVar("T")


class Hand:
    """The hand of an operator at a screen, or a policy's: 72 samples a second of one device that drives `robot`.

    Attributes:
        pose: In the tracking frame, which is the world for clients that need no alignment.
        velocity: Of the hand [m/s].
        clutch: Sent with every sample.
        sending: Whether samples are sent.
    """

    def __init__(self, rig: Rig, client: Client, robot: str, device: str = "desktop") -> None:
        self.client = client
        self.robot = robot
        self.device = device
        self.pose: PoseTuple = ((0.0, 0.0, 1.0), (1.0, 0.0, 0.0, 0.0))
        self.velocity = (0.0, 0.0, 0.0)
        self.clutch = False
        self.sending = True
        self.gripper: float | None = None
        self._rig = rig
        self._send()

    def _send(self) -> None:
        if self.client.connection.phase is ConnectionPhase.CLOSED:
            return
        self._rig.simulation.call_at(self._rig.simulation.now_ns + SAMPLE_NS, self._send)
        if self.sending and self.client.ready and not self._rig.is_hanging(self.client):
            (x, y, z), q = self.pose
            vx, vy, vz = (v * SAMPLE_NS / SECOND for v in self.velocity)
            tremble = 1e-12 if self.device.startswith(("controller", "hand")) else 0.0
            self.pose = ((x + vx, y + vy, z + vz + tremble), q)
            more = {} if self.gripper is None else {"gripper": self.gripper}
            self.client.send_sample(self.device, self.pose, robots=[self.robot], clutch=self.clutch, **more)

    @property
    def tip(self) -> PoseTuple:
        """`T_world_tip` of the robot as this client sees it now."""
        return see_tip(self.client, self.robot)

    @property
    def is_following(self) -> bool:
        """True if samples of this participant were applied to its robot within the last 100 ms of the state."""
        return is_driven(self.client, self.robot, self.client.participant_id)


class Rig:
    """A session in simulated time.

        with Rig() as rig:
            hand = rig.drive("ann", "left", velocity=(0.0, 0.05, 0.0))
            rig.run(2.0)

    At the end the journal is verified: every step is taken again, and must give the same digest.

    Args:
        scene: Name of a demo scene, or the path or the specification of a model.
        seed: Of everything that is random.
        profile: Links of participants, as of `netsim.profiles`.
        timestep: Of the model [s]; `None` for its own. Larger ones take less processor time.
        user_loop: A program of the user steps the model, by `begin_tick` and `end_tick`.
        config: Further fields of `SessionConfig`.

    Attributes:
        session: The session.
        clients, operators: That have joined, also those that have left.
        events: Received by client name.
        failures: Why clients were refused, by client name.
        policy: In a user loop, writes the program's own `ctrl` before every tick.
    """

    def __init__(
        self,
        scene: str | Path | mujoco.MjSpec = "handover",
        *,
        seed: int = 1,
        profile: str = "lan",
        timestep: float | None = None,
        user_loop: bool = False,
        **config: Any,
    ) -> None:
        self.simulation = Simulation(seed)
        self.profile = profile
        self.clients: list[Client] = []
        self.operators: list[EmulatedOperator] = []
        self.hands: list[Hand] = []
        self.events: dict[str, list[Event]] = {}
        self.failures: dict[str, ClientError] = {}
        self.policy: Callable[[mujoco.MjData], None] = lambda data: None
        self.journal: Journal
        self._scene = scene
        self._timestep = timestep
        self._user_loop = user_loop
        self._config = config
        self._patch = pytest.MonkeyPatch()
        self._links = 0
        self._stands_until_ns = 0
        self._hanging: dict[Client, int] = {}  # until when
        self._network = Network(self.simulation)

    def __enter__(self) -> Self:
        patch, simulation = self._patch, self.simulation
        simulate_modules(simulation, patch)
        install_front(self._network, patch)
        patch.setattr(processes, "FrontProcess", self._make_front)
        patch.setattr(client_module, "ClientSockets", self._make_sockets)
        patch.setattr(endpoint_resolver, "request_introduction", refuse_introduction)
        patch.setattr(socket, "create_connection", self._network.try_port)
        try:
            self.session = self._make_session()
            self.session.start()
            self._begin()
        except BaseException:
            patch.undo()
            raise
        return self

    def __exit__(self, kind: object, *_: object) -> None:
        try:
            for client in self.clients:
                client.close()
            self.run(0.1)
            self.session.close()
            if kind is None:
                self.journal.verify()
        finally:
            self._patch.undo()

    # --- the session ------------------------------------------------------------------------------------------------

    def _make_session(self) -> Session:
        scene = scene_path(self._scene) if isinstance(self._scene, str) else self._scene
        spec = scene if isinstance(scene, mujoco.MjSpec) else mujoco.MjSpec.from_file(str(scene))
        model = spec.compile()
        if self._timestep is not None:
            model.opt.timestep = self._timestep
        data = mujoco.MjData(model)
        if model.nkey:
            mujoco.mj_resetDataKeyframe(model, data, 0)
        settings: dict[str, Any] = {"record": False, "web": False, "beacon_port": 0, "assets": False}
        config = SessionConfig(realtime=False, **{**settings, **self._config})
        return Session(model, data, config)

    def _begin(self) -> None:
        session = self.session
        stepper = session._make_stepper(user_owned=self._user_loop)
        core = stepper.core
        self.journal = stepper.recorder = Journal(core.config, core.world.encode_model())
        self.simulation.call_at(self.simulation.now_ns, self._tick_user if self._user_loop else self._tick)
        self._period_ns = core.world.tick_period_ns
        if not self._user_loop:
            self._pacer = session._pacer = Pacer(self._period_ns, session.clock())
            self._times = session._measure_ticks(stepper, self._pacer)

    def _tick(self) -> None:
        """Take the step that is due, as `Session.run` does."""
        session, simulation = self.session, self.simulation
        if session.stopping:
            return
        if simulation.now_ns >= self._stands_until_ns:
            session._take_step(session.stepper, self._pacer, self._times)
        paused_ns = simulation.now_ns + round(PAUSED_STEP_S * SECOND)
        due_ns = paused_ns if session.stepper.paused else session.origin_ns + self._pacer.next_deadline_ns
        simulation.call_at(max(due_ns, self._stands_until_ns), self._tick)

    def _tick_user(self) -> None:
        """One round of the user's program."""
        session, simulation = self.session, self.simulation
        if session.stopping:
            return
        if simulation.now_ns >= self._stands_until_ns:
            assert session.data is not None
            self.policy(session.data)
            session.begin_tick()
            mujoco.mj_step(session.model, session.data)
            session.end_tick()
        simulation.call_at(max(simulation.now_ns + self._period_ns, self._stands_until_ns), self._tick_user)

    def stop_loop(self, seconds: float) -> None:
        """Let the loop that takes ticks stand still: the machine pauses, or the user's program plots."""
        self._stands_until_ns = self.simulation.now_ns + round(seconds * SECOND)

    def suspend_machine(self, seconds: float) -> None:
        """Let the session and its front stand still, as when their machine sleeps."""
        self.stop_loop(seconds)
        self._front.stands_until_ns = self._stands_until_ns

    def kill_front(self) -> None:
        """End the front at once, as SIGKILL does. The session replaces it."""
        self._front.kill()

    @property
    def _front(self) -> RigFrontProcess:
        front = self.session.processes.front
        assert isinstance(front, RigFrontProcess)
        return front

    def _make_front(self, config: Any, scene: Any) -> RigFrontProcess:
        return RigFrontProcess(config, scene, self.simulation)

    def _make_sockets(self) -> RigClientSockets:
        self._links += 1
        return RigClientSockets(self._network, self.profile, 1000 * self.simulation.seed + self._links)

    # --- time -------------------------------------------------------------------------------------------------------

    def run(self, seconds: float) -> None:
        """Let the session go on for a time [s]."""
        self.simulation.run(self.simulation.now_ns + round(seconds * SECOND))

    def run_until(self, condition: Callable[[], object], what: str = "condition", seconds: float = 30.0) -> None:
        """Let the session go on until a condition holds, which is an error after `seconds`."""
        if not condition() and not self.simulation.run(self.simulation.now_ns + round(seconds * SECOND), condition):
            pytest.fail(f"not within {seconds:g} s of the session: {what}")

    @property
    def now_s(self) -> float:
        """Session time [s]."""
        return self.session.clock() / SECOND

    # --- participants -----------------------------------------------------------------------------------------------

    def join(self, name: str, role: str = "operator", *, profile: str | None = None, **options: Any) -> Client:
        """Join a client, by default one that needs no alignment (desktop, policy), and wait until it is ready."""
        client = self.open(name, role, profile=profile, **options)
        self.run_until(lambda: client.ready or name in self.failures, f"{name} has joined")
        if name in self.failures:
            raise self.failures[name]
        return client

    def open(self, name: str, role: str = "operator", *, profile: str | None = None, **options: Any) -> Client:
        """Let a client begin to join, on a link of `profile`; the rig polls it from then on."""
        usual, self.profile = self.profile, profile or self.profile
        log = self.events.setdefault(name, [])
        options = {"devices": DEVICES, "alignment": "not_needed", "on_event": log.append, **options}
        client = Client(ADDRESS, role=role, name=name, **options)
        self.profile = usual
        self.clients.append(client)
        client.open()
        _Poller(self, client)
        return client

    def run_command(self, *arguments: str) -> tuple[int, str, str]:
        """Run an `iris-session` command beside the session. Return its exit status, output and errors."""
        out, errors = io.StringIO(), io.StringIO()
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(errors):
            status = main(list(arguments))
        return status, out.getvalue(), errors.getvalue()

    def connect_raw(self, host: str = "203.0.113.1") -> RigClientSockets:
        """Open a control connection from an address, without a client behind it: send any bytes by `send_control`."""
        sockets = self._make_sockets()
        sockets.host_address = host
        sockets.open_control()
        return sockets

    def link_of(self, client: Client) -> Link:
        """Return the link of a client, to stall it."""
        return _sockets_of(client).link

    def cut(self, client: Client) -> None:
        """Break the TCP connection of a client; both ends notice. It joins again by itself."""
        connection = _sockets_of(client).connection
        assert connection is not None
        self._network.close(connection)

    def roam(self, client: Client, host: str) -> None:
        """Give a client another address. Its connections end, which the session does not learn."""
        sockets = _sockets_of(client)
        assert sockets.connection is not None
        sockets.host_address = host
        self._network.abandon(sockets.connection)

    def hang(self, client: Client, seconds: float) -> None:
        """Let the program of a client do nothing for a while: it neither reads nor sends. Its connection stays."""
        self._hanging[client] = self.simulation.now_ns + round(seconds * SECOND)

    def is_hanging(self, client: Client) -> bool:
        """Return whether the program of a client stands still now."""
        return self.simulation.now_ns < self._hanging.get(client, 0)

    def kill(self, client: Client) -> None:
        """End the program of a client, as SIGKILL does: no bye, its TCP connection closes."""
        connection = _sockets_of(client).connection
        client.connection.phase = ConnectionPhase.CLOSED
        if connection is not None:
            self._network.close(connection, notify=False)

    def emulate(self, **spec: Any) -> EmulatedOperator:
        """Add an emulated headset with the fields of `HeadsetSpec`; its tracking and link noise are those of it."""
        self.events.setdefault(spec["name"], [])
        operator = EmulatedOperator(ADDRESS, HeadsetSpec(**spec), self.simulation.now_ns)
        self.operators.append(operator)
        self.clients.append(operator.client)
        _Poller(self, operator.client, operator)
        return operator

    def add_hand(self, client: Client, robot: str, device: str = "desktop") -> Hand:
        """Give a client a hand for a robot."""
        self.run_until(lambda: client.scene.tip_pose(robot) is not None, f"{client.name} sees {robot}")
        hand = Hand(self, client, robot, device)
        self.hands.append(hand)
        return hand

    def drive(self, name: str, robot: str, velocity: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Hand:
        """Join an operator that acquires a robot, engages it and moves it at `velocity` [m/s]."""
        client = self.join(name)
        hand = self.add_hand(client, robot)
        client.acquire([robot])
        self.engage(hand)
        hand.velocity = velocity
        return hand

    def engage(self, hand: Hand) -> None:
        """Open the clutch of a hand, then close it, until the robot follows."""
        hand.clutch = False
        self.run(0.1)
        hand.clutch = True
        self.run_until(lambda: hand.is_following, f"{hand.robot} follows {hand.client.name}", 1.0)

    def check_rest(self, client: Client, robot: str, seconds: float = 0.3) -> None:
        """Check that a robot does not move for a time [s], as a client sees it."""
        before = see_tip(client, robot)
        self.run(seconds)
        assert distance(before[0], see_tip(client, robot)[0]) < 1e-4

    def list_events(self, name: str, kind: type[T]) -> list[tuple[int, T]]:
        """Return session time [ns] and body of the events of a type that a client has received."""
        return [(event.session_time, body) for event in self.events[name] if isinstance(body := event.body, kind)]

    def list_event_kinds(self, name: str) -> list[str]:
        """Return the types of the events that a client has received."""
        return [type(event.body).__name__ for event in self.events[name]]


class _Poller:
    """Polls one client when something has arrived for it or it is due, as a program's loop does."""

    def __init__(self, rig: Rig, client: Client, operator: EmulatedOperator | None = None) -> None:
        self._rig = rig
        self._client = client
        self._operator = operator
        self._due_ns = -1
        _sockets_of(client).on_arrival = self._wake
        self._wake()

    def _wake(self) -> None:
        self._call_at(self._rig.simulation.now_ns)

    def _call_at(self, at_ns: int) -> None:
        if self._due_ns < 0 or at_ns < self._due_ns:
            self._due_ns = at_ns
            self._rig.simulation.call_at(at_ns, lambda: self._poll(at_ns))

    def _poll(self, at_ns: int) -> None:
        client, operator, now_ns = self._client, self._operator, self._rig.simulation.now_ns
        if at_ns != self._due_ns or client.connection.phase is ConnectionPhase.CLOSED:
            return  # an earlier time has come up since
        self._due_ns = -1
        if self._rig.is_hanging(client):
            self._call_at(self._rig._hanging[client])
            return
        try:
            client.poll(0.0)
        except ClientError as error:
            self._rig.failures[client.name] = error
            return
        due_ns = client.connection.next_deadline_ns(now_ns)
        if operator is not None:
            operator.step(now_ns)
            due_ns = min(due_ns, operator.next_step_ns)
        self._call_at(max(due_ns, now_ns + 100_000))


def _sockets_of(client: Client) -> RigClientSockets:
    sockets = client._sockets
    assert isinstance(sockets, RigClientSockets)
    return sockets


def see_tip(client: Client, robot: str) -> PoseTuple:
    """Return `T_world_tip` of a robot as a client sees it now."""
    tip = client.scene.tip_pose(robot)
    assert tip is not None
    return tip


def is_driven(client: Client, robot: str, participant: str | None = None) -> bool:
    """Return whether samples (of one participant) were applied to a robot in the last 100 ms of the client's state."""
    state = client.scene.state
    return state is not None and any(
        a.robot == robot
        and participant in (None, a.participant)
        and state.header.session_time - a.step_ns < 100_000_000
        for a in state.header.applied
    )
