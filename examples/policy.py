"""Join a policy as a participant: acquire a robot, move its end effector in a circle, leave.

iris-session serve handover            then: python examples/policy.py [HOST:PORT] [SECONDS]
"""

from __future__ import annotations

import math
import sys

from iris_session import Client, ClientError, HoldReason

#: Holds that end only when the clutch is opened and closed again; others need no reaction.
OPEN_CLUTCH = frozenset(
    {
        HoldReason.REARM,
        HoldReason.REJECTED,
        HoldReason.STALE,
        HoldReason.GAP,
        HoldReason.SCENE_CHANGED,
        HoldReason.ESTOP,
    }
)


def may_close(client: Client, robot: str) -> bool:
    """Return whether to close the clutch: after a disturbance it must be opened first."""
    feedback = client.feedback.get(robot)
    return feedback is not None and feedback.hold_reason not in OPEN_CLUTCH


def main(address: str, seconds: float) -> None:
    with Client(address, role="agent", name="policy", devices=("target",)) as client:
        (lease,) = client.acquire()  # no name: the assignment policy of the session chooses
        robot = lease.target
        if not client.wait_for(lambda c: c.scene.tip_pose(robot) is not None):
            raise SystemExit("no state arrived within 5 s")
        tip = client.scene.tip_pose(robot)
        assert tip is not None
        (x, y, z), q = tip
        period_ns = 1_000_000_000 // 60
        begun = due = client.session_now_ns()
        while client.session_now_ns() < begun + int(seconds * 1e9):
            t = (client.session_now_ns() - begun) * 1e-9
            angle, radius = 0.8 * t, 0.05 * min(1.0, t)
            target = (x + radius * math.cos(angle), y + radius * math.sin(angle), z)
            client.send_sample("target", (target, q), robots=[robot], clutch=may_close(client, robot))
            due += period_ns
            client.sleep((due - client.session_now_ns()) * 1e-9)
        feedback = client.feedback.get(robot)
        rejected = dict(feedback.rejected) if feedback is not None else {}
        moved = client.scene.tip_pose(robot)
        assert moved is not None
        print(f"{robot}: tip moved {1e3 * math.dist(moved[0], (x, y, z)):.0f} mm, rejected samples: {rejected}")


if __name__ == "__main__":
    try:
        main(sys.argv[1] if len(sys.argv) > 1 else "127.0.0.1:7721", float(sys.argv[2]) if len(sys.argv) > 2 else 20.0)
    except ClientError as error:
        raise SystemExit(f"policy: {error}") from None
