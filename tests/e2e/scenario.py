"""Clients of one session, driven by one loop: `Scenario` polls all of them until a condition holds."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping
from typing import Any, Final

import pytest

from anchors.pose import PoseTuple
from iris_session.client import Client
from iris_session.protocol.names import HoldReason, RejectReason
from iris_session.protocol.server_messages import Event, ParticipantJoined
from tests.e2e.session_process import DEADLINE_S, SessionProcess, read_output_tails
from tests.rig.session import is_driven

#: Why a robot holds until its clutch was opened, when a process has to wait for its turn.
LATE: Final = frozenset({HoldReason.STALE, HoldReason.REJECTED, HoldReason.GAP, HoldReason.REARM})


class Hand:
    """The hand of an operator at a screen, or a policy's: sends samples of one device that drives `robot`.

    The pose is in the tracking frame, which is the world for clients that need no alignment.
    """

    def __init__(self, client: Client, robot: str, device: str = "desktop") -> None:
        self.client = client
        self.robot = robot
        self.device = device
        self.pose: PoseTuple = ((0.0, 0.0, 1.0), (1.0, 0.0, 0.0, 0.0))
        self.clutch = False
        self.velocity = (0.0, 0.0, 0.0)
        self.sending = True
        self._next = 0.0

    def send_if_due(self) -> None:
        """Move by `velocity` and send a sample, 72 times a second."""
        now = time.monotonic()
        if not self.sending or now < self._next:
            return
        dt = 1.0 / 72.0
        self._next = now + dt
        p = self.pose[0]
        v = self.velocity
        self.pose = ((p[0] + v[0] * dt, p[1] + v[1] * dt, p[2] + v[2] * dt), self.pose[1])
        self.client.send_sample(self.device, self.pose, robots=[self.robot], clutch=self.clutch)

    @property
    def tip(self) -> PoseTuple:
        tip = self.client.scene.tip_pose(self.robot)
        assert tip is not None
        return tip


class Scenario:
    """The clients of one test at one session; `run_until` polls all of them until a condition holds."""

    def __init__(self, server: SessionProcess) -> None:
        self.server = server
        self.clients: list[Client] = []
        self.hands: list[Hand] = []
        self.events: dict[str, list[Event]] = {}

    def join(self, name: str, role: str = "operator", identity: str | None = None) -> Client:
        """Join a client that needs no alignment (policy, desktop)."""
        log = self.events[name] = []
        client = Client(
            self.server.address,
            role=role,
            name=name,
            devices=("desktop", "head", "joints", "target"),
            alignment="not_needed",
            identity=identity,
            on_event=log.append,
        )
        return self.add(client)

    def add(self, client: Client) -> Client:
        """Join a client while others are polled: on a busy machine a join may exceed the heartbeat timeout."""
        self.clients.append(client)
        client.open()
        self.run_until(lambda: client.ready, f"{client.name} has joined")
        return client

    def add_hand(self, client: Client, robot: str) -> Hand:
        """Give a client a hand for a robot, once its scene has the robot."""
        self.run_until(lambda: client.scene.tip_pose(robot) is not None, f"{client.name} sees {robot}")
        hand = Hand(client, robot)
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
        """Open and close the clutch, so that the robot follows. Limits of time do not count here: `PATIENT_COMMAND`.

        A sample that is rejected as the clutch closes leaves the robot held until it is opened again, as for a person.
        """
        must_let_go = True
        while must_let_go:
            hand.clutch = False
            self.run_until(
                lambda: self.is_open(hand), f"the session knows that the clutch of {hand.client.name} is open"
            )
            hand.clutch = True
            self.run_until(
                lambda: self.is_following(hand) or self._find_hold(hand) in LATE,
                f"{hand.robot} follows {hand.client.name}",
            )
            must_let_go = not self.is_following(hand)

    def _find_hold(self, hand: Hand) -> str:
        """Return why the robot holds, as its holder was told last."""
        feedback = hand.client.feedback.get(hand.robot)
        return feedback.hold_reason if feedback is not None else ""

    def is_open(self, hand: Hand) -> bool:
        """Return whether the robot holds because the clutch of the hand is open."""
        return self._find_hold(hand) == HoldReason.CLUTCH_OPEN

    def is_following(self, hand: Hand) -> bool:
        """Return whether samples of the hand's participant were applied to its robot within 100 ms."""
        return is_driven(hand.client, hand.robot, hand.client.connection.participant_id)

    def poll(self) -> None:
        for hand in self.hands:
            hand.send_if_due()
        for client in self.clients:
            client.poll(0.0)
        time.sleep(0.002)

    def run_until(self, condition: Callable[[], object], what: str, timeout_s: float = DEADLINE_S) -> None:
        deadline = time.monotonic() + timeout_s
        while not condition():
            if time.monotonic() > deadline:
                feedback = [hand.client.feedback.get(hand.robot) for hand in self.hands]
                tails = read_output_tails(self.server.folder.parent)
                pytest.fail(f"not within {timeout_s:g} s: {what}; feedback: {feedback}\n{tails}")
            self.poll()

    def wait_for(self, condition: Callable[[], object], timeout_s: float) -> bool:
        """Poll until a condition holds; return false if it does not within `timeout_s`."""
        deadline = time.monotonic() + timeout_s
        while not (holds := bool(condition())) and time.monotonic() < deadline:
            self.poll()
        return holds

    def run_for(self, seconds: float) -> None:
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            self.poll()

    def get_height(self, name: str, body: str) -> float:
        """Return the height at which client `name` sees a body [m]; 0 before its first state."""
        client = next(client for client in self.clients if client.name == name)
        state = client.scene.state
        return 0.0 if state is None else float(state.poses[client.mirror.body_index[body]][2])

    def list_event_kinds(self, name: str) -> list[str]:
        """Return the names of the events that client `name` has received."""
        return [type(event.body).__name__ for event in self.events[name]]

    def has_seen_joining(self, name: str, joined: str) -> bool:
        """Return whether client `name` has received the event that participant `joined` joined."""
        bodies = [event.body for event in self.events[name]]
        return any(isinstance(b, ParticipantJoined) and b.participant.name == joined for b in bodies)

    def close(self) -> None:
        for client in self.clients:
            client.close()


def assert_only_late(before: Mapping[str, Any], now: Mapping[str, Any], reasons: Iterable[str]) -> None:
    """Assert that a robot held for nothing but what a busy machine does now and then: samples that came too late, and a
    session that stood still.

    Args:
        before: Counts of the participant's rejected samples (`Feedback.rejected`) when it engaged.
        now: The same counts now.
        reasons: Why the robot held (`HoldReason`).
    """
    rejected = {reason for reason, count in now.items() if count > before.get(reason, 0)}
    is_late = set(reasons) <= {HoldReason.STALE, HoldReason.REJECTED, HoldReason.GAP} and rejected <= {
        RejectReason.STALE
    }
    assert is_late, (
        f"held: {sorted(set(reasons))}, rejected samples: {sorted(rejected)}; only late samples and a gap are excused"
    )
