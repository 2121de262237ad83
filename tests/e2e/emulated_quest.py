"""An emulated Quest 3 (`iwer`) in a real Chromium, for tests and pictures.

The emulator replaces `navigator.xr` before the page's own scripts run; the page is the one that is shipped.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, Final

import pytest

from anchors.pose import (
    PoseTuple,
    Vec3,
    apply,
    compose,
    inverse,
    quat_from_rotvec,
    quat_from_yaw,
    quat_mul,
    quat_rotate,
)
from iris_session.bench.web_tab import WEB_CLIENT
from iris_session.client import Client
from iris_session.protocol.names import HoldReason
from iris_session.protocol.server_messages import EngagementChanged, ParticipantInfo
from tests.e2e.browser import Page
from tests.e2e.scenario import Scenario, assert_only_late
from tests.e2e.session_process import DEADLINE_S
from tests.rig.session import is_driven
from tools.codegen.conversions import to_three

IWER: Final = WEB_CLIENT / "node_modules" / "iwer" / "build" / "iwer.min.js"
#: Makes the emulated headset `quest`; `glide` moves its right controller in page frames, `tap` presses its trigger.
INSTALL: Final = """
// A headset with 30 frames a second: without a graphics card more leave nothing for the session on the same machine.
const request = window.requestAnimationFrame.bind(window);
const moveOn = (callback) => (time) => (advance(), tremble(), callback(time));
window.requestAnimationFrame = (callback) => setTimeout(() => request(moveOn(callback)), 25);
window.quest = new IWER.XRDevice(IWER.metaQuest3);
quest.installRuntime({ forceInstall: true });
// Measured poses are never the same twice, to the last bit: these move by less than 0.1 mm.
let beat = 0;
let advance = () => {};
const tremble = () => {
  const shift = 5e-5 * (Math.cos(beat + 1) - Math.cos(beat++));
  const inputs = [...Object.values(quest.controllers), ...Object.values(quest.hands)];
  for (const { position } of [quest, ...inputs]) position.x += shift;
};
// The emulator says of every pose that it is an estimate; headsets say so of devices that their cameras do not see.
window.isGuess = false;
Object.defineProperty(XRPose.prototype, "emulatedPosition", { get: () => window.isGuess });
window.place = (input, [x, y, z, qx, qy, qz, qw]) => {
  input.position.set(x, y, z);
  input.quaternion.set(qx, qy, qz, qw);
};
// A press of one frame, in the page itself: calls from outside take longer.
window.tap = () => new Promise((resolve) => {
  const set = (value) => quest.controllers.right.updateButtonValue("trigger", value);
  const wait = () => {
    const isSeen = irisSession.headset.headset.reading.inputs.some(({ trigger }) => trigger === 1);
    if (!isSeen) return setTimeout(wait, 5);
    set(0);
    resolve(null);
  };
  set(1);
  wait();
});
// A hand is where it is at the time of each frame, also after a pause of the page.
window.glide = (to, seconds) => new Promise((resolve) => {
  const { position } = quest.controllers.right;
  const from = [position.x, position.y, position.z];
  const begin = performance.now();
  advance = () => {
    const share = Math.min(1, (performance.now() - begin) / (1000 * seconds));
    position.set(...from.map((value, i) => value + share * (to[i] - value)));
    if (share < 1) return;
    advance = () => {};
    resolve(null);
  };
});
"""
HEADSET: Final = "irisSession.headset.headset"
#: What the session says of a robot to its holder.
FEEDBACK: Final = "(irisSession.state.feedback.get('{}') ?? {{ hold_reason: '', rejected: {{}} }})"
#: Where the headset's tracking frame is: nothing about it is special.
T_WORLD_TRACKING: Final[PoseTuple] = ((-0.4, 0.3, -0.75), quat_from_yaw(math.radians(35.0)))
HEAD: Final[PoseTuple] = ((0.0, 0.0, 1.6), (1.0, 0.0, 0.0, 0.0))
ATTEMPTS: Final = 8
#: The session's answer to what is pressed takes so long at most, also while the page draws slowly [s].
ANSWER_S: Final = 5.0


class EmulatedQuest:
    """A page in an emulated headset, and a director of the same session who sees what arrives there."""

    def __init__(self, scenario: Scenario, page: Page) -> None:
        self.scenario, self.page = scenario, page
        self.host: Client = scenario.join("host", "director")
        self._thread = ThreadPoolExecutor(1)

    def run_until(self, condition: Callable[[], object], what: str) -> None:
        """Poll the director until a condition holds. Fail with what the page says."""
        try:
            self.scenario.run_until(condition, what)
        except pytest.fail.Exception as error:
            raise AssertionError(f"{error}\n{self.page.describe()}") from error

    def in_page(self, action: Callable[[], object], what: str) -> object:
        """Do something in the page while the director is polled, and return its value."""
        job = self._thread.submit(action)
        self.scenario.run_until(job.done, what, 2 * DEADLINE_S)
        return job.result()

    def evaluate(self, script: str) -> object:
        return self.in_page(lambda: self.page.evaluate(script), script)

    def wait(self, script: str) -> None:
        self.in_page(lambda: self.page.wait(script), script)

    def click(self, name: str) -> None:
        self.in_page(lambda: self.page.click("button", name), name)

    def close(self) -> None:
        self._thread.shutdown()

    def press(self, button: str, value: float) -> None:
        """Press a button of the right controller."""
        self.evaluate(f"quest.controllers.right.updateButtonValue({json.dumps(button)}, {value})")

    def press_until(self, button: str, condition: Callable[[], object], what: str) -> None:
        """Press a button until a condition holds: what is pressed while the page stands still does not count, and a
        person presses again.
        """
        for _ in range(ATTEMPTS):
            self.press(button, 1.0)
            if self.scenario.wait_for(condition, ANSWER_S):
                return
            self.press(button, 0.0)
            self.wait(f"{HEADSET}.reading.inputs.every((one) => one.trigger === 0 && one.buttons === 0)")
        raise AssertionError(f"not by pressing {button}: {what}\n{self.page.describe()}")

    def tap_until(self, condition: Callable[[], object], what: str) -> None:
        """Tap at nothing until a condition holds, as `press_until`."""
        for _ in range(ATTEMPTS):
            self.tap_at_nothing()
            if self.scenario.wait_for(condition, ANSWER_S):
                return
        raise AssertionError(f"not by a tap: {what}\n{self.page.describe()}")

    def tap_at_nothing(self) -> None:
        """Press the trigger of the right controller for a moment, while it points at the sky."""
        self.evaluate("quest.controllers.right.quaternion.set(Math.SQRT1_2, 0, 0, Math.SQRT1_2)")
        let_go = f"{HEADSET}.reading.inputs.every((one) => one.trigger === 0)"
        self.wait(f"{HEADSET}.pointed.right === undefined && {let_go}")
        self.evaluate("tap()")

    def place(self, input_name: str, T_world_device: PoseTuple) -> None:
        """Place the headset or a controller, by its pose in the aligned world."""
        p, q = compose(inverse(T_WORLD_TRACKING), T_world_device)
        self.evaluate(f"place({input_name}, {json.dumps(to_three((*p, *q)))})")

    def glide(self, p_world: Vec3, seconds: float) -> None:
        """Move the right controller to a point of the aligned world."""
        row = to_three((*apply(inverse(T_WORLD_TRACKING), p_world), 1.0, 0.0, 0.0, 0.0))
        self.evaluate(f"glide({json.dumps(row[:3])}, {seconds})")

    def engage(self, robot: str) -> None:
        """Squeeze until the robot follows: a person lets go and tries again, too, when a sample came too late."""
        for _ in range(ATTEMPTS):
            self.press("squeeze", 0.0)
            # A squeeze that begins while marks are touched counts from the next one on.
            self.wait(f"!{HEADSET}.marks.isActive && {HEADSET}.reading.inputs.every((one) => one.squeeze === 0)")
            opened = f"{FEEDBACK.format(robot)}.hold_reason === 'clutch_open'"
            self.wait(f"{opened} || !{HEADSET}.hands.driven.has('right')")
            rejected = self.read_feedback(robot)["rejected"]
            self.press("squeeze", 1.0)
            if self.scenario.wait_for(lambda: is_driven(self.host, robot, self.person.id), ANSWER_S):
                return
            feedback = self.read_feedback(robot)
            # Where all samples of the squeeze were too late, the session has not seen it.
            is_unseen = feedback["hold_reason"] == HoldReason.CLUTCH_OPEN and feedback["rejected"] != rejected
            assert_only_late(rejected, feedback["rejected"], [] if is_unseen else [feedback["hold_reason"]])
        raise AssertionError(f"{robot} does not follow\n{self.page.describe()}")

    def has_state_since(self, session_ns: int) -> bool:
        """Return whether the director's state is as new as a session time."""
        state = self.host.scene.state
        return state is not None and state.header.session_time >= session_ns

    def read_feedback(self, robot: str) -> dict[str, Any]:
        """Return what the session says of a robot to its holder."""
        found: Any = self.evaluate(FEEDBACK.format(robot))
        return {**found}

    def pull_robot(self, robot: str, begin: PoseTuple, motion: Vec3) -> None:
        """Squeeze and move the right controller until the end effector has gone half of `motion` [m].

        A person begins anew where the robot held on the way: a machine that draws for the headset and runs the session
        may stand still for longer than samples may be old, or hands without a frame.
        """
        tip = self.host.scene.tip_pose(robot)
        assert tip
        first = tip[0]

        def has_followed() -> bool:
            now = self.host.scene.tip_pose(robot)
            return now is not None and dot(motion, sub(now[0], first)) > 0.5 * dot(motion, motion)

        deadline = time.monotonic() + DEADLINE_S
        while not has_followed():
            assert time.monotonic() < deadline, f"{robot} does not follow\n{self.page.describe()}"
            self.press("squeeze", 0.0)
            self.wait(f"{HEADSET}.reading.inputs.every((one) => one.squeeze === 0)")
            self.place("quest.controllers.right", begin)
            self.press("squeeze", 1.0)
            if self.scenario.wait_for(lambda: is_driven(self.host, robot, self.person.id), ANSWER_S):
                self.glide(add(begin[0], motion), 2.0)
                self.scenario.wait_for(has_followed, 1.0)

    def move_robot(self, robot: str, begin: PoseTuple, motion: Vec3) -> float:
        """Squeeze, move the right controller, and return how far the end effector is from where that takes it [m].

        An attempt during which the robot held for a late sample counts for nothing: the machine that draws for the
        headset runs the session too.
        """
        for _ in range(ATTEMPTS):
            self.press("squeeze", 0.0)
            self.place("quest.controllers.right", begin)
            self.engage(robot)
            seen = len(self.scenario.events["host"])
            rejected = self.read_feedback(robot)["rejected"]
            tip = self.host.scene.tip_pose(robot)
            assert tip
            target = add(tip[0], motion)
            self.glide(add(begin[0], motion), 2.0)
            rested_ns = self.host.session_now_ns() + 1_000_000_000
            self.run_until(lambda: self.has_state_since(rested_ns), "a second passes")  # noqa: B023
            bodies = [event.body for event in self.scenario.events["host"][seen:]]
            held = [b for b in bodies if isinstance(b, EngagementChanged) and b.robot == robot and not b.engaged]
            if not held and is_driven(self.host, robot, self.person.id):  # it may have ended before `seen`
                tip = self.host.scene.tip_pose(robot)
                assert tip
                return math.dist(tip[0], target)
            assert_only_late(rejected, self.read_feedback(robot)["rejected"], [b.reason for b in held])
        raise AssertionError(f"{robot} held in each of {ATTEMPTS} attempts\n{self.page.describe()}")

    @property
    def person(self) -> ParticipantInfo:
        """The participant of the page, as the director sees it."""
        found: ParticipantInfo = next(p for p in self.host.mirror.participants.values() if p.name == "eve")
        return found

    def is_aligned(self, kind: str) -> bool:
        return self.person.alignment is not None and self.person.alignment.kind == kind

    def enter(self, button: str) -> None:
        """Enter AR or VR, and wait until the connection stands again."""
        self.click(button)
        self.wait(f"{HEADSET}?.reading?.inputs.length === 2")
        self.run_until(lambda: "head" in self.person.devices and self.person.connected, "the headset has joined")
        self.wait("irisSession.state.isReady && irisSession.state.self.devices.includes('head')")


def add(a: Vec3, b: Vec3) -> Vec3:
    return (a[0] + b[0], a[1] + b[1], a[2] + b[2])


def sub(a: Vec3, b: Vec3) -> Vec3:
    return (a[0] - b[0], a[1] - b[1], a[2] - b[2])


def dot(a: Vec3, b: Vec3) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def holder(client: Client, robot: str) -> str:
    lease = client.mirror.leases.get(robot)
    return lease.holder if lease else ""


def aim_at(p_world: Vec3, distance: float) -> PoseTuple:
    """Return a pose from which the x axis points at `p_world`, from above and behind."""
    q = quat_mul(quat_from_yaw(math.radians(20.0)), quat_from_rotvec((0.0, math.radians(25.0), 0.0)))
    d = quat_rotate(q, (1.0, 0.0, 0.0))
    return (p_world[0] - distance * d[0], p_world[1] - distance * d[1], p_world[2] - distance * d[2]), q
