"""`iris-session sessions`: those on this network; `status`: one of them on one screen, or as metrics for Prometheus."""

from __future__ import annotations

import argparse
import sys
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import TYPE_CHECKING, Final

from iris_session.cli.common import (
    CommandError,
    Commands,
    add_address_options,
    add_command,
    list_first,
    make_client,
    parse_seconds,
    pick_attributes,
    print_result,
    to_printable,
)

if TYPE_CHECKING:
    from iris_session.client import Client
    from iris_session.protocol.status import ParticipantReport, Quantiles, StatusReport

#: Time to be admitted; afterwards the session is asked nevertheless.
JOIN_S: Final = 4.0
#: Clients report once a second: an earlier status has less.
FIRST_REPORT_S: Final = 1.2


def register(commands: Commands) -> None:
    _register_sessions(commands)
    parser = add_command(
        commands,
        "status",
        run,
        help="status of a session: participants, robots, ages, late ticks, recorder",
        description="Join as the observer `status`, print the status of the session, and leave.",
        examples="""
            iris-session status
            iris-session status 192.168.1.20 --watch
            iris-session status --json
            iris-session status --metrics-port 9463      http://127.0.0.1:9463/metrics for Prometheus
        """,
    )
    add_address_options(parser)
    form = parser.add_mutually_exclusive_group()
    add_watch_options(form, parser)
    form.add_argument("--prometheus", action="store_true", help="print metrics in the text format of Prometheus, once")
    form.add_argument("--metrics-port", type=int, metavar="PORT", help="serve the metrics on 127.0.0.1 over HTTP")


def _register_sessions(commands: Commands) -> None:
    parser = add_command(
        commands,
        "sessions",
        run_sessions,
        help="list the sessions on this network",
        description="List the sessions that announce themselves on the networks of this machine. If an access point "
        "blocks broadcasts, none is heard: type the address of the session, or scan the code of `iris-session pair`.",
        examples="""
            iris-session sessions
            iris-session sessions --seconds 3 --json
        """,
    )
    parser.add_argument("--seconds", type=parse_seconds, default=1.0, help="listen this long (default: %(default)g)")


def run_sessions(arguments: argparse.Namespace) -> int:
    """Listen for beacons and print the sessions. Exit status 1 if none was heard."""
    from iris_session.client import find_sessions
    from iris_session.client.server_trust import known_fingerprints

    known = known_fingerprints()
    found = find_sessions(arguments.seconds)
    names = ("name", "address", "addresses", "session_id", "kind", "key_fingerprint")
    marks = [{"encrypted": bool(one.key_fingerprint), "known": one.key_fingerprint in known} for one in found]
    rows = [pick_attributes(one, *names) | mark for one, mark in zip(found, marks, strict=True)]
    lines = [f"{row['name']:<24} {row['address']:<24} {row['kind']:<8} {_format_key(row)}" for row in rows]
    none = "no session was heard: type the address of a session, or scan its code (docs/network.md)"
    return print_result(arguments, {"ok": bool(rows), "sessions": rows}, lines or [none], ok=bool(rows))


def _format_key(row: dict[str, object]) -> str:
    if not row["encrypted"]:
        return "not encrypted: this machine only"
    return f"key {row['key_fingerprint']}{'' if row['known'] else ' (new: join with --code)'}"


def add_watch_options(group: argparse._ActionsContainer, parser: argparse.ArgumentParser) -> None:
    """Add `--watch` to `group`, and `--period` to `parser`."""
    group.add_argument("--watch", action="store_true", help="repeat until Ctrl-C")
    text = "--watch: seconds between two reports (default: %(default)s)"
    parser.add_argument("--period", type=parse_seconds, default=1.0, metavar="S", help=text)


def run(arguments: argparse.Namespace) -> int:
    """Print the status; with --watch or --metrics-port until Ctrl-C."""
    from iris_session.cli.metrics import format_metrics

    if arguments.metrics_port is None and not arguments.prometheus:
        return run_status_command(arguments, lambda report: report, format_status)
    with open_status(arguments) as (client, report):
        if arguments.metrics_port is not None:
            return _serve_metrics(client, arguments.metrics_port)
        sys.stdout.write(format_metrics(report))
        return 0


@contextmanager
def open_status(arguments: argparse.Namespace) -> Iterator[tuple[Client, StatusReport]]:
    """Join a session as an observer. Yield the client and the status, which a stalled session answers, too."""
    from iris_session.client import NotConnectedError, RequestTimeoutError

    client = make_client(arguments, "observer", "status")
    try:
        client.open()
        if client.wait_for(lambda one: one.ready, JOIN_S):
            client.sleep(FIRST_REPORT_S)
        try:
            report = client.status()
        except (NotConnectedError, RequestTimeoutError) as error:
            why = str(error) if client.ready else f"no session answers at {client.describe_failure('now')}"
            raise CommandError(why) from None
        yield client, report
    finally:
        client.close()


