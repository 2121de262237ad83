"""The page in an emulated Quest 3 (`iwer`), in a real Chromium, against a real session and its gateway."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import Final

import pytest

from anchors.pose import PoseTuple, compose
from iris_session.protocol.names import AlignmentKind
from tests.e2e.browser import Page, join_as
from tests.e2e.emulated_quest import (
    FEEDBACK,
    HEAD,
    HEADSET,
    INSTALL,
    IWER,
    T_WORLD_TRACKING,
    EmulatedQuest,
    aim_at,
    holder,
)
from tests.e2e.scenario import Scenario
from tests.rig.session import is_driven

pytestmark = pytest.mark.e2e

#: Motion of the hand in the world, 10 cm long.
MOTION_M: Final = (0.0, 0.06, 0.08)
FOLLOWS_M: Final = 0.005
#: How the page shows the right controller.
SHOWN_HAND: Final = f"{HEADSET}.props.props.get('right')"


@pytest.fixture
def quest(scenario: Scenario, open_page: Callable[..., Page]) -> Iterator[EmulatedQuest]:
    before = [IWER.read_text(), INSTALL]
    page = open_page(scenario.server, "quest", width=480, height=320, before=before)
    join_as(page, "eve", "operator")
    made = EmulatedQuest(scenario, page)
    made.run_until(lambda: made.host.scene.tip_pose("left") is not None, "the director sees the robots")
    yield made
    made.close()


def lease_in_ar(quest: EmulatedQuest) -> PoseTuple:
    """Enter AR, be aligned by a director, lease the left robot by pointing at it. Return the controller's pose."""
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
    quest.press_until("trigger", lambda: holder(host, "left") == person, "the robot is leased by pointing at it")
    quest.press("trigger", 0.0)
    quest.wait(f"{HEADSET}.hands.driven.get('right') === 'left'")
    return pose


def test_a_robot_is_driven_in_ar(quest: EmulatedQuest) -> None:
    """Enter, be aligned by a director, point, lease, squeeze, move, be out of sight, squeeze again, release, stop."""
    host = quest.host
    pose = lease_in_ar(quest)
    quest.pull_robot("left", pose, MOTION_M)

    quest.evaluate("window.isGuess = true")
    quest.wait(f"{FEEDBACK.format('left')}.hold_reason === 'emulated'")
    quest.run_until(lambda: not is_driven(host, "left", quest.person.id), "it holds while the headset guesses")
    quest.wait(f"{SHOWN_HAND}.object.visible && {SHOWN_HAND}.words.shown.includes('out of sight')")
    quest.evaluate("window.isGuess = false")
    quest.wait(f"{SHOWN_HAND}.words.shown.includes('squeeze again')")
    quest.engage("left")

    quest.press("squeeze", 0.0)
    quest.run_until(lambda: not is_driven(host, "left", quest.person.id), "the robot holds")
    now = host.scene.tip_pose("left")
    assert now
    quest.place("quest.controllers.right", aim_at(now[0], 0.6))
    quest.wait(f"{HEADSET}.pointed.right === 'left'")
    quest.press_until("trigger", lambda: holder(host, "left") == "", "the robot is released by holding the trigger")
    quest.press("trigger", 0.0)

    quest.press("thumbstick", 1.0)
    quest.run_until(lambda: host.mirror.estop, "the thumbstick stops")
    quest.wait(f"{HEADSET}.props.urgent.shown.includes('STOPPED')")
    assert quest.page.errors == []


@pytest.mark.long
def test_the_end_effector_is_where_the_hand_takes_it(quest: EmulatedQuest) -> None:
    error = quest.move_robot("left", lease_in_ar(quest), MOTION_M)
    print(f"the hand moved {100 * math.hypot(*MOTION_M):.0f} cm, the end effector is {1e3 * error:.1f} mm from there")
    assert error <= FOLLOWS_M


@pytest.mark.long
def test_a_lease_goes_into_vr_and_back(quest: EmulatedQuest) -> None:
    """The connection is resumed, not replaced; hiding and recentring hold; a director in VR is placed when it asks."""
    host = quest.host
    quest.in_page(lambda: join_as(quest.page, "eve", "director"), "eve joins as director")
    quest.run_until(lambda: quest.person.role == "director", "eve directs")
    person = quest.person.id
    quest.click("Take: left")
    quest.run_until(lambda: holder(host, "left") == person, "eve has the robot")
    quest.enter("Enter VR")
    quest.wait(f"{HEADSET}.showsScene && {HEADSET}.props.urgent.shown.includes('To stay here')")
    assert quest.person.alignment is None  # a measurement may still align it
    quest.tap_until(lambda: quest.is_aligned(AlignmentKind.PLACED), "a director is placed by its own word")
    assert (quest.person.id, holder(host, "left")) == (person, person)

    quest.engage("left")  # the robot that was leased before
    quest.evaluate("quest.updateVisibilityState('visible-blurred')")
    quest.run_until(lambda: not is_driven(host, "left", person), "it holds while a menu covers the scene")
    quest.wait("irisSession.state.feedback.get('left').hold_reason === 'untracked'")
    quest.evaluate("quest.updateVisibilityState('visible')")
    quest.press("squeeze", 0.0)
    quest.wait("irisSession.state.feedback.get('left').hold_reason === 'clutch_open'")

    alignment = quest.person.alignment
    assert alignment
    quest.evaluate("quest.recenter()")
    quest.run_until(lambda: quest.person.alignment is None, "another tracking frame is not aligned")
    quest.wait(f"{HEADSET}.props.urgent.shown.includes('To stay here')")
    quest.tap_until(
        lambda: (
            quest.is_aligned(AlignmentKind.PLACED)
            and quest.person.alignment is not None
            and quest.person.alignment.tracking_epoch > alignment.tracking_epoch
        ),
        "it is placed anew",
    )

    quest.evaluate(f"{HEADSET}.session.end()")
    quest.run_until(lambda: quest.is_aligned(AlignmentKind.NOT_NEEDED), "the page is one with a screen again")
    quest.wait("irisSession.state.isReady && irisSession.headset.headset === null")
    assert (quest.person.id, holder(host, "left")) == (person, person)
    assert quest.page.errors == []


#: Moves the right hand so that its index finger is in the ball at the left wrist, or next to it.
TOUCH: Final = """(({ reading, wristStop }, away) => {
  const tip = reading.inputs.find(({ side }) => side === "right").tip;
  const [x, y, z] = wristStop.center.map((value, i) => value - tip[i]); // forward, left, up
  const { position } = quest.hands.right;
  position.set(position.x - y + away, position.y + z, position.z - x);
})"""


@pytest.mark.long
def test_bare_hands_stop_at_the_wrist(quest: EmulatedQuest) -> None:
    host, person = quest.host, quest.person.id
    quest.evaluate("quest.primaryInputMode = 'hand'")
    quest.enter("Enter AR")
    host.alignment.place(person, T_WORLD_TRACKING)
    quest.run_until(lambda: (person, "hand/left") in host.scene.presence, "hands are seen by others")
    quest.wait(f"{HEADSET}.wristStop.center !== null && {HEADSET}.reading.inputs.every(({{ tip }}) => tip !== null)")
    quest.evaluate(f"{TOUCH}({HEADSET}, 0.1)")
    quest.scenario.run_for(0.5)
    assert not host.mirror.estop
    quest.evaluate(f"{TOUCH}({HEADSET}, 0)")
    quest.run_until(lambda: host.mirror.estop, "a fingertip at the wrist stops")
    quest.wait(f"{HEADSET}.props.urgent.shown.includes('STOPPED')")
    assert quest.page.errors == []
