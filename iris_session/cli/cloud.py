"""`iris-session cloud`: depth cameras as point clouds: run by hand, an example file, inspect a file or a session."""

from __future__ import annotations

import argparse
import logging
import math
import shutil
import signal
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from iris_session.cli import calibrate
from iris_session.cli.common import (
    CommandError,
    Commands,
    add_actions,
    add_address_options,
    add_command,
    handling_signals,
    make_client,
    parse_seconds,
    print_error,
    print_json,
    print_result,
    to_printable,
)
from iris_session.protocol.errors import IrisError
from iris_session.protocol.names import MediaEncoding, Role

if TYPE_CHECKING:
    from iris_session.client.stream_meter import StreamMeasurement
    from iris_session.cloud.camera_file import CloudSettings
    from iris_session.cloud.config import CameraReport
    from iris_session.cloud.worker import CloudWorker

#: Without a terminal, a line of `run` that is like the one before is printed this often [s].
QUIET_S: Final = 10.0
log = logging.getLogger(__name__)


def register(commands: Commands) -> None:
    actions = add_actions(
        commands,
        "cloud",
        help="point clouds of depth cameras: run, example, inspect, calibrate",
        description="Show what depth cameras see as a point cloud in a session. `serve --camera FILE` does so by "
        "itself for cameras at its machine.",
    )
    _register_run(actions)
    _register_example(actions)
    _register_inspect(actions)
    calibrate.register_depth_cameras(actions)


def _register_run(actions: Commands) -> None:
    parser = add_command(
        actions,
        "run",
        run_file,
        has_json=False,
        help="publish the cloud of a camera file in a session",
        description="Publish the cloud and the pictures of a camera file in a session until Ctrl-C. At an encrypted "
        "session the key of this user must be allowed in role camera: `iris-session pair --role camera` there.",
        examples="""
            iris-session cloud run camera.toml
            iris-session cloud run camera.toml --address 192.168.1.20 --code 7KQ2-M4XD-9PTR    the first time
            iris-session cloud run camera.toml --session lab-1 --json
        """,
    )
    parser.add_argument("file", type=Path, help="camera file; `iris-session cloud example` prints one")
    add_address_options(parser, option=True)
    parser.add_argument("--seconds", type=parse_seconds, help="stop after this many seconds")
    parser.add_argument("--json", action="store_true", help="one JSON object per second")


def _register_example(actions: Commands) -> None:
    from iris_session.cloud.example import SOURCES

    parser = add_command(
        actions,
        "example",
        run_example,
        has_json=False,
        help="print a commented camera file, to be edited",
        examples="""
            iris-session cloud example > camera.toml
            iris-session cloud example --source realsense -o camera.toml
        """,
    )
    parser.add_argument("--source", choices=sorted(SOURCES), default="folder", help="source of frames (%(default)s)")
    parser.add_argument("-o", "--out", type=Path, metavar="FILE", help="write it to a file that does not exist yet")


def _register_inspect(actions: Commands) -> None:
    parser = add_command(
        actions,
        "inspect",
        run_inspect,
        help="measure a camera file, or the clouds of a session",
        description="Measure what a camera file gives, without a session: rate, points, stages, faults. Or, without a "
        "file, join a session as an observer and measure the clouds and pictures that arrive: rate, points, age by "
        "stage. Exit status 1 if there is a fault, or nothing comes.",
        examples="""
            iris-session cloud inspect camera.toml
            iris-session cloud inspect --address 192.168.1.20 --seconds 10
            iris-session cloud inspect --json
        """,
    )
    parser.add_argument("target", nargs="?", default="", metavar="FILE", help="camera file")
    add_address_options(parser, option=True)
    parser.add_argument("--seconds", type=parse_seconds, default=3.0, help="time to measure (default: %(default)s)")


# --- run --------------------------------------------------------------------------------------------------------------


def run_file(arguments: argparse.Namespace) -> int:
    """Publish a camera file until Ctrl-C. Exit status 1 if the session does not admit us, or has such a stream."""
    from iris_session.cloud.camera_file import load_camera_file
    from iris_session.cloud.process import run_cameras
    from iris_session.system.priority import lower_thread_priority

    settings = load_camera_file(arguments.file)
    client = make_client(arguments, Role.CAMERA, settings.stream)
    lower_thread_priority()
    seconds = math.inf if arguments.seconds is None else arguments.seconds
    printer = _ReportPrinter(as_json=arguments.json)
    ending = threading.Event()  # a driver is not interrupted in the middle of its work
    catching = handling_signals(lambda *_: ending.set(), signal.SIGINT, signal.SIGTERM)
    with catching, _name_unexpected_error(settings):
        fault = run_cameras(settings, client, printer, lambda: ending.is_set() or printer.passed_s >= seconds)
        if not (fault or printer.was_connected or ending.is_set()):
            where = arguments.address or arguments.session or "of this machine"
            fault = f"no session admitted the cameras within {seconds:g} s: {where}"
    printer.end()
    if fault:
        print_error(fault)
    return 1 if fault else 0


