"""Measure the processor time of publishing a state, in the thread of the publisher and in the session.

python tools/publish_cost.py --bodies 300 --vertices 10000 --record
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path

import numpy as np

from iris_session import SceneBuilder, ScenePublisher, SessionConfig

#: Below the rate of the state, so every state goes out in the thread that publishes it.
HZ = 50


def compose(bodies: int, rows: int) -> tuple[SceneBuilder, np.ndarray]:
    """Return boxes and a cloth of rows x rows vertices."""
    scene = SceneBuilder("cost")
    for i in range(bodies):
        scene.add_box(f"box {i}", half_size=(0.05, 0.05, 0.05), movable=True)
    x, y = np.meshgrid(*[np.linspace(0.0, 1.0, max(rows, 2))] * 2)
    cloth = np.stack([x, y, np.ones_like(x)], -1).reshape(-1, 3)
    n = np.arange(len(cloth)).reshape(x.shape)
    a, b, c, d = (part.ravel() for part in (n[:-1, :-1], n[:-1, 1:], n[1:, 1:], n[1:, :-1]))
    if rows:
        scene.add_deformable("cloth", cloth, np.concatenate([np.stack([a, b, c], -1), np.stack([a, c, d], -1)]))
    return scene, cloth


def report(what: str, taken_ns: list[int]) -> None:
    low, median, high = np.percentile(taken_ns, [0, 50, 99]) * 1e-3
    print(f"{what:32s} least {low:8.1f} us, median {median:8.1f} us, p99 {high:8.1f} us")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--bodies", type=int, default=300, help="all of which move; 300")
    parser.add_argument("--vertices", type=int, default=0, help="of a cloth that waves; 0")
    parser.add_argument("--seconds", type=float, default=10.0, help="10")
    parser.add_argument("--record", action="store_true", help="with a recording, whose rows have the poses")
    given = parser.parse_args()
    scene, cloth = compose(given.bodies, round(given.vertices**0.5))
    names = [f"box {i}" for i in range(given.bodies)]
    p, q = np.random.default_rng(0).random((given.bodies, 3)), np.tile([1.0, 0.0, 0.0, 0.0], (given.bodies, 1))
    kinds = ("set_poses", "set_vertices", "publish, goes out", "publish, superseded")
    times: dict[str, list[int]] = {kind: [] for kind in kinds}

    def timed(what: str, call: object, *arguments: object) -> None:
        begun = time.thread_time_ns()
        call(*arguments)  # type: ignore[operator]
        times[what].append(time.thread_time_ns() - begun)

    with tempfile.TemporaryDirectory() as folder:
        record = Path(folder) / "session.rrd" if given.record else False
        config = SessionConfig(control_port=0, state_port=0, beacon_port=0, record=record)
        with ScenePublisher(scene, config) as session:
            begun, whole = time.monotonic(), time.process_time()
            for round_ in range(round(given.seconds * HZ)):
                p += 0.001
                timed("set_poses", session.set_poses, names, p, q)
                if given.vertices:
                    cloth[:, 2] = 1.0 + 0.1 * np.sin(6.0 * cloth[:, 0] + round_ / HZ)
                    timed("set_vertices", session.set_vertices, "cloth", cloth)
                timed("publish, goes out", session.publish)
                time.sleep(max(0.0, begun + round_ / HZ - time.monotonic()))
            share = (time.process_time() - whole) / (time.monotonic() - begun)
            for _ in range(1000):
                timed("publish, superseded", session.publish)
        size = record.stat().st_size if isinstance(record, Path) else 0
    for what, taken in times.items():
        if taken:
            report(what, taken)
    print(f"{given.bodies} bodies, {len(cloth) if given.vertices else 0} vertices, {HZ} Hz: {share:.1%} of a processor")
    if size:
        print(f"recording: {size / given.seconds * 1e-6:.2f} MB/s")


if __name__ == "__main__":
    main()
