"""Driving a robot from the page with keys and mouse, and the panels of recording cameras, in a real Chromium."""

from __future__ import annotations

import json
import shutil
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from iris_session.demo.scenes import scene_path
from iris_session.protocol.server_messages import EngagementChanged
from tests.e2e.browser import Page, decode_picture, join_as
from tests.e2e.scenario import LATE, Scenario, assert_only_late
from tests.e2e.session_process import SessionProcess

pytestmark = pytest.mark.e2e

#: The view looks along +Y of the world: W moves there, D along +X.
VIEW = {"lookat": [0, 0, 0.2], "azimuth": 90, "elevation": -25, "distance": 2.0}
SPEED = 0.1  # of the tip by default [m/s]
#: A robot that stops has this long [s]; its tip is at rest within this of where it stays [m].
STOP_S, REST_M = 0.2, 0.001
#: Duration of a drag [s].
DRAG_S = 2.5
#: Another camera: half a metre before the tip of the left robot, whose picture is 17 cm high there.
CLOSE = '<camera name="close" pos="-0.2 -0.5 0.28" xyaxes="1 0 0 0 0 1" fovy="20"/>'

#: What the session says of the left robot to its holder.
FEEDBACK = "irisSession.state.feedback.get('left') ?? { hold_reason: '', rejected: {} }"
#: Returns where the base of the left robot is in the picture [pixels].
FIND_BASE = """() => {
  const { state, view } = irisSession;
  const { position } = view.scene.bodies.get(state.session.robots.find(({ name }) => name === "left").base_body);
  const at = position.clone().set(-position.y, position.z + 0.05, -position.x).project(view.viewpoint.camera);
  const box = document.querySelector("#scene").getBoundingClientRect();
  return [box.x + ((1 + at.x) / 2) * box.width, box.y + ((1 - at.y) / 2) * box.height];
}"""
#: How far the handles are pulled from the gripper [m].
PULLED = "irisSession.gizmo.pivot.position.distanceTo(irisSession.gizmo.p_world)"
#: Drags what is at a place of the picture up, and lets go. Returns whether the handles were held and how far they were
#: pulled [m], each during the drag and after it.
DRAG = f"""(x, y, up) => {{
  const send = (type, clientY) => document.elementFromPoint(x, y).dispatchEvent(
    new PointerEvent(type, {{ clientX: x, clientY, pointerId: 1, isPrimary: true, bubbles: true }}));
  const found = [];
  for (const [type, clientY] of [["pointerdown", y], ["pointermove", y - up], ["pointerup", y - up]]) {{
    send(type, clientY);
    if (type !== "pointerdown") found.push(irisSession.gizmo.isHeld, {PULLED});
  }}
  return found;
}}"""
#: Notes in `window.at` when keys change and the focus is lost, in session time [ms].
NOTE_KEYS = """void (window.at = {}, ["keydown", "keyup", "blur"].forEach((type) => {
  const note = (event) => { window.at[`${type} ${event.code ?? ""}`.trim()] = irisSession.view.sessionTime(); };
  window.addEventListener(type, (event) => { if (!event.repeat) note(event); }, { capture: true });
}))"""


class Tip:
    """The end effector of the left robot as another client sees it, with times of the session."""

    def __init__(self, scenario: Scenario) -> None:
        self.scenario = scenario
        self.client = scenario.join("watcher", "director")
        scenario.run_until(lambda: self.client.scene.tip_pose("left") is not None, "the watcher sees the robot")
        self.times: list[float] = []
        self.places: list[NDArray[np.float64]] = []

    @property
    def place(self) -> NDArray[np.float64]:
        tip = self.client.scene.tip_pose("left")
        assert tip is not None
        return np.array(tip[0])

    @property
    def sim_time(self) -> float:
        state = self.client.scene.state
        assert state is not None
        return float(state.header.sim_time)

    def note(self) -> None:
        state = self.client.scene.state
        if state is not None and (not self.times or state.header.session_time * 1e-6 > self.times[-1]):
            self.times.append(state.header.session_time * 1e-6)
            self.places.append(self.place)

    def watch(self, condition: Callable[[], object], what: str) -> None:
        """Note where the tip is until a condition holds."""

        def is_done() -> bool:
            self.note()
            return bool(condition())

        self.scenario.run_until(is_done, what)

    def watch_for(self, seconds: float) -> None:
        """Watch until so much time has passed in the simulation, too: a busy machine may stand still meanwhile."""
        end, end_sim = time.monotonic() + seconds, self.sim_time + seconds
        self.watch(lambda: time.monotonic() > end and self.sim_time > end_sim, f"{seconds} s")

    def measure_stop(self, since_ms: float) -> float:
        """Watch a second; return how long after a moment of the session the tip was at rest [s]."""
        self.watch_for(1.0)
        distances = np.linalg.norm(np.array(self.places) - self.places[-1], axis=1)
        moving = np.array(self.times)[distances > REST_M]
        return float((moving[-1] - since_ms) * 1e-3) if len(moving) else 0.0