@contextmanager
def _name_unexpected_error(settings: CloudSettings) -> Iterator[None]:
    """Turn an unexpected error into one line: of a driver, or a package that reads recordings."""
    from iris_session.system.log import LEVEL_VARIABLE, describe_error

    try:
        yield
    except (ImportError, IrisError):
        raise
    except Exception as error:
        log.debug("the cameras of %r end", settings.stream, exc_info=True)
        text = f"the cameras of {settings.stream!r} ended: {describe_error(error)}; {LEVEL_VARIABLE}=DEBUG shows where"
        raise CommandError(text, status=1) from error


class _ReportPrinter:
    """Prints reports: on a terminal one line that is written over, elsewhere lines when something has changed."""

    was_connected = False

    def __init__(self, *, as_json: bool) -> None:
        self._first_at = math.inf
        self._as_json = as_json
        self._is_terminal = sys.stdout.isatty()
        self._faults = ""
        self._at = -QUIET_S

    @property
    def passed_s(self) -> float:
        """Time since the first report [s], 0 before it: the filter is being prepared, which can take seconds."""
        return max(0.0, time.monotonic() - self._first_at)

    def __call__(self, report: CameraReport) -> None:
        self._first_at = min(self._first_at, time.monotonic())
        self.was_connected |= report.connected
        if self._as_json:
            print_json(report)
            return
        line = format_report(report)
        if self._is_terminal:
            width = shutil.get_terminal_size((120, 24)).columns
            print(f"\r\x1b[K{line[: width - 1]}", end="", flush=True)
            return
        faults = f"{report.connected} {format_faults(report)}"
        if faults != self._faults or time.monotonic() - self._at >= QUIET_S:
            self._faults, self._at = faults, time.monotonic()
            print(line, flush=True)

    def end(self) -> None:
        """End the line that is written over."""
        if self._is_terminal and not self._as_json:
            print(flush=True)


def format_report(report: CameraReport) -> str:
    """Return the state of a camera process on one line."""
    if not report.connected:
        return f"{report.stream}: no session yet"
    rate = f"{report.hz:.1f} Hz, {report.points:,} points of {100.0 * report.voxel_m:.1f} cm"
    line = f"{report.stream}: {rate}, {report.bytes_per_s * 8e-6:.1f} Mbit/s, {report.age_ms:.0f} ms old"
    faults = format_faults(report)
    return f"{line}    {faults}" if faults else line


def format_faults(report: CameraReport) -> str:
    """Return the faults of all cameras and what the cloud lacks, empty while all is well."""
    found = [f"{name}: {one.fault} ({one.detail})" for name, one in report.cameras.items() if one.fault]
    return to_printable("; ".join([*found, report.warning] if report.warning else found))


# --- example ----------------------------------------------------------------------------------------------------------


def run_example(arguments: argparse.Namespace) -> int:
    """Print or write a commented camera file."""
    from iris_session.cloud.example import make_example

    text = make_example(arguments.source)
    if arguments.out is None:
        sys.stdout.write(text)
        return 0
    try:
        with arguments.out.open("x", encoding="utf-8") as file:
            file.write(text)
    except FileExistsError:
        raise CommandError(f"{arguments.out} exists: give another file, or remove it first") from None
    except OSError as error:
        raise CommandError(f"{arguments.out} cannot be written: {error.strerror}") from None
    print(f"{arguments.out}: edit it, then `iris-session cloud inspect {arguments.out}`")
    return 0


# --- inspect ----------------------------------------------------------------------------------------------------------


def run_inspect(arguments: argparse.Namespace) -> int:
    """Measure a camera file, or the clouds of a session."""
    path = Path(arguments.target)
    if arguments.target and (path.suffix == ".toml" or path.exists()):
        return _inspect_file(arguments, path)
    arguments.address = arguments.address or arguments.target
    return _inspect_session(arguments)


class _NoSink:
    """Takes frames of a worker and sends them nowhere."""

    def now_ns(self) -> int:
        return time.monotonic_ns()

    def publish(self, *_: object) -> bool:
        return True


