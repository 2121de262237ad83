"""Emulated headsets for `AlignmentService`: the noise model of docs/anchors.md, seeded, with a simulated clock."""

from __future__ import annotations

from dataclasses import dataclass

import msgspec
import numpy as np

from anchors.lie import to_vec3
from anchors.pose import PoseTuple, Vec3, compose, inverse, quat_from_yaw
from iris_session.alignment.service import AlignmentService
from iris_session.protocol.client_messages import Observation, Sample
from iris_session.protocol.common import Alignment, Pose
from iris_session.protocol.entries import AlignmentAlarm, AlignmentProposal, CrossChecked, Entry
from iris_session.protocol.limits import Drops
from iris_session.protocol.server_messages import AlignmentChanged
from tests.anchors.worlds import Viewpoint, shifted, tracking_frame, viewpoint_around

MS = 1_000_000
SECOND = 1_000 * MS
SHEET: PoseTuple = ((0.2, -0.4, 0.75), quat_from_yaw(0.5))
OTHER: PoseTuple = ((1.0, 0.3, 0.75), quat_from_yaw(-2.0))
ANCHORS = {"sheet": SHEET, "other": OTHER}
PERIOD_NS = 100 * MS  # 10 observations a second


@dataclass(frozen=True)
class FakeConnection:
    """A `HeadsetConnection`."""

    number: int
    participant_id: str


class Wearer:
    """One headset. `frame` is the true `T_world_tracking`, which a test may change without a new epoch. Its camera sees
    everything too far away by the share `too_far`."""

    too_far = 0.0

    def __init__(self, lab: Lab, number: int, seed: int) -> None:
        self.lab = lab
        self.rng = np.random.default_rng(seed)
        self.frame = tracking_frame(self.rng)
        self.connection = FakeConnection(number, f"p{number}")
        self.viewpoint = self.seq = 0
        self.epoch = 1

    def place(self, anchor: str = "sheet", d: float = 0.7, p_head_world: Vec3 | None = None) -> Viewpoint:
        """Move to a new viewpoint."""
        self.viewpoint += 1
        self.lab.now_ns += 3 * SECOND
        T = self.lab.world[anchor]
        return Viewpoint(self.rng, T, p_head_world or viewpoint_around(self.rng, T[0], d))

    def report_observation(
        self, view: Viewpoint, anchor: str = "sheet", kind: str = "qr", head: bool = True, source: str = ""
    ) -> None:
        """Send one observation and the head pose of that time."""
        if head:
            self.report_head(head_in_tracking(self.frame, view))
        p, q = view.observe(self.frame, self.lab.world.get(anchor))
        head_p = np.array(view.head_pose(self.frame))
        p = to_vec3(head_p + (1.0 + self.too_far) * (np.array(p) - head_p))
        self.observe(Observation(anchor, kind, Pose(p, q), self.lab.now_ns, self.epoch, self.viewpoint, source=source))

    def observe(self, observation: Observation) -> None:
        self.lab.service.process_observation(self.connection, observation, self.lab.now_ns)

    def report_head(self, T_tracking_head: PoseTuple) -> None:
        self.seq += 1
        pose = Pose(*T_tracking_head)
        sample = Sample("head", "pose", self.seq, self.lab.now_ns, 1, self.epoch, 0, pose=pose)
        self.lab.service.process_sample(self.connection, sample, self.lab.now_ns)

    def report_observations(self, view: Viewpoint, n: int, anchor: str = "sheet") -> None:
        for _ in range(n):
            self.lab.now_ns += PERIOD_NS
            self.report_observation(view, anchor)
            self.lab.poll()

    def survey(self, viewpoints: int = 3, anchors: tuple[str, ...] = ("sheet",)) -> None:
        """Observe the sheets from several sides and put the resulting proposal in force."""
        for _ in range(viewpoints):
            for anchor in anchors:
                self.report_observations(self.place(anchor), 15, anchor)
        self.accept()

    def accept(self) -> AlignmentProposal:
        """Put the newest proposal in force, as the authority does."""
        newest = self.proposals()[-1]
        self.lab.confirm(self, newest)
        return newest

    def bump(self, x: float, y: float = 0.0, z: float = 0.0) -> None:
        """Move the frame without a new tracking epoch."""
        self.frame = shifted(self.frame, (x, y, z))

    def proposals(self) -> list[AlignmentProposal]:
        messages = [e.message for e in self.entries()]
        return [m for m in messages if isinstance(m, AlignmentProposal) and not m.refused]

    def alarms(self) -> list[AlignmentAlarm]:
        return [e.message for e in self.entries() if isinstance(e.message, AlignmentAlarm)]

    def entries(self) -> list[Entry]:
        return [e for e in self.lab.entries if e.connection == self.connection.number]


class Lab:
    """An `AlignmentService` and the true poses of the anchors (`world`)."""

    def __init__(
        self,
        anchors: dict[str, PoseTuple] = ANCHORS,
        sizes: dict[str, float] | None = None,
        marks: dict[str, dict[str, Vec3]] | None = None,
    ) -> None:
        self.now_ns = SECOND
        self.entries: list[Entry] = []
        self.drops = Drops()
        self.world = dict(anchors)
        poses = {name: Pose(*T) for name, T in anchors.items()}
        self.service = AlignmentService(
            self._offer, self.drops, anchors=poses, anchor_sizes=sizes or {}, anchor_marks=marks or {}
        )

    def _offer(self, entry: Entry) -> bool:
        self.entries.append(entry)
        return True

    def wearer(self, number: int = 1, seed: int | None = None) -> Wearer:
        return Wearer(self, number, number if seed is None else seed)

    def poll(self, times: int = 8) -> None:
        """Run several passes of the front's loop; each computes one proposal at most."""
        for _ in range(times):
            self.now_ns += MS
            self.service.tick(self.now_ns)

    def confirm(self, wearer: Wearer, got: AlignmentProposal, **fields: object) -> None:
        alignment = Alignment(
            1,
            "measured",
            got.T_world_tracking,
            got.tracking_epoch,
            got.covariance,
            got.error_at_anchor_m,
            pivot_world=got.pivot_world,
        )
        alignment = msgspec.structs.replace(alignment, **fields)
        self.service.process_event(AlignmentChanged(wearer.connection.participant_id, alignment))

    def cross_checks(self) -> list[Entry]:
        return [e for e in self.entries if isinstance(e.message, CrossChecked)]


def head_in_tracking(frame: PoseTuple, view: Viewpoint) -> PoseTuple:
    return compose(inverse(frame), (view.p_head_world, (1.0, 0.0, 0.0, 0.0)))


def error_at_anchor(wearer: Wearer, proposal: AlignmentProposal, anchor: str = "sheet") -> float:
    """Return the error [m] of this proposal at an anchor."""
    p = wearer.lab.world[anchor][0]
    pose = proposal.T_world_tracking
    seen = compose(inverse(wearer.frame), (p, (1.0, 0.0, 0.0, 0.0)))
    placed = compose((pose.p, pose.q), seen)[0]
    return float(np.linalg.norm(np.subtract(placed, p)))