def run_status_command(
    arguments: argparse.Namespace,
    to_object: Callable[[StatusReport], object],
    format_lines: Callable[[StatusReport], Iterable[str]],
) -> int:
    """Print the status of a session; with --watch until Ctrl-C: if the session ends, wait for it to return.

    Args:
        arguments: Options of `add_address_options`, `add_watch_options`, `add_json_option`.
        to_object: Makes what `--json` prints.
        format_lines: Makes one screen.
    """
    from iris_session.client import NotConnectedError, RequestTimeoutError

    clear = "\x1b[2J\x1b[H" if arguments.watch and sys.stdout.isatty() and not arguments.json else ""
    with open_status(arguments) as (client, first):
        report: StatusReport | None = first
        while True:
            if report is not None:
                print(clear, end="")
                print_result(arguments, to_object(report), format_lines(report))
            if not arguments.watch:
                return 0
            client.sleep(max(0.1, arguments.period))
            try:
                report = client.status()
            except (NotConnectedError, RequestTimeoutError) as error:
                report = None
                print(f"{clear}{error}", flush=True)


def _serve_metrics(client: Client, port: int) -> int:
    """Answer HTTP requests for metrics on loopback until Ctrl-C."""
    from iris_session.cli.metrics import CONTENT_TYPE, format_metrics
    from iris_session.client import ClientError

    client.start()
    lock = threading.Lock()  # one request at a time: the client does not match answers to threads

    class Scrape(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            if self.path not in ("/", "/metrics"):
                self.send_error(404, "metrics are at /metrics")
                return
            try:
                with lock:
                    body = format_metrics(client.status()).encode()
            except ClientError as error:
                self.send_error(503, to_printable(str(error)))
                return
            self.send_response(200)
            self.send_header("Content-Type", CONTENT_TYPE)
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, format: str, *args: object) -> None:
            """Requests are not logged."""

    try:
        server = ThreadingHTTPServer(("127.0.0.1", port), Scrape)
    except (OSError, OverflowError) as error:
        raise CommandError(f"cannot serve metrics on port {port}: {error}") from None
    with server:
        print(f"metrics on http://127.0.0.1:{server.server_address[1]}/metrics", flush=True)
        server.serve_forever()
    return 0


def format_status(report: StatusReport) -> Iterator[str]:
    """Yield one screen of lines."""
    from iris_session.doctor.session_checks import measure_client_stages, measure_stages
    from iris_session.protocol.status import NOT_PUBLISHED

    silent = next((text for text in report.warnings if text.startswith(NOT_PUBLISHED)), "")
    going = silent.partition(":")[0].replace(NOT_PUBLISHED, "silent for", 1) or "running"
    state = "E-STOP" if report.estop else "paused" if report.paused else going
    if report.stalled:
        state = f"STALLED for {report.authority_silent_ns * 1e-9:.1f} s"
    elif report.authority_silent_ns < 0:
        state = "NOT STARTED"
    yield (
        f"session '{report.session_name}'  {state}  tick {report.tick}  {report.session_time * 1e-9:.1f} s  "
        f"{report.connections} connections  {report.entries_per_s:.0f} entries/s"
    )
    if report.pause_reason:
        yield f"physics stands still: {report.pause_reason}; `iris-session reset` begins anew"
    for stop in report.stops:
        who = f"{stop.name} ({stop.participant})" if stop.participant else "a connection that had not joined"
        why = f": {stop.reason}" if stop.reason else ""
        yield f"e-stop {stop.stop_seq} by {who}, {stop.age_ns * 1e-9:.1f} s ago{why}"
    yield ""
    yield (
        f"{'participant':20s} {'role':9s} {'alignment':22s} {'age p50/p99 ms':>15s} {'rtt ms':>7s} "
        f"{'missed':>7s} {'samples/s':>9s} {'drops':>6s}  robots"
    )
    for p in report.participants:
        yield _format_participant(p)
    seen = ((p, measure_client_stages(p, report)) for p in report.participants)
    ages = [f"{p.name} {sum(took.values()):.0f} ms ({_format_stages(took)})" for p, took in seen if took]
    yield from (f"age of what is seen: {line}" for line in list_first(ages))
    yield ""
    yield f"{'robot':20s} {'holder':20s} {'state':9s} {'hold reason':14s} {'receive to step ms':>19s}  queue"
    for r in report.robots:
        waits = ", ".join(r.queue)
        holder = r.holder_name or r.holder or "-"
        yield (
            f"{r.name:20.20s} {holder:20.20s} {r.state:9s} {r.hold_reason or '-':14s} "
            f"{_format_quantiles(r.receive_to_step):>19s}  {waits}"
        )
    yield from _format_media(report)
    yield from _format_assets(report)
    yield ""
    took = measure_stages(report.participants, report)
    yield "data age, p99 of the slowest: " + (
        ", ".join(f"{stage} {ms:.1f} ms" + (f" ({who})" if who else "") for stage, (ms, who) in took.items()) or "-"
    )
    causes = ", ".join(f"{cause} {n}" for cause, n in report.late_causes.items()) or "none"
    yield (
        f"late ticks: {report.late_share:.2%} of the last ten seconds, {report.late_share_total:.2%} in total; "
        f"lateness p50/p99 {_format_quantiles(report.lateness)} ms; causes: {causes}; "
        f"scheduling {report.scheduling or '-'}"
    )
    yield (
        f"machine: load {report.load:.1f} of {report.cpus}, the session's process {report.cpu_share:.0%} of one, "
        f"{report.memory_bytes / 1e6:.0f} MB"
    )
    one = report.recorder
    if one is not None and one.state == "off":
        yield "recorder: off"
    elif one is not None:
        rate = f" ({one.bytes_per_hour / 1e6:.0f} MB an hour now)" if one.bytes_per_hour else ""
        yield (
            f"recorder: {one.state}, {one.bytes_written / 1e6:.1f} MB{rate}, {one.disk_free_bytes / 1e9:.1f} GB free, "
            f"{one.lost_rows} rows lost, {one.path}{f': {one.text}' if one.text else ''}"
        )
    most = sorted(report.drops.items(), key=lambda item: -item[1])[:8]
    yield "drops: " + (", ".join(f"{reason} {n}" for reason, n in most) or "none")
    restarts = ", ".join(f"{name} {n}" for name, n in report.restarts.items() if n)
    if restarts:
        yield f"restarted: {restarts}"
    yield from (f"warning: {text}" for text in report.warnings)