@pytest.fixture
def driver(scenario: Scenario, open_page: Callable[..., Page]) -> Page:
    """A page that drives the left robot, which it holds. It notes when keys change, in session time [ms]."""
    page = open_page(scenario.server, "driver", width=840, height=480)  # small, because software draws it
    join_as(page, "dora", "operator")
    start_driving(page)
    return page


def start_driving(page: Page) -> None:
    page.click("button", "Take: left")
    page.click("button", "Drive: left")
    page.wait("!document.querySelector('.drive').hidden")
    set_view(page)
    page.evaluate(NOTE_KEYS)


def set_view(page: Page) -> None:
    drawn = page.evaluate(f"(irisSession.view.viewpoint.setFree({json.dumps(VIEW)}), irisSession.view.drawn)")
    page.wait(f"irisSession.view.drawn > {drawn} + 1")


def words(page: Page) -> str:
    text: str = page.evaluate("document.querySelector('.drive .why').textContent")
    return text


def wait_for_samples(tip: Tip, page: Page) -> None:
    """Wait until samples have seen what is pressed now. Nothing counts for 0.2 s after the focus came back."""
    page.evaluate("new Promise((done) => setTimeout(() => done(null), 300))")  # samples are due before, however late
    tip.watch_for(0.1)


def drive_until(
    page: Page, tip: Tip, is_there: Callable[[], bool], hold: Callable[[], object], let_go: Callable[[], object]
) -> None:
    """Hold something until the tip is where it should be. `let_go` is called only before it is held anew.

    On a busy machine a sample may come too late and be rejected: then, and only then, it is held anew.
    """
    for _ in range(10):
        until = time.monotonic() + 5.0
        rejected = page.evaluate(FEEDBACK)["rejected"]
        hold()
        while not is_there() and time.monotonic() < until:
            tip.watch_for(0.002)
        if is_there():
            return
        feedback = page.evaluate(FEEDBACK)
        assert_only_late(rejected, feedback["rejected"], filter(None, [feedback["hold_reason"]]))
        let_go()
        wait_for_samples(tip, page)
    raise AssertionError(f"the tip does not get there: {words(page)}")


def drive_forward(page: Page, tip: Tip, distance: float) -> NDArray[np.float64]:
    """Hold left Shift and W until the tip has moved by `distance` [m]; return where it began."""
    begin = tip.place

    def hold() -> None:
        nonlocal begin
        begin = tip.place
        page.hold("Shift")
        page.hold("w")

    def let_go() -> None:
        page.let_go("w")
        page.let_go("Shift")

    drive_until(page, tip, lambda: bool(np.linalg.norm(tip.place - begin) > distance), hold, let_go)
    return begin


def test_keys_drive_the_robot_while_the_dead_man_is_pressed(scenario: Scenario, driver: Page) -> None:
    """How fast and how far is in the test after this one."""
    tip = Tip(scenario)
    begin = tip.place
    driver.hold("w")
    tip.watch_for(0.5)
    assert np.linalg.norm(tip.place - begin) < REST_M
    assert words(driver).startswith("Held. ")
    driver.let_go("w")
    begin = drive_forward(driver, tip, 0.03)
    assert tip.place[1] - begin[1] > 0.02
    driver.let_go("w")
    driver.let_go("Shift")
    driver.wait("document.querySelector('.drive .why').textContent.startsWith('Held. ')")
    assert driver.errors == []


@pytest.mark.long
def test_keys_move_the_end_effector(scenario: Scenario, driver: Page) -> None:
    tip = Tip(scenario)
    begin = drive_forward(driver, tip, 0.095)
    driver.wait("document.querySelector('.drive.engaged')")
    assert words(driver) == "The robot follows you."
    driver.let_go("w")
    at = driver.evaluate("window.at")
    stopped_s = tip.measure_stop(at["keyup KeyW"])
    moved = tip.place - begin
    expected = SPEED * (at["keyup KeyW"] - at["keydown KeyW"]) * 1e-3
    print(f"moved {1e3 * moved} mm, {1e3 * expected:.1f} mm by time; at rest after {1e3 * stopped_s:.0f} ms")
    assert abs(moved[1] - expected) < 0.015
    assert moved[1] > 0.09
    assert np.linalg.norm(moved[[0, 2]]) < 0.005
    assert stopped_s < STOP_S
    assert driver.errors == []


