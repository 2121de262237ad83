"""Messages about the condition of the session: reports of clients, status reports, delivery budgets.

None of them reaches the authority: the front answers them, so asking costs no step and is not journaled.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Final

import msgspec

from iris_session.protocol.common import Count, Message, Name, Nanoseconds, Pose, Text
from iris_session.protocol.media import StreamBudget
from iris_session.protocol.names import MediaEncoding, StreamAudience


class GetStatus(Message, frozen=True, tag="get_status"):
    """Request for a `StatusReport`."""

    request_id: Count = 0


class ClientReport(Message, frozen=True, tag="client_report"):
    """Delivery of state to the application of a client, once a second: for status, doctor and delivery budgets.

    Ages are from the end of the tick to the application, by the client's clock estimate [ms], over the last second.
    `missed`: frames that were sent (by `state_seq`) and not delivered. `rtt_ms`: lowest recent round trip.
    `media_bytes_per_s`, `media_age_ms` (median since capture): of the media channel. `display_hz`: frames drawn, 0 when
    none are. `media_limit_mbit_per_s`: upper bound of media that the client asks for, 0 for no limit of its own.
    `battery`: charge of the device, 0 to 1, -1 where it is not known. `thermal`: a `ThermalState`. `dropped_frames`:
    frames that were not drawn in time, over the last second. `shown_age_ms`: of the picture that is shown, as
    `age_ms_p50` and what interpolating and drawing add, 0 where it is not known.
    """

    age_ms_p50: float
    age_ms_p99: float
    delivered: Count
    missed: Count = 0
    rtt_ms: float = 0.0
    bytes_per_s: float = 0.0
    media_bytes_per_s: float = 0.0
    media_age_ms: float = 0.0
    display_hz: float = 0.0
    media_limit_mbit_per_s: float = 0.0
    battery: float = -1.0
    charging: bool = False
    thermal: Name = ""
    dropped_frames: Count = 0
    shown_age_ms: float = 0.0


class DeliveryBudget(Message, frozen=True, tag="delivery_budget"):
    """Media that this client gets from now on. Sent after `Welcome`, and whenever it changes.

    `budget_class`: the lowest class among the streams that it subscribed to. State and control are never cut.
    `mbit_per_s`: bound of all media together, 0 for none. `reason`: why it is not everything. `streams`: every stream
    of the session.
    """

    budget_class: Name
    mbit_per_s: float = 0.0
    reason: Text = ""
    streams: tuple[StreamBudget, ...] = ()


#: How a warning of a `StatusReport` begins while the program that publishes is silent: then come seconds, and a colon.
NOT_PUBLISHED: Final = "nothing was published for"


class Quantiles(msgspec.Struct, frozen=True, array_like=True):
    """Median and 99th percentile [ms] over the last seconds; null where nothing was measured."""

    p50: float
    p99: float


def compute_quantiles(durations_ns: Iterable[int]) -> Quantiles | None:
    """Return the quantiles of durations [ns], `None` without any."""
    ordered = sorted(durations_ns)
    if not ordered:
        return None
    last = len(ordered) - 1
    return Quantiles(ordered[last // 2] * 1e-6, ordered[-(-last * 99 // 100)] * 1e-6)


class AnchorSeen(msgspec.Struct, frozen=True):
    """Observations of one anchor by a headset: their number in this run, and the age of the newest."""

    anchor_id: Name
    observations: Count
    age_ns: Nanoseconds


class AlignmentReport(msgspec.Struct, frozen=True):
    """State of the alignment of one participant, beyond `AlignmentChanged`.

    `error_at_anchor_m`, `error_at_robot_m`: stated p95. `pending_m`, `pending_rad`: size of a correction that waits, or
    slides in. `advice`: why the estimator refuses, or warns. `alarm`: the last `AlarmKind` that no new alignment has
    resolved yet, `alarm_ns` ago. `unusable`: observations that could not be used, since the run began. `doubt`: why it
    is unconfirmed and begins no engagement (`AlignmentDoubt`), empty for not so. `confirmed_ns`: since the last look
    that agreed with it, -1 without an alignment.
    """

    version: Count = 0
    running: bool = True
    offset: bool = False
    error_at_anchor_m: float = 0.0
    error_at_robot_m: float = 0.0
    residual_tilt_rad: float = 0.0
    observations: Count = 0
    viewpoints: Count = 0
    unusable: Count = 0
    pending_m: float = 0.0
    pending_rad: float = 0.0
    advice: Text = ""
    alarm: Name = ""
    alarm_size_m: float = 0.0
    alarm_ns: Nanoseconds = -1
    seen: tuple[AnchorSeen, ...] = ()
    doubt: Name = ""
    confirmed_ns: Nanoseconds = -1


class CrossCheckReport(msgspec.Struct, frozen=True):
    """The newest comparison of two headsets, `age_ns` ago; fields as in `HeadsetsCompared`. `outdated`: one of them has
    been aligned elsewhere since.
    """

    a: Name
    b: Name
    anchor_id: Name
    error_m: float
    error_rad: float
    expected_p95_m: float
    age_ns: Nanoseconds
    n: Count = 0
    touched: bool = False
    outdated: bool = False


class UnverifiedReport(msgspec.Struct, frozen=True):
    """Two headsets that are not known to have the same world: `other` has aligned by an anchor since `participant` last
    saw it, and the anchor may have been moved in between. A glance of `participant` at it verifies the pair.
    """

    participant: Name
    other: Name
    anchor_id: Name


class AnchorReport(msgspec.Struct, frozen=True):
    """One anchor of the session. `size_m`: edge of the printed sheet, 0 for not known."""

    anchor_id: Name
    T_world_anchor: Pose
    size_m: float = 0.0


class ParticipantReport(msgspec.Struct, frozen=True):
    """One participant, as the session sees it. Times in `*_ns` are durations until now, -1 for never.

    `capture_to_receive`: device to front. `state_age`: end of tick to application, as its client reports it.
    `alignment_void_ns`: since the tracking frame jumped and voided the alignment, -1 for not so. `lost`: why it is
    disconnected (`silent`, `closed`, `slow`, ...), empty while connected. `rejected`: samples by reason, `drops`:
    messages dropped, both since it joined. `reported`: its client reports. `media`: the streams that it subscribed to,
    `budget_class` the lowest of theirs, empty without one. `media_bytes_per_s`: sent to it, `media_drops`: frames that
    its link did not take in time, since it joined. `display_hz`, `battery`, `charging`, `thermal`, `dropped_frames`,
    `shown_age_ms`: as in `ClientReport`.
    """

    id: Name
    name: Name
    role: Name
    connected: bool
    address: Name = ""
    software: Name = ""
    worn: bool = True
    heard_ns: Nanoseconds = -1
    alignment: Name = "none"
    alignment_age_ns: Nanoseconds = -1
    alignment_void_ns: Nanoseconds = -1
    alignment_error_m: float = 0.0
    tracking_epoch: Count = 0
    holds: tuple[Name, ...] = ()
    waits_for: tuple[Name, ...] = ()
    samples_per_s: float = 0.0
    capture_to_receive: Quantiles | None = None
    state_age: Quantiles | None = None
    missed_share: float = 0.0
    rtt_ms: float = 0.0
    bytes_per_s: float = 0.0
    budget_class: Name = ""
    rejected: dict[str, int] = msgspec.field(default_factory=dict)
    drops: Count = 0
    reported: bool = False
    lost: Name = ""
    media: tuple[StreamBudget, ...] = ()
    media_bytes_per_s: float = 0.0
    media_drops: Count = 0
    alignment_report: AlignmentReport | None = None
    display_hz: float = 0.0
    battery: float = -1.0
    charging: bool = False
    thermal: Name = ""
    dropped_frames: Count = 0
    shown_age_ms: float = 0.0


class StopReport(msgspec.Struct, frozen=True):
    """One e-stop that is in force: its number, and who stopped the session `age_ns` ago, for which reason.

    `participant`, `name`: empty for a connection that had not joined.
    """

    stop_seq: Count
    participant: Name
    name: Name
    reason: Text
    age_ns: Nanoseconds


class RobotReport(msgspec.Struct, frozen=True):
    """One robot: its holder, its state, and the reason why it holds."""

    name: Name
    mode: Name
    holder: Name = ""
    holder_name: Name = ""
    state: Name = ""
    hold_reason: Name = ""
    receive_to_step: Quantiles | None = None
    queue: tuple[Name, ...] = ()


class RecorderReport(msgspec.Struct, frozen=True):
    """State of the recorder: `off` (nothing is recorded), `running`, `hangs` (silent for 5 s), `dead` (being replaced),
    `failed` (the file cannot be written) or `ended` (its budget is used up). `disk_free_bytes` 0: not known.
    `spilled_bytes`: what waits in memory for a recorder that is behind. `text`: its last message, for people.
    `bytes_per_hour`: what the recording costs an hour at the rate of the last half minute; 0: not known yet.
    """

    state: Name = "off"
    path: Text = ""
    bytes_written: Count = 0
    disk_free_bytes: Count = 0
    lost_rows: Count = 0
    spilled_bytes: Count = 0
    text: Text = ""
    bytes_per_hour: Count = 0


class MediaStreamReport(msgspec.Struct, frozen=True):
    """One media stream, at its best class. `source`: its publisher's name, empty for the session's own process.
    `subscribers`: participants that subscribed to it. `encoding`, `age_ms`: of the newest frame; its age since the
    session received it. `title`, `audience`, `fault`, `detail`, `stale`: as in `StreamBudget`.
    """

    stream: Name
    hz: float = 0.0
    mbit_per_s: float = 0.0
    source: Name = ""
    subscribers: Count = 0
    encoding: Name = MediaEncoding.BYTES
    age_ms: float = 0.0
    title: Text = ""
    audience: Name = StreamAudience.ALL
    fault: Name = ""
    detail: Text = ""
    stale: bool = False


class AssetsReport(msgspec.Struct, frozen=True):
    """The assets channel. `served`: assets of the present scene. Since the front began: `bytes_sent`, `requests`, and
    `refusals`, of requests and connections. `waiting`: connections with an unanswered request.
    """

    served: Count = 0
    bytes_sent: Count = 0
    requests: Count = 0
    refusals: Count = 0
    waiting: Count = 0


class StatusReport(Message, frozen=True, tag="status_report"):
    """Answer to `GetStatus`. Shares are of the last ten seconds unless their name has `total`.

    `late_causes`: late ticks by the part that took the time (`LateCause`), and `skipped` for those left out after a
    long gap. `lateness`: of ticks, after their deadline. `step_to_publish`: end of tick to the state socket, of the
    last five seconds; null below 25 states in them. `drops`: by reason, all messages dropped anywhere. `restarts`: of
    front and recorder. `authority_silent_ns`: since the authority's last message to the front; its part (ticks, roster,
    robots, recorder) is as old. -1: it has sent none yet. `cpu_share`: of one processor, by the authority's process;
    `load`: of the machine, over a minute. `stops`: the e-stops in force, newest first, the newest of each participant.
    `pause_reason`: why physics stands still until a reset, empty otherwise. `unverified`: pairs of headsets.
    `paused_by`: name of who paused, empty while it runs, or where that was before a restart.
    """

    request_id: Count
    session_id: Name
    session_name: Name
    session_time: Nanoseconds
    tick: Count = 0
    tick_period_ns: Nanoseconds = 0
    paused: bool = False
    estop: bool = False
    stalled: bool = False
    scheduling: Name = ""
    late_share: float = 0.0
    late_share_total: float = 0.0
    lateness: Quantiles | None = None
    late_causes: dict[str, int] = msgspec.field(default_factory=dict)
    step_to_publish: Quantiles | None = None
    cpu_share: float = 0.0
    load: float = 0.0
    cpus: Count = 0
    memory_bytes: Count = 0
    participants: tuple[ParticipantReport, ...] = ()
    robots: tuple[RobotReport, ...] = ()
    recorder: RecorderReport | None = None
    drops: dict[str, int] = msgspec.field(default_factory=dict)
    restarts: dict[str, int] = msgspec.field(default_factory=dict)
    connections: Count = 0
    entries_per_s: float = 0.0
    warnings: tuple[Text, ...] = ()
    authority_silent_ns: Nanoseconds = -1
    media: tuple[MediaStreamReport, ...] = ()
    anchors: tuple[AnchorReport, ...] = ()
    cross_checks: tuple[CrossCheckReport, ...] = ()
    assets: AssetsReport | None = None
    stops: tuple[StopReport, ...] = ()
    pause_reason: Text = ""
    unverified: tuple[UnverifiedReport, ...] = ()
    paused_by: Text = ""
