"""Pictures of the page for the documentation: the dashboard on a desktop and on a phone, and AR.

    python tools/page_screenshots.py docs/img

Starts `iris-session demo handover`, opens its page in Chromium, waits until the operators hold their robots, and writes
`dashboard.png` and `dashboard-phone.png`. Then a session in which a person with an emulated Quest 3 and one at a desk
hold a robot each: `ar.png` and `vr.png` are what the headset shows; with `ar.png` a real one shows the room behind it.
Then a person at a desk and one with a phone, in every state that people meet, and a scene of one's own: those of the
documentation beside the others, which are in `states`, to be looked at. Pictures of the documentation have six bits for
each colour, so that the repository stays small. Needs the built page (`make web`) and Chromium (Debian: `chromium`).
"""

from __future__ import annotations

import argparse
import math
import re
import signal
import subprocess
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, Final

from PIL import Image

from anchors.pose import PoseTuple, Vec3, quat_from_rotvec, quat_from_yaw, quat_mul
from tests.e2e.browser import Browser, Page, join_as, printed_address
from tests.e2e.emulated_quest import HEADSET, INSTALL, IWER, T_WORLD_TRACKING, EmulatedQuest, aim_at
from tests.e2e.scenario import Scenario
from tests.e2e.session_process import COMMAND, SessionProcess, kill_all, make_serve_command
from tests.scene.arm import write_arm

START_S: Final = 90.0
#: After both robots are held: until hands are at work [s].
SETTLE_S: Final = 8.0
BOTH_HELD: Final = "[...document.querySelectorAll('[data-robot] .holder')].every((one) => one.textContent !== 'free')"


def wait_for_address(output: Path, process: subprocess.Popen[bytes]) -> str:
    """Return the address of the page that the demo prints. Raises `SystemExit`."""
    deadline = time.monotonic() + START_S
    while time.monotonic() < deadline and process.poll() is None:
        match = re.search(r"in a browser: (https?://\S+)", output.read_text(errors="replace"))
        if match:
            return match.group(1)
        time.sleep(0.1)
    raise SystemExit(f"the demo printed no address of a page:\n{output.read_text(errors='replace')[-2000:]}")


#: Pictures of the documentation.
PICTURES: Final = ("dashboard", "dashboard-phone", "ar", "vr", "driving", "phone-driving")
#: Where the person with the headset stands, and where she looks.
HEAD_WORLD: Final[Vec3] = (0.1, -1.0, 0.85)
LOOKED_AT_WORLD: Final[Vec3] = (0.12, 0.0, 0.3)
LEFT_HAND_WORLD: Final[Vec3] = (-0.2, -0.55, 0.4)
#: The emulator shows the page where a headset shows the room.
HIDE_PAGE: Final = (
    "document.body.style.visibility = 'hidden', document.querySelector('canvas').style.visibility = 'visible',"
    " document.documentElement.style.background = '#59606b'"
)


def look_at(p_world: Vec3, target_world: Vec3) -> PoseTuple:
    """Return the pose of a head at `p_world` that looks at a point: x is forward, z up."""
    x, y, z = (b - a for a, b in zip(p_world, target_world, strict=True))
    pitch = quat_from_rotvec((0.0, math.atan2(-z, math.hypot(x, y)), 0.0))
    return p_world, quat_mul(quat_from_yaw(math.atan2(y, x)), pitch)


def shoot_demo(browser: Browser, scratch: Path, picture: Path, **size: Any) -> None:
    """Write a picture of the page while the operators of a demo are at work. Raises `SystemExit` if they had ended."""
    output = scratch / f"{picture.stem}.out"
    command = [*COMMAND, "demo", "handover", "--timeout", "240", "--record", str(scratch / f"{picture.stem}.rrd")]
    with output.open("wb") as out:
        process = subprocess.Popen(command, stdout=out, stderr=subprocess.STDOUT)
    try:
        page = browser.open(picture.stem, wait_for_address(output, process), **size)
        page.wait_until_ready()
        page.wait(BOTH_HELD, 200.0)  # they try again where a busy machine has made them fail
        time.sleep(SETTLE_S)
        page.screenshot(picture)
        if not page.evaluate(f"irisSession.state.phase.phase === 'ready' && {BOTH_HELD}"):
            raise SystemExit(f"{picture}: the demo ended before the picture was made; do nothing else on this machine")
        page.close()
    finally:
        process.terminate()
        process.wait()


