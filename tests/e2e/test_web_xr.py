"""The page in an emulated Quest 3 (`iwer`), in a real Chromium, against a real session and its gateway.

The emulator replaces `navigator.xr` before the page's own scripts run; the page is the one that is shipped.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Final

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
from iris_session.client import Client
from iris_session.codegen.conversions import to_three
from iris_session.protocol.names import AlignmentKind
from iris_session.protocol.server_messages import EngagementChanged, ParticipantInfo
from tests.e2e.browser import WEB_CLIENT, Page, join_as
from tests.e2e.scenario import Scenario, is_driven
from tests.e2e.session_process import DEADLINE_S

pytestmark = pytest.mark.e2e

IWER: Final = WEB_CLIENT / "node_modules" / "iwer" / "build" / "iwer.min.js"
#: Makes the emulated headset `quest`, and `glide`, which moves its right controller in page frames.
INSTALL: Final = """
// A headset with 30 frames a second: without a graphics card more leave nothing for the session on the same machine.
const request = window.requestAnimationFrame.bind(window);
window.requestAnimationFrame = (callback) => setTimeout(() => request(callback), 25);
window.quest = new IWER.XRDevice(IWER.metaQuest3);
quest.installRuntime({ forceInstall: true });
// The emulator says of every pose that it is a guess; headsets say so of devices that they have lost.
window.isGuess = false;
Object.defineProperty(XRPose.prototype, "emulatedPosition", { get: () => window.isGuess });
window.place = (input, [x, y, z, qx, qy, qz, qw]) => {
  input.position.set(x, y, z);
  input.quaternion.set(qx, qy, qz, qw);
};
window.glide = (to, seconds) => new Promise((resolve) => {
  const { position } = quest.controllers.right;
  const from = [position.x, position.y, position.z];
  const begin = performance.now();
  const step = () => {
    const share = Math.min(1, (performance.now() - begin) / (1000 * seconds));
    position.set(...from.map((value, i) => value + share * (to[i] - value)));
    if (share < 1) requestAnimationFrame(step);
    else resolve(null);
  };
  step();
});
"""
HEADSET: Final = "irisSession.headset.headset"
#: Where the headset's tracking frame is: nothing about it is special.
T_WORLD_TRACKING: Final[PoseTuple] = ((-0.4, 0.3, -0.75), quat_from_yaw(math.radians(35.0)))
HEAD: Final[PoseTuple] = ((0.0, 0.0, 1.6), (1.0, 0.0, 0.0, 0.0))
#: Motion of the hand in the world, 10 cm long.
MOTION_M: Final = (0.0, 0.06, 0.08)
FOLLOWS_M: Final = 0.005
ATTEMPTS: Final = 8


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

    def place(self, input_name: str, T_world_device: PoseTuple) -> None:
        """Place the headset or a controller, by its pose in the aligned world."""
        p, q = compose(inverse(T_WORLD_TRACKING), T_world_device)
        self.evaluate(f"place({input_name}, {json.dumps(to_three((*p, *q)))})")

    def glide(self, p_world: Vec3, seconds: float) -> None:
        """Move the right controller to a point of the aligned world."""
        row = to_three((*apply(inverse(T_WORLD_TRACKING), p_world), 1.0, 0.0, 0.0, 0.0))
        self.evaluate(f"glide({json.dumps(row[:3])}, {seconds})")

    def engage(self, robot: str) -> None:
        """Squeeze until the robot follows: a person lets go and tries again, too, when it does not."""
        for _ in range(ATTEMPTS):
            self.press("squeeze", 0.0)
            self.scenario.run_for(0.3)
            self.press("squeeze", 1.0)
            if self.scenario.wait_for(lambda: is_driven(self.host, robot, self.person.id), 5.0):
                return
        raise AssertionError(f"{robot} does not follow\n{self.page.describe()}")

    def move_robot(self, robot: str, begin: PoseTuple, motion: Vec3) -> float:
        """Squeeze, move the right controller, and return how far the end effector is from where that takes it [m].

        An attempt during which the robot held counts for nothing: the machine that draws for the headset runs the
        session too, so samples come too late now and then.
        """
        for _ in range(ATTEMPTS):
            self.press("squeeze", 0.0)
            self.place("quest.controllers.right", begin)
            self.engage(robot)
            seen = len(self.scenario.events["host"])
            tip = self.host.scene.tip_pose(robot)
            assert tip
            target = add(tip[0], motion)
            self.glide(add(begin[0], motion), 2.0)
            self.scenario.run_for(1.0)
            bodies = [event.body for event in self.scenario.events["host"][seen:]]
            if not any(isinstance(b, EngagementChanged) and b.robot == robot and not b.engaged for b in bodies):
                tip = self.host.scene.tip_pose(robot)
                assert tip
                return math.dist(tip[0], target)
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


@pytest.fixture
def quest(scenario: Scenario, open_page: Callable[..., Page]) -> Iterator[EmulatedQuest]:
    before = [IWER.read_text(), INSTALL]
    page = open_page(scenario.server, "quest", width=480, height=320, before=before)
    join_as(page, "eve", "operator")
    made = EmulatedQuest(scenario, page)
    made.run_until(lambda: made.host.scene.tip_pose("left") is not None, "the director sees the robots")
    yield made
    made.close()


def add(a: Vec3, b: Vec3) -> Vec3:
    return (a[0] + b[0], a[1] + b[1], a[2] + b[2])


def holder(client: Client, robot: str) -> str:
    lease = client.mirror.leases.get(robot)
    return lease.holder if lease else ""


def aim_at(p_world: Vec3, distance: float) -> PoseTuple:
    """Return a pose from which the x axis points at `p_world`, from above and behind."""
    q = quat_mul(quat_from_yaw(math.radians(20.0)), quat_from_rotvec((0.0, math.radians(25.0), 0.0)))
    d = quat_rotate(q, (1.0, 0.0, 0.0))
    return (p_world[0] - distance * d[0], p_world[1] - distance * d[1], p_world[2] - distance * d[2]), q


def test_a_robot_is_driven_in_ar(quest: EmulatedQuest) -> None:
    """Enter, be aligned by a director, point, lease, squeeze, move 10 cm, release, stop."""
    host = quest.host
    person = quest.person.id
    quest.enter("Enter AR")
    assert quest.person.id == person  # the same participant, resumed
    assert quest.person.alignment is None
    assert quest.evaluate(f"{HEADSET}.showsScene") is False
    quest.wait(f"{HEADSET}.props.urgent.shown.includes('not aligned')")
    host.alignment.place(person, T_WORLD_TRACKING)
    quest.wait(f"{HEADSET}.showsScene")

    quest.place("quest", compose(T_WORLD_TRACKING, HEAD))
    tip = host.scene.tip_pose("left")
    assert tip
    pose = aim_at(tip[0], 0.6)
    quest.place("quest.controllers.right", pose)

    def arrives(device: str, T_world_device: PoseTuple, bound_m: float) -> bool:
        item = host.scene.presence.get((person, device))
        return item is not None and math.dist(item.pose.p, T_world_device[0]) < bound_m

    quest.run_until(lambda: arrives("head", compose(T_WORLD_TRACKING, HEAD), 0.002), "the head is where it is")
    quest.run_until(lambda: arrives("controller/right", pose, 0.15), "the controller is near the origin of its ray")

    quest.wait(f"{HEADSET}.pointed.right === 'left'")
    quest.press("trigger", 1.0)
    quest.run_until(lambda: holder(host, "left") == person, "the robot is leased by pointing at it")
    quest.press("trigger", 0.0)
    quest.wait(f"{HEADSET}.hands.driven.get('right') === 'left'")

    error = quest.move_robot("left", pose, MOTION_M)
    print(f"the hand moved {100 * math.hypot(*MOTION_M):.0f} cm, the end effector is {1e3 * error:.1f} mm from there")
    assert error <= FOLLOWS_M

    quest.press("squeeze", 0.0)
    quest.run_until(lambda: not is_driven(host, "left", person), "the robot holds")
    now = host.scene.tip_pose("left")
    assert now
    quest.place("quest.controllers.right", aim_at(now[0], 0.6))
    quest.wait(f"{HEADSET}.pointed.right === 'left'")
    quest.press("trigger", 1.0)
    quest.run_until(lambda: holder(host, "left") == "", "the robot is released by holding the trigger")
    quest.press("trigger", 0.0)

    quest.press("thumbstick", 1.0)
    quest.run_until(lambda: host.mirror.estop, "the thumbstick stops")
    quest.wait(f"{HEADSET}.props.urgent.shown.includes('STOPPED')")
    assert quest.page.errors == []


def test_a_lease_goes_into_vr_and_back(quest: EmulatedQuest) -> None:
    """The connection is resumed, not replaced; hiding and recentring hold; a director in VR is placed at once."""
    host = quest.host
    quest.in_page(lambda: join_as(quest.page, "eve", "director"), "eve joins as director")
    quest.run_until(lambda: quest.person.role == "director", "eve directs")
    person = quest.person.id
    quest.click("Take: left")
    quest.run_until(lambda: holder(host, "left") == person, "eve has the robot")
    quest.enter("Enter VR")
    quest.run_until(lambda: quest.is_aligned(AlignmentKind.PLACED), "a director is placed by its own word")
    assert (quest.person.id, holder(host, "left")) == (person, person)
    assert quest.evaluate(f"{HEADSET}.showsScene") is True

    quest.engage("left")  # the robot that was leased before
    quest.evaluate("quest.updateVisibilityState('visible-blurred')")
    quest.run_until(lambda: not is_driven(host, "left", person), "it holds while a menu covers the scene")
    quest.wait("irisSession.state.feedback.get('left').hold_reason === 'untracked'")
    quest.evaluate("quest.updateVisibilityState('visible')")
    quest.press("squeeze", 0.0)
    quest.wait("irisSession.state.feedback.get('left').hold_reason === 'clutch_open'")
    quest.evaluate("window.isGuess = true")
    quest.wait("irisSession.state.feedback.get('left').hold_reason === 'untracked'")
    quest.evaluate("window.isGuess = false")

    alignment = quest.person.alignment
    assert alignment
    quest.evaluate("quest.recenter()")
    quest.run_until(
        lambda: (
            quest.is_aligned(AlignmentKind.PLACED)
            and quest.person.alignment is not None
            and quest.person.alignment.tracking_epoch > alignment.tracking_epoch
        ),
        "another tracking frame is placed anew",
    )

    quest.evaluate(f"{HEADSET}.session.end()")
    quest.run_until(lambda: quest.is_aligned(AlignmentKind.NOT_NEEDED), "the page is one with a screen again")
    quest.wait("irisSession.state.isReady && irisSession.headset.headset === null")
    assert (quest.person.id, holder(host, "left")) == (person, person)
    assert quest.page.errors == []


def test_without_a_headset_the_page_says_so(scenario: Scenario, open_page: Callable[..., Page]) -> None:
    page = open_page(scenario.server, "screen")
    page.wait("document.querySelector('.headset').innerText.includes('No headset')")
    assert page.evaluate("[...document.querySelectorAll('.headset button')].every((one) => one.hidden)")
