"""Look at recordings as a person does: in Rerun's viewer, without a display, and check what is seen.

    python tools/look_at_recordings.py sessions/*/session.rrd
    python tools/look_at_recordings.py session.rrd --pictures looks     keeps the pictures: first, middle and last time

Of each session the file is opened that `iris-session view` opens: the recording, or its copy of all parts. Checked is
that Rerun finds the file whole, that no view reports an error at the first, middle and last time nor in any tab, that
the 3D picture is not empty at the first time, and that the bodies that move fill enough of its width then. Needs a
Vulkan driver (Debian: `mesa-vulkan-drivers`); `rerun viewer-mcp` lets programs control the viewer.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import re
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Final, NamedTuple, Self

import cv2
import numpy as np
from numpy.typing import NDArray

from iris_session.journal.errors import RecordingError
from iris_session.recording.viewer_export import open_view_file
from iris_session.rrd.file import read_chunks
from iris_session.rrd.paths import STATE_ENTITIES
from iris_session.rrd.rerun_tool import find_rerun, make_environment
from iris_session.viewer.blueprint import BACKGROUND

HOST: Final = "127.0.0.1"
SIZE: Final = "1600x1000"
START_S: Final = 60.0
#: Until a file is read, and until the picture of a time is complete [s]: drawn in software on a busy machine.
LOAD_S: Final = 120.0
SETTLE_S: Final = 120.0
#: Frames that the viewer draws between two looks, and equal pictures in a row of one that is complete.
FRAMES: Final = 3
EQUAL: Final = 3
#: Frames that a tab is shown for.
TAB_FRAMES: Final = 10
SESSION_TIME: Final = "session_time"
#: Of 255: a pixel that differs by more shows something.
DIFFERENT: Final = 12
#: Least share of the pixels that show something, and of the width that the bodies that move take.
LEAST_FILLED: Final = 0.05
LEAST_WIDTH: Final = 0.4

Image = NDArray[np.uint8]


class MissingViewerError(Exception):
    """The viewer does not run on this machine. The text is one line, with what to do."""


class ViewerError(Exception):
    """The viewer ended, did not answer, or refused a call."""


class Look(NamedTuple):
    """Result of looking at a recording.

    `filled`: share of the pixels of the 3D view that show something at the first time. `width`: share of its width that
    the bodies that move take then. `problems`: one line each; empty if all is well.
    """

    path: Path
    filled: float
    width: float
    problems: tuple[str, ...]


class HeadlessViewer:
    """Rerun's viewer with one file, without a window, and its control.

    Raises:
        MissingViewerError: There is no Vulkan driver.
        ViewerError: The viewer did not start.
    """

    def __init__(self, path: Path) -> None:
        tool = find_rerun()
        with contextlib.closing(socket.socket()) as free:
            free.bind((HOST, 0))
            port = free.getsockname()[1]
        self._folder = tempfile.TemporaryDirectory(prefix="look-")
        self._words = Path(self._folder.name, "words")
        self._calls = 0
        command = [tool, "--headless", str(path), "--port", str(port), "--bind", HOST, "--window-size", SIZE]
        with self._words.open("wb") as words:
            self._viewer = subprocess.Popen(
                command, stdin=subprocess.DEVNULL, stdout=words, stderr=words, env=make_environment()
            )
        self._control = subprocess.Popen(
            [tool, "viewer-mcp"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
            env=make_environment(),
        )
        try:
            self._connect(port)
        except BaseException:
            self.close()
            raise

    def _connect(self, port: int) -> None:
        client = {"name": "look_at_recordings", "version": "1"}
        self._request("initialize", {"protocolVersion": "2025-06-18", "capabilities": {}, "clientInfo": client})
        self._send({"method": "notifications/initialized"})
        deadline = time.monotonic() + START_S
        while True:
            try:
                self.call("rerun_connect", endpoint=f"http://{HOST}:{port}")
            except ViewerError as error:
                if self._viewer.poll() is not None:
                    self._raise_ended()
                if time.monotonic() > deadline:
                    raise ViewerError(f"the viewer did not listen within {START_S:g} s: {error}") from error
                time.sleep(0.1)
            else:
                return

    def _raise_ended(self) -> None:
        words = " ".join(self._words.read_text(errors="replace").split())
        if found := re.search(r"[^.:]{0,80}(adapter|vulkan|wgpu|render context)[^.:]{0,80}", words, re.IGNORECASE):
            raise MissingViewerError(f"no Vulkan for Rerun's viewer (Debian: mesa-vulkan-drivers): {found[0].strip()}")
        raise ViewerError(f"the viewer ended: {words[:600]}")

    def _send(self, message: Mapping[str, Any]) -> None:
        assert self._control.stdin is not None
        self._control.stdin.write(json.dumps({"jsonrpc": "2.0", **message}) + "\n")
        self._control.stdin.flush()

    def _request(self, method: str, parameters: Mapping[str, Any]) -> Any:
        assert self._control.stdout is not None
        self._calls += 1
        self._send({"id": self._calls, "method": method, "params": parameters})
        for line in self._control.stdout:
            answer = json.loads(line)
            if answer.get("id") == self._calls:
                if "error" in answer:
                    raise ViewerError(f"{method}: {answer['error']}")
                return answer["result"]
        raise ViewerError("`rerun viewer-mcp` ended")

    def call(self, tool: str, **arguments: Any) -> Any:
        """Call a tool of the viewer's control. Return its JSON, or text."""
        result = self._request("tools/call", {"name": tool, "arguments": arguments})
        texts = [one["text"] for one in result.get("content", ()) if one.get("type") == "text"]
        if result.get("isError"):
            raise ViewerError(f"{tool}: {' '.join(texts)[:600]}")
        with contextlib.suppress(ValueError, IndexError):
            return json.loads(texts[0])
        return texts[0] if texts else ""

    def get_state(self) -> dict[str, Any]:
        """Return what the viewer shows: recordings with their timelines, and views with their reports."""
        state: dict[str, Any] = self.call("rerun_get_state")
        return state

    def wait_until_loaded(self) -> dict[str, Any]:
        """Wait until the recording and its views are there. Return the state."""

        def load() -> dict[str, Any] | None:
            state = self.get_state()
            return state if state.get("recordings") and state.get("views") and not state.get("loading") else None

        return self._wait(load, LOAD_S, "the recording is loaded")

    def _wait(self, poll: Callable[[], Any], timeout_s: float, what: str) -> Any:
        deadline = time.monotonic() + timeout_s
        while not (found := poll()):
            if self._viewer.poll() is not None:
                self._raise_ended()
            if time.monotonic() > deadline:
                raise ViewerError(f"not within {timeout_s:g} s: {what}")
            self.call("wait_for", min_steps=FRAMES, timeout_secs=30)
        return found

    def set_time(self, time_ns: int) -> None:
        """Show a session time."""
        self.call(
            "rerun_set_time_cursor",
            timeline={"name": SESSION_TIME},
            time={"time": time_ns},
            play_state="PLAY_STATE_PAUSED",
        )

    def set_blueprint(self, changes: Mapping[str, Any]) -> None:
        """Change some fields of the arrangement of views."""
        self.call("rerun_set_blueprint", json=json.dumps(changes), recording={}, mode="partial")

    def take_picture(self, view: str = "", is_ready: Callable[[Image], bool] = lambda image: True) -> Image:
        """Return the picture of a view, or of the whole window, when it does not change any more: (h, w, 3), BGR.

        `is_ready`: whether a picture may be complete; data are read while others are drawn.
        """
        options = {"view_id": view} if view else {}
        last: list[Image] = []
        found = {"refused": 0, "changed": 0, "not ready": 0}

        def settle() -> bool:
            path = Path(self._folder.name, "picture.png")
            try:
                self.call("rerun_save_screenshot", file_path=str(path), max_size=0, **options)
            except ViewerError:  # on a busy machine it is not drawn within the time that the viewer allows
                found["refused"] += 1
                return False
            image = np.asarray(cv2.imread(str(path)), np.uint8)
            if last and (last[-1].shape != image.shape or (last[-1] != image).any()):
                found["changed"] += 1
                last.clear()
            last.append(image)
            if len(last) >= EQUAL and not is_ready(image):
                found["not ready"] += 1
                return False
            return len(last) >= EQUAL

        self.call("wait_for", min_steps=FRAMES, timeout_secs=30)
        try:
            self._wait(settle, SETTLE_S, "the picture is complete")
        except ViewerError as error:
            counts = ", ".join(f"{n} {kind}" for kind, n in found.items())
            raise ViewerError(f"{error} (pictures of {view or 'the window'}: {counts})") from error
        return last[-1]

    def close(self) -> None:
        """End the viewer."""
        for process in (self._control, self._viewer):
            process.kill()
            process.wait()
        assert self._control.stdin is not None
        assert self._control.stdout is not None
        with contextlib.suppress(BrokenPipeError):
            self._control.stdin.close()
        self._control.stdout.close()
        self._folder.cleanup()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def look_at(path: Path, pictures: Path | None = None) -> Look:
    """Open a recording as `iris-session view` does, and check what is seen.

    Args:
        path: A file of the session.
        pictures: Folder for pictures of the window at the first, middle and last time.

    Raises:
        MissingViewerError: There is no Vulkan driver.
        RecordingError: Nothing of the session can be read.
    """
    with open_view_file(path) as shown:
        problems = list(check_file(shown.path))
        with HeadlessViewer(shown.path) as viewer:
            return _look(viewer, path, shown.path, pictures, problems)


