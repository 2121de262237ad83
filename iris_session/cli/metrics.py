"""Metrics of a `StatusReport` in the text format of Prometheus (version 0.0.4). Names: `iris_session_*`, SI units."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Final, NamedTuple

from iris_session.protocol.status import Quantiles, StatusReport

CONTENT_TYPE: Final = "text/plain; version=0.0.4; charset=utf-8"


class Metric(NamedTuple):
    """One metric. `samples`: labels and values."""

    name: str
    kind: str
    text: str
    samples: Sequence[tuple[Mapping[str, str], float]]


def format_metrics(report: StatusReport) -> str:
    """Return all metrics of a report as text."""
    return "".join(_format_metric(metric) for metric in list_metrics(report) if metric.samples)


def list_metrics(report: StatusReport) -> Iterator[Metric]:
    """Yield the metrics of a report; some may have no samples."""
    yield from _list_session_metrics(report)
    yield from _list_participant_metrics(report)
    yield from _list_robot_metrics(report)
    yield from _list_recorder_metrics(report)


def _list_session_metrics(r: StatusReport) -> Iterator[Metric]:
    yield _make_metric("info", "gauge", "Names of the session.", 1, session=r.session_name, session_id=r.session_id)
    yield _make_metric("time_seconds", "counter", "Session time.", r.session_time * 1e-9)
    yield _make_metric("stalled", "gauge", "1 while the session does not step.", r.stalled)
    yield _make_metric("paused", "gauge", "1 while physics is paused.", r.paused)
    yield _make_metric("estop", "gauge", "1 while the emergency stop is active.", r.estop)
    yield _make_metric("realtime", "gauge", "1 when ticks run with real-time priority.", r.scheduling == "realtime")
    yield _make_metric("connections", "gauge", "Connections of the front.", r.connections)
    yield _make_metric("entries_per_second", "gauge", "Entries per second sent to the authority.", r.entries_per_s)
    yield _make_metric("late_tick_share", "gauge", "Late ticks of the last ten seconds.", r.late_share)
    yield _make_metric("late_tick_share_total", "gauge", "Late ticks since the start.", r.late_share_total)
    causes = [({"cause": cause}, float(n)) for cause, n in r.late_causes.items()]
    yield Metric("late_ticks", "gauge", "Late ticks of the last ten seconds by cause.", causes)
    yield _make_quantiles("tick_lateness_seconds", "Lateness of the end of a tick.", [({}, r.lateness)])
    yield _make_quantiles(
        "publish_delay_seconds", "From the end of a tick to the state socket.", [({}, r.step_to_publish)]
    )
    yield _make_metric("cpu_share", "gauge", "Processor time of the authority, 1 for one processor.", r.cpu_share)
    yield _make_metric("memory_bytes", "gauge", "Resident memory of the authority.", r.memory_bytes)
    yield _make_metric("load", "gauge", "Load of the machine over a minute.", r.load)
    yield _make_metric("processors", "gauge", "Processors of the machine.", r.cpus)
    dropped = [({"reason": reason}, float(n)) for reason, n in r.drops.items()]
    yield Metric("drops_total", "counter", "Dropped messages by reason.", dropped)
    if r.assets is not None:
        yield _make_metric("assets_served", "gauge", "Assets of the present scene.", r.assets.served)
        yield _make_metric("assets_bytes_total", "counter", "Bytes of assets sent to clients.", r.assets.bytes_sent)
        yield _make_metric("assets_requests_total", "counter", "Requests for chunks of assets.", r.assets.requests)
        yield _make_metric("assets_refusals_total", "counter", "Requests and connections refused.", r.assets.refusals)
    restarts = [({"process": name}, float(n)) for name, n in r.restarts.items()]
    yield Metric("restarts_total", "counter", "Restarts of processes.", restarts)


def _list_participant_metrics(r: StatusReport) -> Iterator[Metric]:
    people = [({"participant": p.id, "name": p.name, "role": p.role}, p) for p in r.participants]
    connected = [(labels, float(p.connected)) for labels, p in people]
    yield Metric(
        "participant_connected", "gauge", "0 during the grace period of a disconnected participant.", connected
    )
    heard = [(labels, p.heard_ns * 1e-9) for labels, p in people if p.heard_ns >= 0]
    yield Metric("participant_silence_seconds", "gauge", "Time since its last message.", heard)
    samples = [(labels, p.samples_per_s) for labels, p in people]
    yield Metric("participant_samples_per_second", "gauge", "Samples received.", samples)
    missed = [(labels, p.missed_share) for labels, p in people if p.reported]
    yield Metric("participant_missed_share", "gauge", "State frames that did not arrive.", missed)
    rtt = [(labels, p.rtt_ms * 1e-3) for labels, p in people if p.reported]
    yield Metric("participant_rtt_seconds", "gauge", "Lowest recent round trip.", rtt)
    charges = [(labels, p.battery) for labels, p in people if p.battery >= 0.0]
    yield Metric("participant_battery_ratio", "gauge", "Charge of its headset, 0 to 1.", charges)
    dropped = [(labels, float(p.dropped_frames)) for labels, p in people if p.display_hz > 0.0]
    yield Metric("participant_dropped_frames", "gauge", "Frames not drawn in time, over the last second.", dropped)
    received = [(labels, p.bytes_per_s) for labels, p in people if p.reported]
    yield Metric("participant_state_bytes_per_second", "gauge", "State received.", received)
    drops = [(labels, float(p.drops)) for labels, p in people]
    yield Metric("participant_drops_total", "counter", "Messages of it that were dropped.", drops)
    rejected = [({**labels, "reason": why}, float(n)) for labels, p in people for why, n in p.rejected.items()]
    yield Metric("participant_rejected_samples_total", "counter", "Rejected samples.", rejected)
    errors = [(labels, p.alignment_error_m) for labels, p in people if p.alignment == "measured"]
    yield Metric("participant_alignment_error_metres", "gauge", "Stated error (95 %) at the robot.", errors)
    ages = [(labels, p.state_age) for labels, p in people]
    yield _make_quantiles("participant_state_age_seconds", "From the end of a tick to the application.", ages)
    ways = [(labels, p.capture_to_receive) for labels, p in people]
    yield _make_quantiles("participant_capture_to_receive_seconds", "From the device to the front.", ways)


def _list_robot_metrics(r: StatusReport) -> Iterator[Metric]:
    held = [({"robot": one.name, "holder": one.holder_name or one.holder}, float(bool(one.holder))) for one in r.robots]
    yield Metric("robot_held", "gauge", "1 while the robot is held.", held)
    states = [({"robot": one.name, "state": one.state, "reason": one.hold_reason}, 1.0) for one in r.robots]
    yield Metric("robot_state", "gauge", "State, and reason for holding.", states)
    waits = [({"robot": one.name}, one.receive_to_step) for one in r.robots]
    yield _make_quantiles("robot_receive_to_step_seconds", "From the front to the step that uses a sample.", waits)


def _list_recorder_metrics(r: StatusReport) -> Iterator[Metric]:
    one = r.recorder
    if one is None or one.state == "off":
        return
    yield _make_metric("recorder_up", "gauge", "1 while the recorder runs.", one.state == "running", state=one.state)
    yield _make_metric("recorder_bytes", "gauge", "Size of the newest file.", one.bytes_written)
    yield _make_metric("recorder_lost_rows_total", "counter", "Steps missing in the recording.", one.lost_rows)
    yield _make_metric(
        "recorder_waiting_bytes", "gauge", "Bytes in memory that wait for the recorder.", one.spilled_bytes
    )
    if one.disk_free_bytes:
        yield _make_metric("recorder_disk_free_bytes", "gauge", "Free space for the recording.", one.disk_free_bytes)


def _make_metric(name: str, kind: str, text: str, value: float, **labels: str) -> Metric:
    return Metric(name, kind, text, [(labels, float(value))])


def _make_quantiles(name: str, text: str, measured: Sequence[tuple[Mapping[str, str], Quantiles | None]]) -> Metric:
    """Return gauges with a `quantile` label: a summary would need sums and counts since the start."""
    samples = [
        ({**labels, "quantile": quantile}, ms * 1e-3)
        for labels, values in measured
        if values is not None
        for quantile, ms in (("0.5", values.p50), ("0.99", values.p99))
    ]
    return Metric(name, "gauge", text, samples)


def _format_metric(metric: Metric) -> str:
    name = f"iris_session_{metric.name}"
    lines = [f"# HELP {name} {metric.text}", f"# TYPE {name} {metric.kind}"]
    for labels, value in metric.samples:
        inside = ",".join(f'{key}="{_escape_label(text)}"' for key, text in labels.items())
        lines.append(f"{name}{{{inside}}} {value:.9g}" if inside else f"{name} {value:.9g}")
    return "\n".join(lines) + "\n"


def _escape_label(text: str) -> str:
    return text.replace("\\", "\\\\").replace('"', '\\"').replace("\n", "\\n")