def _format_participant(p: ParticipantReport) -> str:
    aligned = p.alignment
    if p.alignment_age_ns >= 0 and aligned in ("measured", "placed"):
        stated = aligned == "measured" and not (p.alignment_report is not None and p.alignment_report.offset)
        error = f"{p.alignment_error_m * 1e3:.0f} mm" if stated else "-"
        aligned += f" {error}, {p.alignment_age_ns * 1e-9:.0f} s"
    elif p.alignment_void_ns >= 0:
        aligned = f"void for {p.alignment_void_ns * 1e-9:.0f} s"
    name = f"{p.name} ({p.id})" if p.connected else f"{p.name} OFFLINE {p.lost}"
    age = _format_quantiles(p.state_age) if p.reported else "-"
    waits = f" waits: {', '.join(p.waits_for)}" if p.waits_for else ""
    return (
        f"{name:20.20s} {p.role:9.9s} {aligned:22.22s} {age:>15s} {p.rtt_ms:7.1f} {p.missed_share:7.1%} "
        f"{p.samples_per_s:9.0f} {p.drops:6d}  {', '.join(p.holds)}{waits}"
    )


def _format_media(report: StatusReport) -> Iterator[str]:
    """Return a line per stream with its subscribers."""
    if report.media:
        yield ""
    for one in report.media:
        subscribers = [
            f"{p.name} ({p.id}) {budget.budget_class}"
            for p in report.participants
            for budget in p.media
            if budget.stream == one.stream
        ]
        source = f" from {one.source}" if one.source else ""
        receivers = ", ".join(subscribers) or "no subscribers"
        title = f" ({one.title})" if one.title else ""
        fault = f"; FAULT {one.fault}{f': {one.detail}' if one.detail else ''}" if one.fault else ""
        seconds = one.age_ms * 1e-3
        age = f"newest frame {one.age_ms:.0f} ms old" if seconds < 1.0 else f"no frame for {seconds:.1f} s"
        age = f"STALE, {age}" if one.stale else age
        rates = f"{one.hz:.0f} Hz, {one.mbit_per_s:.1f} Mbit/s"
        yield f"media {one.stream}{title}: {rates}{source}; {receivers}; {age}{fault}"
    dropped = [f"{p.media_drops} to {p.name} ({p.id})" for p in report.participants if p.media_drops]
    if dropped:
        yield f"media frames that a link did not take: {', '.join(dropped)}"


def _format_assets(report: StatusReport) -> Iterator[str]:
    """Return a line about the assets that clients fetched."""
    one = report.assets
    if one is not None and (one.served or one.requests):
        refused = f", {one.refusals} refused" if one.refusals else ""
        waiting = f"; {one.waiting} clients waiting" if one.waiting else ""
        yield f"assets: {one.served} served, {one.bytes_sent / 1e6:.1f} MB sent{refused}{waiting}"


def _format_stages(took: Mapping[str, float]) -> str:
    return ", ".join(f"{stage} {ms:.1f}" for stage, ms in took.items())


def _format_quantiles(values: Quantiles | None) -> str:
    return "-" if values is None else f"{values.p50:.1f}/{values.p99:.1f}"
