"""Live view of a running session in the terminal, in a process of its own so that drawing never delays a tick.

`TerminalView` (in the authority's process) writes one JSON line per refresh into a pipe, without ever blocking;
`python -m iris_session.cli.live` reads them and draws: a live table on a terminal, one line per event elsewhere.
"""

from __future__ import annotations

import json
import math
import os
import select
import signal
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING, Any, Final, TextIO

from iris_session.cli.common import to_printable
from iris_session.protocol.names import EpisodeState
from iris_session.system.process import ChildProcess
from iris_session.viewer.narration import DEBUG, EventNarration

if TYPE_CHECKING:
    from rich.console import RenderableType

    from iris_session.protocol.server_messages import EpisodeChanged, Event
    from iris_session.session.session_base import SessionBase

#: Refresh of the display [s].
REFRESH_S: Final = 0.5
#: Longest wait for the display at the end of the session [s].
END_S: Final = 3.0


def format_event(event: Event, text: str) -> str:
    """Return one event, in the words `text`, as one line of printable text."""
    kind = event.body.__struct_config__.tag
    return to_printable(f"{event.session_time * 1e-9:8.2f} s  {kind:20s} {text}")


class TerminalView:
    """Sender of refreshes to the display process.

    Call `update()` often from the session's loop; it sends at most every `REFRESH_S`, and skips refreshes for which the
    display is too slow.
    """

    def __init__(self, session: SessionBase, out: TextIO, title: str, footer: str = "") -> None:
        self._session = session
        self._out = out
        self._title = title
        self._footer = footer
        self._next_s = 0.0
        self._seen = 0
        self._narration = EventNarration()
        self._pipe = -1
        self._pending = b""  # rest of a refresh that did not fit into the pipe: it is sent before the next

    @contextmanager
    def open(self) -> Iterator[Callable[[], None]]:
        """Start the display, yield `update`, and stop the display after the last line."""
        self._out.flush()
        child = ChildProcess("iris_session.cli.live", [self._title, self._footer], stdout=self._out)
        self._pipe = child.stdin_fd
        os.set_blocking(self._pipe, False)
        try:
            yield self.update
        finally:
            self.update(force=True)
            until = time.monotonic() + END_S
            ready = select.poll()  # `select.select` takes no descriptor above 1023
            ready.register(self._pipe, select.POLLOUT)
            while not self._send() and child.is_running and time.monotonic() < until:
                ready.poll(100)
            child.close(exit_s=END_S)  # a terminal that reads nothing must not delay the end of the session

    def update(self, force: bool = False) -> None:
        """Send status and new events to the display."""
        now = time.monotonic()
        if now < self._next_s and not force:
            return
        self._next_s = now + REFRESH_S
        if not self._send():
            return
        fresh = [e for e in self._session.recent_events() if e.event_seq > self._seen]
        narrated = [(event, self._narration.add(event).line) for event in fresh]
        lines = [format_event(event, line.text) for event, line in narrated if line.level != DEBUG]
        status = self._session.status().as_dict()
        status["handovers"] = len(status.get("handovers", ()))  # the list grows with the session
        status["episode"] = describe_episode(self._session.episode, self._session.clock())
        self._pending = json.dumps({"status": status, "events": lines}).encode() + b"\n"
        self._send()
        if fresh:
            self._seen = fresh[-1].event_seq

    def _send(self) -> bool:
        """Write as much as the pipe accepts. Return True if nothing is pending."""
        try:
            while self._pending:
                self._pending = self._pending[os.write(self._pipe, self._pending) :]
        except (BlockingIOError, BrokenPipeError):
            return False
        return True


#: What the live view says of an episode in each state; of a final one, the state.
_EPISODES: Final = {
    EpisodeState.IDLE: "e starts the next one",
    EpisodeState.COUNTDOWN: "begins in {left:.0f} s, d cancels",
    EpisodeState.RUNNING: "is recorded, by {leader}",
    EpisodeState.CONFIRM: "discard it? d confirms within {left:.0f} s",
    EpisodeState.LEFT: "{leader} is disconnected: t takes it over, within {left:.0f} s",
    EpisodeState.CLOSING: "is closing {verdict}",
}


