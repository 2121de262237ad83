"""Configuration (`HeadsetSpec`) and report (`HeadsetReport`) of an emulated headset. Plain data."""

from __future__ import annotations

import msgspec

from anchors.pose import PoseTuple, Vec3
from iris_session.client.stream_meter import StreamMeasurement
from iris_session.emulator.behaviours.plan import HandoverPlan
from iris_session.emulator.headset import DEFAULT_ANCHOR_ID, DEFAULT_SHEET_M, DEFAULT_T_WORLD_ANCHOR, HeadsetModel
from iris_session.protocol.names import Device

#: Behaviour of an observer.
OBSERVER = "observer"
#: Behaviours that never end by themselves.
ENDLESS = ("wander", "idle")


class HandTask(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The task of one hand: `behaviour` (a name of `emulator.behaviours`) with `device` on `robot`.

    `object`, `partner`: the object that is handed over, and the other robot. `arm`: kind of both robots
    (`behaviours.objects`).
    `place`: position at which a receiver lays the object, x and y [m, world]. `plan`: of the handover of an object that
    is not one of these; it is kept then.
    """

    behaviour: str
    robot: str
    device: str = Device.CONTROLLER_RIGHT
    object: str = "hammer"
    partner: str = ""
    arm: str = "arm"
    place: tuple[float, float] | None = None
    plan: HandoverPlan | None = None


class HeadsetSpec(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One emulated headset and its operator or observer.

    `behaviour`: `observer`, or a name of `emulator.behaviours`; then it drives `robot` with `device`. An
    operator of two robots has `hands` instead, and acquires all their robots or none.
    `eye`: position of the head while working [m, world]. `gaze`: the point that it faces then, default the sheet;
    `glance_every_s`: period of glances of `glance_s` at the sheet meanwhile, 0 for none. `T_world_anchor`: the true
    pose of the sheet, which may differ from the one that the session assumes. `recentre_at_s`, `bump_at_s`,
    `doff_at_s`,
    `don_at_s`: seconds after joining at which the tracking frame jumps, jumps undetected by the headset (by `bump_m`
    and `bump_yaw_rad` about the head), the headset is taken off, and put on again. `drift_m_per_min`: of the tracking
    frame between the orders `drift` and `steady`; until then that of `model`. `display_delay_s`: age of the displayed
    state: interpolation delay plus the path to the headset. `streams`: media streams to which it subscribes when the
    session has them, and which it measures. `stays`: it is in the session until its process is ended, also after its
    task: an episode ends with its people. `identity_file`: keeps the identity across restarts.
    `curve_server`, `curve_key`: files with the session's public CURVE key and our own secret one; needed off loopback.
    """

    name: str
    behaviour: str = OBSERVER
    robot: str = ""
    object: str = "hammer"
    partner: str = ""
    arm: str = "arm"
    place: tuple[float, float] | None = None
    plan: HandoverPlan | None = None
    device: str = Device.CONTROLLER_RIGHT
    hands: tuple[HandTask, ...] = ()
    seed: int = 0
    model: HeadsetModel = HeadsetModel()
    eye: Vec3 = (0.0, -0.95, 0.55)
    anchor_id: str = DEFAULT_ANCHOR_ID
    T_world_anchor: PoseTuple = DEFAULT_T_WORLD_ANCHOR
    sheet_m: float = DEFAULT_SHEET_M
    viewpoints: int = 6
    observations_per_viewpoint: int = 6
    display_delay_s: float = 0.035
    recentre_at_s: tuple[float, ...] = ()
    bump_at_s: tuple[float, ...] = ()
    bump_m: Vec3 = (0.05, 0.0, 0.0)
    bump_yaw_rad: float = 0.0
    drift_m_per_min: float = 0.03
    gaze: Vec3 | None = None
    glance_every_s: float = 0.0
    glance_s: float = 2.0
    doff_at_s: float | None = None
    don_at_s: float | None = None
    phase_timeout_s: float = 30.0
    streams: tuple[str, ...] = ()
    stays: bool = False
    identity_file: str = ""
    curve_server: str = ""
    curve_key: str = ""

    @property
    def observer(self) -> bool:
        return self.behaviour == OBSERVER and not self.hands

    @property
    def endless(self) -> bool:
        """True if no task ends by itself."""
        return all(task.behaviour in ENDLESS for task in self.tasks)

    @property
    def tasks(self) -> tuple[HandTask, ...]:
        """Tasks of the hands, empty for an observer. The robot is empty where the session's policy chooses it."""
        if self.hands or self.observer:
            return self.hands
        return (
            HandTask(
                behaviour=self.behaviour,
                robot=self.robot,
                device=self.device,
                object=self.object,
                partner=self.partner,
                arm=self.arm,
                place=self.place,
                plan=self.plan,
            ),
        )


class HeadsetReport(msgspec.Struct, kw_only=True):
    """State and results of one headset. Alignment errors are relative to the true poses that only the emulator knows.

    `alignment_error_mm`: at the sheet; `alignment_error_1m_mm`: the worst of points 1 m around it. `age_ms_*`: from
    the end of the tick to the callback of this process. `rejected`: samples that the session rejected, by reason.
    `alignment_version`: version of the measured alignment. `T_true_shown`: a point that the session has at x is
    shown at `T_true_shown * x` of the true world; `None` while not aligned. `disturbed_ns`: session time of the last of
    each kind.
    `alarms`: alarms of this alignment that were received, without jumps. `session`, `address`: the session that it
    joined. `lost_s`: seconds since the connection to it was lost, 0 while there is one. `streams`: of `spec.streams`,
    those that the session has.
    """

    name: str
    participant: str = ""
    session: str = ""
    address: str = ""
    lost_s: float = 0.0
    phase: str = "join"
    done: bool = False
    failed: str = ""
    joined_s: float = 0.0
    aligned_s: float = 0.0
    alignment_error_mm: float = float("nan")
    alignment_error_1m_mm: float = float("nan")
    alignment_error_deg: float = float("nan")
    stated_error_mm: float = float("nan")
    alignment_version: int = 0
    T_true_shown: PoseTuple | None = None
    disturbed_ns: dict[str, int] = {}
    alarms: int = 0
    observations: int = 0
    samples: int = 0
    samples_not_sent: int = 0
    rejected: dict[str, int] = {}
    reclutches: int = 0
    frames: int = 0
    age_ms_p50: float = float("nan")
    age_ms_p99: float = float("nan")
    clock_error_ms: float = float("nan")
    reconnects: int = 0
    handovers: int = 0
    phases: dict[str, float] = {}
    mirror_hash: str = ""
    event_seq: int = 0
    streams: tuple[StreamMeasurement, ...] = ()