@pytest.mark.long
def test_the_mouse_drags_the_end_effector(scenario: Scenario, driver: Page) -> None:
    """Half a millimetre for a pixel: to the right along +X, and no farther when the button is let go.

    A page that draws slowly misses a part of the way, and so does one whose samples come too late; then, and only then,
    it is dragged on.
    """
    driver.evaluate("document.querySelector('.drive .more').open = true")
    driver.evaluate("document.querySelector('.drive .handle').scrollIntoView()")
    tip = Tip(scenario)
    first = tip.place
    for _ in range(20):
        begin, seen = tip.place, len(scenario.events["watcher"])
        drawn, rejected = driver.evaluate("irisSession.view.drawn"), driver.evaluate(FEEDBACK)["rejected"]
        with ThreadPoolExecutor(1) as thread:  # what is dragged before the session engages does not count
            drag = thread.submit(driver.drag, ".drive .handle", 100, 0, seconds=DRAG_S)
            tip.watch(drag.done, "the drag ends")
            drag.result()
        tip.watch_for(0.7)
        moved = tip.place - begin
        print(f"moved {1e3 * moved} mm")
        assert moved[0] < 0.055
        assert np.linalg.norm(moved[1:]) < 0.005
        if moved[0] > 0.02 or tip.place[0] - first[0] > 0.02:
            break
        bodies = [event.body for event in scenario.events["watcher"][seen:]]
        held = {b.reason for b in bodies if isinstance(b, EngagementChanged) and not b.engaged}
        is_late = bool(held & LATE) or driver.evaluate(FEEDBACK)["rejected"] != rejected
        assert is_late or driver.evaluate("irisSession.view.drawn") - drawn < 10 * DRAG_S, held
    assert tip.place[0] - first[0] > 0.02
    assert words(driver).startswith("Held. ")


def drag_up(page: Page, tip: Tip, action: Callable[[float, float, str], None], names: tuple[str, str, str]) -> None:
    """Drag the arrow that points up by 30 pixels, until the tip is 3 cm higher.

    `names`: what `action` calls pressing, moving and letting go.
    """
    begin, (x, y) = tip.place, page.find_arrow("z")
    action(x, y, names[0])
    action(x, y - 30, names[1])
    tip.watch(lambda: tip.place[2] - begin[2] > 0.03, "the gripper follows the handle up")
    assert np.linalg.norm(tip.place[:2] - begin[:2]) < 0.005
    assert page.evaluate("irisSession.gizmo.isHeld && irisSession.state.feedback.get('left').hold_reason === ''")
    action(x, y - 30, names[2])
    page.wait("irisSession.state.feedback.get('left').hold_reason === 'clutch_open'")
    assert page.evaluate(PULLED) == 0.0  # they snap back


def take_in_the_picture(page: Page) -> None:
    """Click the left robot where it is drawn, and take it in the menu that opens."""
    join_as(page, "dora", "operator")
    set_view(page)
    assert page.evaluate("irisSession.gizmo.object.visible") is False
    x, y = page.evaluate(f"({FIND_BASE})()")
    page.point(x, y, "down")
    page.point(x, y, "up")
    page.wait("document.querySelector('.robot-menu .name').textContent === 'left'")
    page.evaluate("document.querySelector('.robot-menu button.primary').click()")
    page.wait("irisSession.gizmo.object.visible && document.querySelector('.robot-menu').hidden")
    page.wait("/you/.test(document.querySelector('[data-label=left]').textContent)")


def test_a_robot_is_taken_in_the_picture_and_its_handles_are_grabbed(
    scenario: Scenario, open_page: Callable[..., Page]
) -> None:
    """The robot follows meanwhile, as far as time allows: where the handles are is read in the task that drags them."""
    page = open_page(scenario.server, "handles", width=400, height=480)
    take_in_the_picture(page)
    x, y = page.find_arrow("z")
    *during, is_held, pulled = page.evaluate(f"({DRAG})({x}, {y}, 30)")
    assert during == [True, pytest.approx(0.2, abs=0.05)]
    assert (is_held, pulled) == (False, 0.0)  # they snap back
    assert page.errors == []


@pytest.mark.long
def test_the_handles_drive_the_robot(scenario: Scenario, open_page: Callable[..., Page]) -> None:
    page = open_page(scenario.server, "handles", width=400, height=480)
    take_in_the_picture(page)
    drag_up(page, Tip(scenario), page.point, ("down", "", "up"))
    assert page.errors == []


