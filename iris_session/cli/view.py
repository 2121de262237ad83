"""`iris-session view`: show a recording in Rerun's viewer, on this machine only."""

from __future__ import annotations

import argparse
import os
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager, nullcontext, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Final, TextIO
from urllib.parse import quote

from iris_session.cli.common import (
    MOST_LINES,
    CommandError,
    Commands,
    add_command,
    ending_as_interrupts,
    make_number_type,
    name_first,
    print_error,
    to_printable,
)
from iris_session.cli.progress import ReadingProgress

if TYPE_CHECKING:
    from iris_session.recording.viewer_export import ViewFile

DEFAULT_FOLDER: Final = Path("sessions")
HOST: Final = "127.0.0.1"
#: A viewer that has not begun to listen by then has failed [s]. It takes a second on an idle machine.
START_S: Final = 60.0
#: Seconds for the viewer to end by itself before it is killed.
END_S: Final = 3.0
POLL_S: Final = 0.05
#: Memory that the server of a page may take at least, in bytes: Rerun's default.
MIN_MEMORY: Final = 1 << 30


def register(commands: Commands) -> None:
    parser = add_command(
        commands,
        "view",
        run,
        has_json=False,
        help="show a recording in Rerun's viewer",
        description="Show a recording in Rerun's viewer: the whole session, with its parts and resumed recordings, "
        "also if it was killed, cut or damaged. A copy that opens at once is kept beside it (session.view.rrd); the "
        "recording is never changed. The viewer listens on this machine only. Ctrl-C ends it.",
        examples="""
            iris-session view                          the newest session below the folder sessions
            iris-session view sessions/20261121T093000.000000Z-handover
            iris-session view session.rrd --web        in a browser on this machine
            iris-session view session.rrd --no-open    only make the copy
            iris-session view --live                   follow the session that runs
        """,
    )
    text = "a .rrd of a session, or a folder: the newest session in or below it (default: the folder sessions)"
    parser.add_argument("path", nargs="?", type=Path, metavar="RECORDING", help=text)
    parser.add_argument("--web", action="store_true", help="in a browser; the default where there is no display")
    parser.add_argument("--no-open", action="store_true", help="only make the copy, or with --web serve the page")
    parser.add_argument("--live", action="store_true", help="follow a session that runs, as it is recorded")
    port = make_number_type(int, "a port: give 1 to 65534, or 0 for a free one", 0, 65534)
    text = "port of the viewer; with --web of the page, which gets its data from port N+1 (default: free ones)"
    parser.add_argument("--port", type=port, default=0, metavar="N", help=text)


def run(arguments: argparse.Namespace) -> int:
    """Make the copy and show it until the viewer is closed, or Ctrl-C."""
    from iris_session.recording.viewer_export import open_view_file
    from iris_session.rrd.rerun_tool import find_rerun

    taken = [port for port in (arguments.port, arguments.port + 1) if arguments.port and _is_open(port)]
    if taken:  # Rerun would send the recording to a viewer that listens there
        raise CommandError(f"something listens on port {taken[0]} already: give another one, or leave --port out")
    tool = find_rerun()
    if arguments.live:
        live = find_live(arguments.path or DEFAULT_FOLDER)
        os.nice(10)  # the session comes first
        print(f"follows {to_printable(str(live))} until the session ends", flush=True)
        with ending_as_interrupts():
            return _show(tool, arguments, None, live)
    path = choose_recording(arguments.path or DEFAULT_FOLDER)
    with ending_as_interrupts(), ReadingProgress(path) as progress, open_view_file(path, progress.show_bytes) as view:
        progress.end()
        only_copies = arguments.no_open and not arguments.web
        if only_copies and not view.kept:
            raise CommandError(f"{view.session.parent} cannot be written: there is nowhere to keep the copy", 1)
        _print_file(view)
        if only_copies:
            return 0
        return _show(tool, arguments, view.path)


def find_live(path: Path) -> Path:
    """Return the first file of a recording that is being written, the newest of a folder. Raises `CommandError`."""
    from iris_session.recording.folders import find_newest_s, find_recordings, list_session_files
    from iris_session.recording.lock import is_being_written

    found = find_recordings(path, lambda _: None) if path.is_dir() else []
    if path.is_file():
        found = list_session_files(path)
    for file in sorted(found, key=lambda file: find_newest_s([file]), reverse=True):
        if is_being_written(file):
            return file
    raise CommandError(f"no session writes {path}: give its folder, or leave --live out to see one that has ended")


def choose_recording(path: Path) -> Path:
    """Return the recording to show: the newest of a folder, whose others are printed. Raises `CommandError`."""
    from iris_session.dataset.episodes import list_files
    from iris_session.recording.folders import find_newest_s, group_by_session

    found = list_files([path], lambda error: print_error(str(error)))
    if not path.is_dir():
        return path
    newest = group_by_session(found)
    if len(newest) > 1:
        print(f"{len(newest)} sessions below {to_printable(str(path))}, the newest is shown; the others:")
        for files in newest[1 : MOST_LINES + 1]:
            at = time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(find_newest_s(files)))
            print(f"  {at}  {to_printable(str(files[0]))}")
        if len(newest) > MOST_LINES + 1:
            print(f"  and {len(newest) - MOST_LINES - 1} more")
    return newest[0][0]


