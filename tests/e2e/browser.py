"""A real Chromium for tests, driven by a Node process with playwright-core (`web_client/tests/browser/driver.mjs`)."""

from __future__ import annotations

import base64
import io
import json
import re
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from iris_session.bench.web_tab import BrowserError, BrowserTools, Chromium, MissingToolError, find_tools
from tests.e2e.session_process import DEADLINE_S, END_WITH_PARENT, SessionProcess, skip_unless_ci, wait_until

#: Returns the middle of an arrow of the handles [pixels]: their size in the picture does not depend on the distance.
FIND_ARROW = """(axis) => {
  const { gizmo, view } = irisSession;
  const { camera } = view.viewpoint;
  const at = gizmo.pivot.getWorldPosition(gizmo.pivot.position.clone());
  const height = at.distanceTo(camera.position) * Math.tan((camera.fov * Math.PI) / 360);
  const length = 0.8 * 1.9 / 8 * gizmo.mover.size * height;
  const direction = { x: [0, 0, -1], y: [-1, 0, 0], z: [0, 1, 0] }[axis];
  const { x, y } = at.add(at.clone().set(...direction).multiplyScalar(length)).project(camera);
  const box = document.querySelector("#scene").getBoundingClientRect();
  return [box.x + ((1 + x) / 2) * box.width, box.y + ((1 - y) / 2) * box.height];
}"""


def require_browser() -> BrowserTools:
    """Return the paths of Node and Chromium; skip the test, or fail in CI, without them and the built page."""
    try:
        return find_tools()
    except MissingToolError as error:
        skip_unless_ci(str(error))
        raise


class Browser(Chromium):
    """One Chromium. Its pages are addressed by names; each has an identity of its own unless `like` says otherwise."""

    def __init__(self) -> None:
        super().__init__(require_browser(), END_WITH_PARENT)

    def open(self, page: str, url: str, **options: Any) -> Page:
        """Open a page by its address."""
        self.call("open", page, url=url, **options)
        return Page(self, page)