def shoot_headset(browser: Browser, scratch: Path, picture: Path, mode: str) -> None:
    """Write a picture of what an operator in AR or VR sees: her robot, and another person at work."""
    recording = scratch / f"{picture.stem}.rrd"
    session = SessionProcess(scratch, recording, make_serve_command("handover", recording))
    scenario = Scenario(session)
    try:
        page = browser.open(
            picture.stem, printed_address(session), width=1280, height=720, before=[IWER.read_text(), INSTALL]
        )
        page.wait_until_ready()
        join_as(page, "eve", "operator")
        quest = EmulatedQuest(scenario, page)
        ben = scenario.drive("ben", "right")
        eve = quest.person.id
        quest.host.assign(["left"], eve)
        quest.enter(f"Enter {mode}")
        quest.place("quest", look_at(HEAD_WORLD, LOOKED_AT_WORLD))
        tip = quest.host.scene.tip_pose("left")
        assert tip
        quest.place("quest.controllers.right", aim_at(tip[0], 0.45))
        quest.place("quest.controllers.left", look_at(LEFT_HAND_WORLD, LOOKED_AT_WORLD))
        scenario.run_for(1.0)  # a headset that jumps is not aligned any more
        quest.host.alignment.place(eve, T_WORLD_TRACKING)
        quest.wait(f"{HEADSET}.showsScene")
        quest.evaluate(HIDE_PAGE)
        ben.velocity = (0.0, 0.02, 0.0)
        scenario.run_for(SETTLE_S)
        quest.in_page(lambda: page.screenshot(picture), "the picture is made")
        quest.host.control("pause")
        quest.wait("irisSession.state.pause !== null")
        scenario.run_for(1.0)
        paused = picture.parent / "states" / f"{picture.stem}-paused.png"
        quest.in_page(lambda: page.screenshot(paused), "the picture of the pause is made")
        quest.close()
        page.close()
    finally:
        scenario.close()
        kill_all([session])


#: How far an arrow is dragged on the desk, and on the phone [pixels].
DRAG_PX, PHONE_DRAG_PX = 50.0, 25.0
OPEN_MENU: Final = "document.querySelector('[data-label=left]').click()"
ENGAGED: Final = "document.querySelector('.drive.engaged')"
TAKE: Final = "document.querySelector('.robot-menu button.primary').click()"