def _inspect_file(arguments: argparse.Namespace, path: Path) -> int:
    import msgspec

    from iris_session.cloud.camera_file import load_camera_file
    from iris_session.cloud.sources import open_source
    from iris_session.cloud.worker import CloudWorker

    settings = load_camera_file(path)
    for camera in settings.cameras:
        if camera.body:
            raise CommandError(
                f"camera {camera.name!r} is on body {camera.body!r}: only a session knows where that is; `iris-session "
                f"cloud run {path}`, then `iris-session cloud inspect --address ADDR`"
            )
    with _name_unexpected_error(settings):
        worker = CloudWorker(settings, _NoSink(), open_source, time.perf_counter_ns)
        worker.start()
        try:
            _run_worker(worker, 10.0, lambda: worker.cloud is not None)  # a camera warms up
            worker.make_report()  # its rates begin here
            _run_worker(worker, arguments.seconds, lambda: False)
            report = worker.make_report()
        finally:
            worker.close()
    is_well = report.hz > 0.0 and not format_faults(report)
    return print_result(
        arguments, {"ok": is_well, **msgspec.to_builtins(report)}, format_inspection(settings, report), ok=is_well
    )


def _run_worker(worker: CloudWorker, seconds: float, is_done: Any) -> None:
    until = time.monotonic() + seconds
    while time.monotonic() < until and not is_done():
        worker.poll(0.05)


def format_inspection(settings: CloudSettings, report: CameraReport) -> Iterator[str]:
    """Return what a camera file gives, in lines."""
    for name, one in report.cameras.items():
        state = f"{one.fault}: {one.detail}" if one.fault else "well"
        yield f"camera {name}: {one.hz:.1f} frames per second, {state}"
    if report.warning:
        yield report.warning
    if not report.points:
        yield f"cloud {report.stream}: no points came"
        yield from _format_drops(report)
        return
    points = f"{report.points:,} points of {100.0 * report.voxel_m:.1f} cm"
    budget = f"budget {settings.points:,}, cells from {100.0 * settings.voxel_m:.1f} cm"
    yield f"cloud {report.stream}: {report.hz:.1f} Hz, {points} ({budget})"
    error = "error not stated" if report.error_m is None else f"stated error {1000.0 * report.error_m:.1f} mm"
    yield f"  {error}, {report.bytes_per_s * 8e-6:.1f} Mbit/s with all classes"
    if report.stages_ms:
        stages = ", ".join(f"{stage} {ms:.1f}" for stage, ms in report.stages_ms.items())
        yield f"  stages [ms]: {stages}; from capture to the last byte {report.age_ms:.0f}"
    yield from _format_drops(report)


def _format_drops(report: CameraReport) -> Iterator[str]:
    if report.drops:
        from iris_session.doctor.drop_explanations import EXPLANATIONS

        parts = (f"{reason} {n} ({EXPLANATIONS[f'camera_{reason}']})" for reason, n in sorted(report.drops.items()))
        yield f"  left out: {', '.join(parts)}"


def _inspect_session(arguments: argparse.Namespace) -> int:
    from iris_session.client.stream_meter import StreamMeter

    with make_client(arguments, Role.OBSERVER, "cloud inspect") as client:
        shown = (MediaEncoding.CLOUD, MediaEncoding.JPEG)

        def list_streams() -> list[str]:
            budget = client.media.delivery
            return [] if budget is None else [one.stream for one in budget.streams if one.encoding in shown]

        client.wait_for(lambda _: bool(list_streams()), 5.0)
        meters = [StreamMeter(client, stream, time.monotonic_ns()) for stream in list_streams()]
        until = time.monotonic() + arguments.seconds
        while meters and time.monotonic() < until:
            client.poll(0.05)
            for meter in meters:
                meter.poll(time.monotonic_ns())
        found = [meter.measure(time.monotonic_ns()) for meter in meters]
    is_well = bool(found) and all(one.frames and not one.fault and not one.stale for one in found)
    none = "the session has no cloud: `iris-session serve --camera FILE`, or `iris-session cloud run FILE`"
    lines = [line for one in found for line in _format_stream(one)] or [none]
    return print_result(arguments, {"ok": is_well, "streams": found}, lines, ok=is_well)


def _format_stream(one: StreamMeasurement) -> Iterator[str]:
    name = f"{one.stream} ({one.title})" if one.title not in ("", one.stream) else one.stream
    yield f"{name}: {one.hz:.1f} Hz, class {one.budget_class}, {one.mbit_per_s:.1f} Mbit/s"
    if one.points is not None and one.voxel_m is not None:
        error = "" if one.error_mm is None else f", stated error {one.error_mm:.1f} mm"
        size = "" if one.bytes_per_point is None else f", {one.bytes_per_point:.2f} bytes each"
        yield f"  {one.points:,} points of {100.0 * one.voxel_m:.1f} cm{size}{error}"
    if one.age_ms is not None:
        stages = ", ".join(f"{stage} {ms:.1f}" for stage, ms in one.ages_ms.items())
        yield f"  age {one.age_ms:.0f} ms, median{': ' if stages else ''}{stages}"
    if one.fault or one.stale:
        yield f"  {one.fault or 'stale'}: {one.detail or 'no frames come'}"