class Page:
    """One tab. Controls are found by their role and accessible name, as a screen reader finds them."""

    def __init__(self, browser: Browser, name: str) -> None:
        self._browser = browser
        self.name = name

    def evaluate(self, script: str) -> Any:
        """Return the JSON value of an expression, or of the promise that it is."""
        return self._browser.call("evaluate", self.name, script=script)

    def wait(self, script: str, timeout_s: float = DEADLINE_S) -> None:
        """Wait until an expression is true. Fail with the state of the page."""
        try:
            self._browser.call("wait", self.name, script=script, timeout_ms=1000 * timeout_s)
        except BrowserError as error:
            raise AssertionError(f"{error}\n{self.describe()}") from error

    def click(self, role: str, name: str) -> None:
        """Click a control."""
        self._browser.call("click", self.name, role=role, name=name, timeout_ms=1000 * DEADLINE_S)

    def fill(self, label: str, text: str) -> None:
        """Fill in a field."""
        self._browser.call("fill", self.name, label=label, text=text, timeout_ms=1000 * DEADLINE_S)

    def select(self, label: str, text: str) -> None:
        """Choose an option by its text."""
        self._browser.call("select", self.name, label=label, text=text, timeout_ms=1000 * DEADLINE_S)

    def check(self, name: str) -> None:
        """Check a box."""
        self._browser.call("check", self.name, name=name, timeout_ms=1000 * DEADLINE_S)

    def press(self, key: str) -> None:
        """Press a key, such as `Tab` or `Shift+Space`, wherever the focus is."""
        self._browser.call("press", self.name, key=key)

    def hold(self, key: str) -> None:
        """Press a key and keep it pressed."""
        self._browser.call("hold", self.name, key=key)

    def let_go(self, key: str) -> None:
        """End the press of a key."""
        self._browser.call("let_go", self.name, key=key)

    def drag(self, selector: str, x: float, y: float, *, seconds: float) -> None:
        """Press the mouse on an element, move it by (x, y) [pixels] within `seconds`, and let it go."""
        steps = max(1, round(20 * seconds))
        step_ms = 1e3 * seconds / steps
        self._browser.call("drag", self.name, selector=selector, x=x, y=y, steps=steps, step_ms=step_ms)

    def find_arrow(self, axis: str) -> tuple[float, float]:
        """Return where the arrow of an axis of the world is [pixels] that stands at the gripper of the own robot."""
        x, y = self.evaluate(f"({FIND_ARROW})({json.dumps(axis)})")
        return x, y

    def point(self, x: float, y: float, action: str = "") -> None:
        """Move the mouse to a place of the page [pixels]; `action`: "down" or "up" there."""
        self._browser.call("point", self.name, x=x, y=y, action=action)

    def touch(self, x: float, y: float, action: str) -> None:
        """Put a finger at a place of the page [pixels]: "touchStart", "touchMove" or "touchEnd"."""
        self._browser.call("touch", self.name, x=x, y=y, action=action)

    def screenshot(self, path: Path, *, full: bool = False) -> None:
        """Write a PNG of the page."""
        path.parent.mkdir(parents=True, exist_ok=True)
        self._browser.call("screenshot", self.name, path=str(path), full=full)

    def inject(self, path: Path) -> None:
        """Load a script of the disk into the page."""
        self.evaluate(path.read_text())

    def reload(self) -> None:
        """Load the page anew."""
        self._browser.call("reload", self.name)

    def stand_still(self, seconds: float) -> None:
        """Let nothing run on the main thread for a while. The worker runs on, as in a tab in the background."""
        self._browser.call("stand_still", self.name, ms=1000 * seconds)

    def close(self) -> None:
        """Close the tab."""
        self._browser.call("close", self.name)

    @property
    def errors(self) -> list[str]:
        """Errors of the page and failed requests since it was opened."""
        found: list[str] = self._browser.call("log", self.name)
        return found

    def wait_until_ready(self) -> None:
        """Wait until the page has joined, has state, and shows the whole scene."""
        self.wait("window.irisSession?.state.phase.phase === 'ready' && window.irisSession.state.session?.synced")
        self.wait("window.irisSession.view.shown.poses.length > 0")
        self.evaluate("window.irisSession.view.scene.complete.then(() => null)")

    def read_picture(self, width: int, height: int, *, silhouette: bool) -> dict[str, Any]:
        """Draw the scene once. Return the image (height, width, 3) and what is drawn: bodies, poses, vertices."""
        found: dict[str, Any] = self.evaluate(
            f"""(() => {{
              const {{ view }} = window.irisSession;
              const picture = view.capture({width}, {height}, {json.dumps(silhouette)});
              const {{ bodies, poses, vertices }} = view.shown;
              return {{
                picture, bodies, poses: [...poses],
                vertices: Object.fromEntries([...vertices].map(([name, values]) => [name, [...values]])),
              }};
            }})()"""
        )
        return {**found, "image": decode_picture(found["picture"])}

    def describe(self) -> str:
        """Return what the page says, for the message of a failed test."""
        try:
            state = self.evaluate(
                "({phase: window.irisSession?.state.phase, notices: document.querySelector('.notices')?.innerText,"
                " log: window.irisSession?.state.log.slice(0, 10).map((e) => e.text)})"
            )
        except BrowserError as error:
            return str(error)
        return f"{json.dumps(state, indent=1)}\n{self.errors}"


def printed_address(server: SessionProcess) -> str:
    """Return the address of the page that `serve` prints."""
    wait_until(lambda: "in a browser:" in server.output or server.process.poll() is not None, "the address is printed")
    match = re.search(r"in a browser: (https?://\S+)", server.output)
    assert match, server.output
    return match.group(1)


def join_as(page: Page, name: str, role: str) -> None:
    """Take another name and role, by the form of the page."""
    page.evaluate("document.querySelector('.self').open = true")
    page.fill("Your name", name)
    page.select("Join as", role)
    page.evaluate("document.querySelector('.self button').click()")
    page.wait(f"irisSession.state.self?.name === {json.dumps(name)} && irisSession.state.role === {json.dumps(role)}")
    page.wait("irisSession.state.phase.phase === 'ready'")


def decode_picture(url: str) -> NDArray[np.uint8]:
    """Return the RGB pixels of a PNG data URL."""
    data = base64.b64decode(url.partition(",")[2])
    return np.asarray(Image.open(io.BytesIO(data)).convert("RGB"))