def shoot_states(browser: Browser, scratch: Path, folder: Path) -> None:
    """Write pictures of a desk and of a phone: first view, menu, driving by the handles, paused, stopped."""
    session = SessionProcess(scratch, scratch / "states.rrd", make_serve_command("handover", scratch / "states.rrd"))
    scenario = Scenario(session)
    states = folder / "states"
    with ThreadPoolExecutor(1) as thread:

        def do(*actions: Callable[[], object]) -> None:
            """Do something in a page while the other participant is polled; then let the page settle."""
            for action in actions:
                job = thread.submit(action)
                scenario.run_until(job.done, "the page has done it")
                job.result()
                scenario.run_for(1.0)

        try:
            url = printed_address(session)
            ann = scenario.join("ann", "director")
            ann.acquire(["right"])
            desk = browser.open("desk", url, width=1280, height=800)
            do(desk.wait_until_ready, lambda: desk.screenshot(states / "first.png"))
            do(lambda: join_as(desk, "ben", "director"), lambda: desk.evaluate(OPEN_MENU))
            do(lambda: desk.screenshot(states / "menu.png"), lambda: desk.evaluate(TAKE))
            do(lambda: desk.wait("irisSession.gizmo.object.visible"), lambda: desk.screenshot(states / "taken.png"))
            x, y = desk.find_arrow("z")
            do(lambda: desk.point(x, y, "down"), lambda: desk.point(x, y - DRAG_PX), lambda: desk.wait(ENGAGED))
            do(lambda: desk.screenshot(folder / "driving.png"), lambda: desk.point(x, y - DRAG_PX, "up"))
            ann.control("pause")
            scenario.run_for(1.0)
            do(lambda: desk.screenshot(states / "paused.png"))
            ann.control("resume")
            ann.estop("a hand is near the gripper")
            scenario.run_for(1.0)
            do(lambda: desk.screenshot(states / "stopped.png"))
            ann.clear_estop()
            ann.assign(["left"])  # a closed tab keeps its robot for a while
            desk.close()
            phone = browser.open("phone", url, width=390, height=844, phone=True)
            do(phone.wait_until_ready, lambda: phone.screenshot(states / "phone-first.png"))
            do(lambda: join_as(phone, "eve", "operator"), lambda: phone.evaluate(OPEN_MENU))
            do(lambda: phone.screenshot(states / "phone-menu.png"), lambda: phone.evaluate(TAKE))
            do(lambda: phone.wait("irisSession.gizmo.object.visible"))
            px, py = phone.find_arrow("z")
            do(lambda: phone.touch(px, py, "touchStart"), lambda: phone.touch(px, py - PHONE_DRAG_PX, "touchMove"))
            do(lambda: phone.wait(ENGAGED), lambda: phone.screenshot(folder / "phone-driving.png"))
            phone.close()
            last = browser.open("last", url, width=1280, height=800)
            do(last.wait_until_ready)
            shoot_end(session, last, states / "ended.png")
        finally:
            scenario.close()
            kill_all([session])


def shoot_end(session: SessionProcess, page: Page, picture: Path) -> None:
    """End a session as its owner does, and write a picture of what a page says of it."""
    session.process.send_signal(signal.SIGINT)
    session.process.wait()
    page.wait("irisSession.state.phase.ended")
    time.sleep(1.0)
    page.screenshot(picture)
    page.close()


def shoot_own_scene(browser: Browser, scratch: Path, picture: Path) -> None:
    """Write a picture of the page as it shows a file that is no simulation: a robot arm as a URDF."""
    arm = write_arm(scratch)
    recording = scratch / "own.rrd"
    session = SessionProcess(scratch, recording, make_serve_command(str(arm), recording))
    try:
        page = browser.open("own", printed_address(session), width=1280, height=800)
        page.wait("irisSession.view.scene && irisSession.state.session?.synced")
        page.evaluate("irisSession.view.scene.complete.then(() => null)")
        time.sleep(2.0)  # until the picture is drawn, and the advice of the session is there
        page.screenshot(picture)
        page.close()
    finally:
        kill_all([session])


def shrink(picture: Path) -> None:
    """Write a picture anew with six bits for each colour: two thirds of the size, and no difference to the eye."""
    with Image.open(picture) as image:
        image.convert("RGB").point(lambda value: value & 0xFC).save(picture, optimize=True)


def main() -> None:
    """Run the command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="where to write the pictures")
    folder = parser.parse_args().folder.resolve()
    with tempfile.TemporaryDirectory() as scratch:
        browser = Browser()
        try:
            shoot_demo(browser, Path(scratch), folder / "dashboard.png", width=1280, height=800)
            shoot_demo(browser, Path(scratch), folder / "dashboard-phone.png", width=390, height=844, phone=True)
            shoot_headset(browser, Path(scratch), folder / "ar.png", "AR")
            shoot_headset(browser, Path(scratch), folder / "vr.png", "VR")
            shoot_states(browser, Path(scratch), folder)
            shoot_own_scene(browser, Path(scratch), folder / "states" / "own.png")
        finally:
            browser.close()
    for picture in PICTURES:
        shrink(folder / f"{picture}.png")


if __name__ == "__main__":
    main()