def check_file(path: Path) -> Iterator[str]:
    """Yield what `rerun rrd verify` finds, a line each."""
    command = [find_rerun(), "rrd", "verify", str(path)]
    done = subprocess.run(command, capture_output=True, text=True, env=make_environment(), check=False)
    if done.returncode:
        yield f"rerun rrd verify: {' '.join((done.stderr or done.stdout).split())[-300:]}"


def _look(viewer: HeadlessViewer, path: Path, shown: Path, pictures: Path | None, problems: list[str]) -> Look:
    state = viewer.wait_until_loaded()
    timeline = next(t for t in state["recordings"][0]["timelines"] if t["timeline"]["name"] == SESSION_TIME)
    begin_ns, end_ns = (int(timeline["time_range"][end]) for end in ("start", "end"))
    if int(timeline.get("current_time", {}).get("time", begin_ns)) != begin_ns:
        problems.append("it does not open at its first time")
    scene = next(view["view_id"] for view in state["views"] if view["class"] == "3D")
    first: Image | None = None
    for name, time_ns in (("first", begin_ns), ("middle", (begin_ns + end_ns) // 2), ("last", end_ns)):
        if time_ns != begin_ns:  # it opens at the first
            viewer.set_time(time_ns)
        if first is None:
            first = _take_first(viewer, scene)
        picture = viewer.take_picture()
        if pictures is not None:
            pictures.mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(pictures / f"{name}.png"), picture)
        problems += _list_reports(viewer, f"at the {name} time")
    assert first is not None
    problems += _look_at_tabs(viewer)
    viewer.set_time(begin_ns)
    filled = float(_find_shown(first).mean())
    width = _measure_width(viewer, scene, list_moving(shown), first)
    if filled < LEAST_FILLED:
        problems.append(f"the 3D picture is empty at the first time: {filled:.1%} of it show something")
    if width < LEAST_WIDTH:
        problems.append(f"the bodies that move fill {width:.0%} of the width of the 3D view, not {LEAST_WIDTH:.0%}")
    return Look(path, filled, width, tuple(dict.fromkeys(problems)))


def _list_reports(viewer: HeadlessViewer, when: str) -> Iterator[str]:
    """Yield what the views report now."""
    for view in viewer.get_state()["views"]:
        for report in view.get("reports", ()):
            yield f"view {view['name']!r} {when}: {json.dumps(report)[:300]}"


def _look_at_tabs(viewer: HeadlessViewer) -> Iterator[str]:
    """Show every tab once, and yield what the views in them report."""
    entities = json.loads(viewer.call("rerun_get_blueprint", recording={})["json"])
    containers = {
        path: one["ContainerBlueprint"]["contents"]
        for path, one in entities.items()
        if "Tabs" in str(one.get("ContainerBlueprint", {}).get("container_kind", ""))
    }
    for i in range(max(map(len, containers.values()), default=0)):
        chosen = {
            path: {"ContainerBlueprint": {"active_tab": [contents[i]]}}
            for path, contents in containers.items()
            if i < len(contents)
        }
        viewer.set_blueprint(chosen)
        viewer.call("wait_for", min_steps=TAB_FRAMES, timeout_secs=30)
        yield from _list_reports(viewer, f"in tab {i + 1}")


def _take_first(viewer: HeadlessViewer, scene: str) -> Image:
    """Return the 3D picture when it shows something, or an empty one if it does not."""
    try:
        return viewer.take_picture(scene, lambda image: float(_find_shown(image).mean()) >= LEAST_FILLED)
    except ViewerError:
        return viewer.take_picture(scene)


def _measure_width(viewer: HeadlessViewer, scene: str, moving: Sequence[str], first: Image) -> float:
    """Return the share of the width of the 3D view that bodies that move take, by hiding all others."""
    if not moving:
        return 0.0
    query = [f"+ {entity}/**" for entity in moving]
    viewer.set_blueprint({f"/view/{scene}/ViewContents": {"ViewContents": {"query": query}}})
    bodies = viewer.take_picture(scene, lambda image: image.shape == first.shape and bool((image != first).any()))
    columns = np.flatnonzero(_find_shown(bodies).sum(axis=0) > 1)
    return float(columns[-1] - columns[0] + 1) / bodies.shape[1] if len(columns) else 0.0


def list_moving(path: Path) -> list[str]:
    """Return the entities of the bodies that move."""
    found: set[str] = set()
    for chunk in read_chunks(str(path), (STATE_ENTITIES,)):
        for names in chunk.to_record_batch().column("bodies").to_pylist():
            found.update(filter(None, names))
    return sorted(found)


def _find_shown(image: Image) -> NDArray[np.bool_]:
    """Return where a 3D picture shows something, shape (height, width)."""
    found: NDArray[np.bool_] = np.abs(image.astype(np.int16) - BACKGROUND[::-1]).max(axis=2) > DIFFERENT
    return found


def main() -> int:
    """Run the command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recordings", type=Path, nargs="+", metavar="RECORDING")
    parser.add_argument("--pictures", type=Path, metavar="FOLDER", help="keep pictures, a folder for each recording")
    options = parser.parse_args()
    status = 0
    for path in options.recordings:
        folder = options.pictures
        if folder is not None and len(options.recordings) > 1:
            folder = folder / f"{path.parent.name}-{path.stem}"
        try:
            look = look_at(path, folder)
        except MissingViewerError as error:
            print(error, file=sys.stderr)
            return 2
        except (RecordingError, ViewerError) as error:
            print(f"{path}: {error}", file=sys.stderr)
            status = 1
            continue
        print(f"{path}: {look.filled:.0%} of the 3D picture show something, bodies that move fill {look.width:.0%}")
        for problem in look.problems:
            print(f"  {problem}")
        status = status or int(bool(look.problems))
    return status


if __name__ == "__main__":
    sys.exit(main())
