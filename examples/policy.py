"""Join a policy as a participant: acquire a robot, move its end effector in a circle, leave.

iris-session serve handover            then: python examples/policy.py [HOST:PORT] [SECONDS]
"""

from __future__ import annotations

import math
import sys

from iris_session import Client, ClientError


def main(address: str, seconds: float) -> None:
    with Client(address, role="agent", name="policy", devices="target") as client:
        robot = client.acquire()[0].target  # no name: the assignment policy of the session chooses
        client.wait_for(lambda c: c.scene.tip_pose(robot) is not None)
        tip = client.scene.tip_pose(robot)
        assert tip is not None, "no state arrived within 5 s"
        (x, y, z), q = tip
        begun = client.session_now_ns()
        while (t := (client.session_now_ns() - begun) * 1e-9) < seconds:
            angle, radius = 0.8 * t, 0.05 * min(1.0, t)
            target = (x + radius * math.cos(angle), y + radius * math.sin(angle), z)
            client.send_target(robot, (target, q))  # opens the clutch and closes it again after a disturbance
            client.sleep(1 / 60)
        moved, _ = client.scene.tip_pose(robot) or tip
        rejected = client.feedback[robot].rejected
        print(f"{robot}: tip moved {1e3 * math.dist(moved, (x, y, z)):.0f} mm, rejected samples: {rejected}")


if __name__ == "__main__":
    try:
        main(sys.argv[1] if len(sys.argv) > 1 else "127.0.0.1:7721", float(sys.argv[2]) if len(sys.argv) > 2 else 20.0)
    except ClientError as error:
        raise SystemExit(f"policy: {error}") from None