def describe_episode(now: EpisodeChanged | None, now_ns: int) -> str:
    """Return the line about the episode, empty before the first one of a session without a task."""
    if now is None:
        return ""
    left = max(0.0, math.ceil((now.until_ns - now_ns) * 1e-9))
    verdict = now.verdict or "(verdict: e success, f failure, d discard)"
    text = _EPISODES.get(now.state, now.state).format(left=left, leader=now.started_by_name, verdict=verdict)
    count = f", {now.successes} of {now.wanted}" if now.wanted else ""
    task = f"{(now.instruction or now.task).rstrip('.')}: " if now.task else ""
    return f"{task}episode {now.number}{count}: {text}"


def _render_table(title: str, status: dict[str, Any], events: list[str], footer: str = "") -> RenderableType:
    from rich.console import Group
    from rich.panel import Panel
    from rich.table import Table
    from rich.text import Text

    table = Table(expand=True, box=None, padding=(0, 1))
    for column in ("participant", "role", "robots", "alignment (p95 at robot)", "hand to robot"):
        table.add_column(column)
    for row in status["participants"]:
        error = f" {row['alignment_error_m'] * 1e3:.1f} mm" if row["alignment"] == "measured" else ""
        error += " UNCONFIRMED" if (row.get("alignment_report") or {}).get("doubt") else ""
        delays = [f"{status['input_to_ctrl_ms'][r]:.0f} ms" for r in row["holds"] if r in status["input_to_ctrl_ms"]]
        name = f"{row['name']} ({row['id']})" + ("" if row["connected"] else " [offline]")
        cells = (name, row["role"], ", ".join(row["holds"]), row["alignment"] + error, ", ".join(delays))
        table.add_row(*(Text(to_printable(cell)) for cell in cells))  # names are user input, never markup
    late = status["lateness"]
    state = "E-STOP" if status["estop"] else "paused" if status["paused"] else "running"
    line = (
        f"{state}  tick {status['tick']}  late {late.get('late_share', 0.0) * 100:.2f} %  "
        f"lateness p99 {late.get('p99_ms', 0.0):.2f} ms  handovers {status['handovers']}  "
        f"drops {sum(status['drops'].values())}"
    )
    if status.get("episode"):
        line += f"\n{status['episode']}"
    if reason := status.get("pause_reason"):
        line += f"\nphysics stands still: {reason}; `iris-session reset` begins anew"
    for stop in status.get("stops", ()):
        why = f": {stop['reason']}" if stop["reason"] else ""
        line += (
            f"\ne-stop {stop['stop_seq']} by {stop['name'] or 'a connection'}, {stop['age_ns'] * 1e-9:.0f} s ago{why}"
        )
    log = Text("\n".join(events[-8:]), style="dim", no_wrap=True, overflow="ellipsis")
    style = "bold red" if status["estop"] else ""
    return Panel(
        Group(table, Text("\n".join(map(to_printable, line.split("\n"))), style=style), log),
        title=f"{title}  {status['session_time_s']:.1f} s",
        subtitle=footer or None,
    )


def _read_refreshes() -> Iterator[dict[str, Any]]:
    for line in sys.stdin:
        with suppress(ValueError):  # a refresh that was cut because the pipe was full
            yield json.loads(line)


def main(title: str, footer: str = "") -> int:
    """Draw refreshes until standard input ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the session's process decides when this ends
    refreshes = _read_refreshes()
    if sys.stdout.isatty():
        try:
            from rich.live import Live
        except ImportError:
            print("iris-session: no live table without rich: pip install 'iris-session[terminal]'", file=sys.stderr)
        else:
            events: list[str] = []
            with Live(auto_refresh=False) as live:
                for refresh in refreshes:
                    events = (events + refresh["events"])[-8:]
                    live.update(_render_table(title, refresh["status"], events, footer), refresh=True)
            return 0
    for refresh in refreshes:
        for line in refresh["events"]:
            print(line, flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:3]))