def _print_file(view: ViewFile) -> None:
    """Print what is shown, and what is wrong with it."""
    lines = [f"shows {', '.join(file.name for file in view.files)} of {view.session.parent}"]
    if view.path not in view.files:
        size = view.path.stat().st_size / 1e6
        lines.append(f"{'made' if view.made else 'uses'} the copy {view.path} ({size:.1f} MB)")
    lines += view.notes
    if view.damage:
        lines.append(f"DAMAGED: {name_first(view.damage)}; see `iris-session recording inspect`")
    print("\n".join(map(to_printable, lines)), flush=True)


def _show(tool: str, arguments: argparse.Namespace, file: Path | None, live: Path | None = None) -> int:
    """Show a file, or a recording that is being written, until the viewer is closed or Ctrl-C."""
    is_page = arguments.web or not _has_display()
    port = arguments.port or _find_free_port()
    data = port + 1 if is_page else port
    command = [tool, "--bind", HOST, "--port", str(data)]
    if is_page:
        # The server keeps what it read for later browsers, and would drop the oldest.
        memory = MIN_MEMORY if file is None else max(MIN_MEMORY, 4 * file.stat().st_size)
        mode = "--web-viewer" if _has_display() and not arguments.no_open else "--serve-web"
        command += [mode, "--web-viewer-port", str(port), "--server-memory-limit", f"{memory}B"]
    command += ["--hide-welcome-screen"] if file is None else [str(file.absolute())]
    with _started(command) as process:
        _wait_until_open(port, process)
        end = "Ctrl-C ends it" if is_page else "it ends with its window, or with Ctrl-C"
        where = f"in a browser on this machine: {format_page_address(port)}" if is_page else "the viewer is open"
        print(f"{where}    {end}", flush=True)
        with nullcontext() if live is None else _fed(live, data):
            return _wait(process)


def _has_display() -> bool:
    return sys.platform == "darwin" or bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def format_page_address(port: int) -> str:
    """Return the address of the page at a port: it gets its data from the next one."""
    source = quote(f"rerun+http://{HOST}:{port + 1}/proxy", safe="")
    return f"http://{HOST}:{port}/?url={source}"


def _wait_until_open(port: int, process: subprocess.Popen[bytes]) -> None:
    deadline = time.monotonic() + START_S
    while not _is_open(port):
        if (status := process.poll()) is not None:
            raise _make_viewer_error(status)
        if time.monotonic() > deadline:
            raise CommandError(f"Rerun's viewer did not listen on port {port} within {START_S:g} s", 1)
        time.sleep(POLL_S)


@contextmanager
def _fed(recording: Path, port: int) -> Iterator[None]:
    """Send what is written into a recording to the viewer at a port while the block runs."""
    from iris_session.system.process import ChildProcess

    url = f"rerun+http://{HOST}:{port}/proxy"
    with tempfile.TemporaryDirectory(prefix="iris-live-") as folder:  # for its files: it is killed at any moment
        feed = ChildProcess(
            "iris_session.recording.live_feed",
            [str(recording.absolute()), url],
            environment={"RUST_LOG": "off", "TMPDIR": folder},  # Rerun's client reports that a viewer was closed
            own_group=True,
        )
        with feed:
            yield


@contextmanager
def live_viewer(recording: Path | None, out: TextIO) -> Iterator[None]:
    """Show a recording in a viewer while the block runs, by `iris-session view --live` in a process of its own."""
    from iris_session.system.process import DEVNULL, ChildProcess

    port = _find_free_port()
    if not _has_display():
        print(f"the recording, in a browser on this machine: {format_page_address(port)}", file=out, flush=True)
    command = ["view", str(recording), "--live", "--port", str(port)]
    with tempfile.TemporaryFile() as words:  # no pipe: Rerun's viewer has it too, and may outlive the command
        # In a group of its own, so that Ctrl-C ends the session first.
        viewer = ChildProcess("iris_session.cli.main", command, stdout=DEVNULL, stderr=words, own_group=True)
        try:
            yield
            if viewer.exit_status:
                words.seek(0)
                print(words.read(10_000).decode(errors="replace").strip(), file=sys.stderr)
        finally:
            viewer.close(terminate_s=END_S + 1.0)


def _wait(process: subprocess.Popen[bytes]) -> int:
    """Wait until the viewer ends; Ctrl-C is a way to end it. Return the exit status of the command."""
    try:
        status = process.wait()
    except KeyboardInterrupt:
        return 0
    if status:
        raise _make_viewer_error(status)
    return 0


def _make_viewer_error(status: int) -> CommandError:
    return CommandError(f"Rerun's viewer ended with exit status {status}: its messages are above", 1)


@contextmanager
def _started(command: list[str]) -> Iterator[subprocess.Popen[bytes]]:
    """Start the viewer, which ends with this block."""
    from iris_session.rrd.rerun_tool import make_environment

    # In a group of its own, so that Ctrl-C reaches this process alone, which then ends it in order.
    process = subprocess.Popen(command, env=make_environment(), process_group=0, stdin=subprocess.DEVNULL)
    with process:
        try:
            yield process
        finally:
            process.terminate()
            with suppress(subprocess.TimeoutExpired):
                process.wait(END_S)
            process.kill()


def _find_free_port() -> int:
    """Return a port that is free, and so is the next."""
    while True:
        with closing(socket.socket()) as one, closing(socket.socket()) as next_one, suppress(OSError, OverflowError):
            one.bind((HOST, 0))
            port = int(one.getsockname()[1])
            next_one.bind((HOST, port + 1))
            return port


def _is_open(port: int) -> bool:
    with closing(socket.socket()) as client:
        client.settimeout(1.0)
        return client.connect_ex((HOST, port)) == 0