@pytest.mark.long
def test_one_finger_drives_on_a_phone(scenario: Scenario, open_page: Callable[..., Page]) -> None:
    page = open_page(scenario.server, "phone", width=390, height=844, phone=True)
    join_as(page, "dora", "operator")
    page.click("button", "Take: left")
    page.wait("irisSession.gizmo.object.visible")
    set_view(page)
    drag_up(page, Tip(scenario), page.touch, ("touchStart", "touchMove", "touchEnd"))
    bottom, top = page.evaluate(
        "['.drive', '#panel-robots'].map((one) => document.querySelector(one).getBoundingClientRect())"
        ".map(({ top, bottom }, i) => (i ? top : bottom))"
    )
    assert bottom <= top  # the panel does not cover the lists
    assert page.errors == []


# --- recording cameras ------------------------------------------------------------------------------------------------


@pytest.fixture
def close_scenario(serve: Callable[..., SessionProcess], tmp_path: Path) -> Iterator[Scenario]:
    """A session of the handover scene with one more camera."""
    scene = tmp_path / "scene.xml"
    text = scene_path("handover").read_text()
    scene.write_text(text.replace("<camera", f"{CLOSE}\n    <camera", 1))
    shutil.copy(scene_path("handover").with_name("arm.xml"), tmp_path)
    made = Scenario(serve(str(scene)))
    yield made
    made.close()


def read_panel(page: Page, camera: str, path: Path) -> NDArray[np.uint8]:
    """Return the pixels of a camera's panel, as they are on the screen."""
    page.screenshot(path)
    box: dict[str, Any] = page.evaluate(
        f"(({{x, y, width, height}}) => ({{x, y, width, height}}))(document.querySelector("
        f"'[data-camera={camera}] .place').getBoundingClientRect())"
    )
    with Image.open(path) as picture:
        cut = picture.convert("RGB").crop((box["x"], box["y"], box["x"] + box["width"], box["y"] + box["height"]))
    return np.asarray(cut.resize((160, 120)))


@pytest.mark.long
def test_a_panel_shows_what_its_camera_sees(
    close_scenario: Scenario, open_page: Callable[..., Page], tmp_path: Path
) -> None:
    page = open_page(close_scenario.server, "cameras")
    join_as(page, "dora", "operator")
    page.evaluate("document.querySelector('.menu').open = true")
    page.check("close")
    page.evaluate("document.querySelector('.menu').open = false")
    page.wait("irisSession.view.pictures.pictures.some((one) => !one.isOutdated)")
    time.sleep(0.5)  # two more frames
    shown = read_panel(page, "close", tmp_path / "page.png")
    page.evaluate("irisSession.view.viewpoint.choose(0)")
    picture = decode_picture(page.evaluate("irisSession.view.capture(160, 120, false)"))
    page.evaluate("irisSession.view.viewpoint.choose(-1)")
    difference = np.abs(shown.astype(int) - picture).mean()
    print(f"mean difference of the panel to the picture of its camera: {difference:.1f} of 255")
    assert picture.std() > 20.0
    assert difference < 8.0
    assert page.errors == []


@pytest.mark.long
def test_a_gripper_that_leaves_a_picture_is_warned_of(close_scenario: Scenario, open_page: Callable[..., Page]) -> None:
    outside = "document.querySelector('[data-camera=close] .outside').textContent"
    page = open_page(close_scenario.server, "cameras")
    join_as(page, "dora", "operator")
    page.evaluate("document.querySelector('.menu').open = true")
    page.check("close")
    page.evaluate("document.querySelector('.menu').open = false")
    start_driving(page)
    tip = Tip(close_scenario)
    middle = float(tip.place[2])

    def hold(key: str) -> None:
        page.hold("Shift")
        page.hold(key)

    def let_go(key: str) -> None:
        page.let_go(key)
        page.let_go("Shift")

    def drive_to(key: str, condition: Callable[[float], bool]) -> None:
        def is_there() -> bool:
            return condition(float(tip.place[2]) - middle)

        drive_until(page, tip, is_there, lambda: hold(key), lambda: let_go(key))
        let_go(key)
        tip.watch_for(1.0)
        wait_for_samples(tip, page)

    drive_to("r", lambda height: height > 0.045)
    while tip.place[2] - middle > 0.08:  # the key was let go late
        drive_to("f", lambda height: height < 0.07)
    assert page.evaluate(outside) == ""
    drive_to("r", lambda height: height > 0.09)  # the edge is 88 mm above the middle, the margin 4 mm
    page.wait(f"{outside} === 'Outside this picture: the gripper of left'")
    drive_to("f", lambda height: height < 0.06)
    page.wait(f"{outside} === ''")
    page.reload()
    page.wait_until_ready()
    page.wait("document.querySelector('[data-camera=close]')")  # remembered
    assert page.errors == []
