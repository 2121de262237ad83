"""Motion that `bench deformable` streams: a cloth of 1 m with two guided corners, simulated once by MuJoCo.

It is swung, dragged over a ball, lowered to the floor, and lifted again, so it folds and wrinkles. Simulating
100 x 100 vertices takes seven to ten minutes of a processor (a cloth vertex is a body), so the result is kept in the
user's cache folder: the first run with a seed takes that much longer.
"""

from __future__ import annotations

import math
import os
import time
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Final

import mujoco
import numpy as np
import numpy.typing as npt

from iris_session.bench.report import BenchError

HZ: Final = 60
SECONDS: Final = 6
EDGE_M: Final = 1.0
#: Initial height of the hands.
TOP_M: Final = 1.4
#: Short steps keep the cloth stiff: a constraint of MuJoCo settles within some of them.
STEPS_PER_FRAME: Final = 6
TIMESTEP_S: Final = 1.0 / (STEPS_PER_FRAME * HZ)
#: Share of an edge that one hand holds.
_GRIP: Final = 0.1
#: Version of the scene and of the file: increment it with either.
VERSION: Final = 2
#: Coordinates are kept in 16 bits: 2 m of them in steps of 0.03 mm.
_LEVELS: Final = 2**16 - 1

_SCENE: Final = """
<mujoco model="cloth">
  <option integrator="discrete" solver="CG" timestep="{timestep}" iterations="80" tolerance="1e-6"/>
  <size memory="1G"/>
  <worldbody>
    <geom type="plane" size="3 3 .1"/>
    <geom type="sphere" size=".18" pos="0.2 0 .6"/>
    <body name="left" mocap="true" pos="{left}"/>
    <body name="right" mocap="true" pos="{right}"/>
    <flexcomp name="cloth" type="grid" dim="2" count="{side} {side} 1" spacing="{spacing} {spacing} {spacing}"
              pos="0 0 {top}" radius="0.004" mass="0.3">
      <edge equality="true" solref="0.006 1"/>
      <contact selfcollide="none"/>
    </flexcomp>
  </worldbody>
  <equality>
    {grips}
  </equality>
</mujoco>
"""


@dataclass(frozen=True)
class ClothMotion:
    """Motion of a cloth at 60 Hz. `nodes` (frames, n, 3): coordinates in units of `scale` [m] from `origin` (3,) [m].
    `faces` (m, 3): vertex indices."""

    nodes: npt.NDArray[np.uint16]
    origin: npt.NDArray[np.float64]
    scale: float
    faces: npt.NDArray[np.int32]

    @property
    def n_vertices(self) -> int:
        """Number of vertices."""
        return int(self.nodes.shape[1])

    def frame_index(self, frame: int) -> int:
        """Return the index of the recorded frame for frame number `frame`: the motion runs to its end and back."""
        period = 2 * (len(self.nodes) - 1)
        return min(frame % period, period - frame % period)

    def vertices(self, index: int) -> npt.NDArray[np.float64]:
        """Return the vertices of a recorded frame, (n, 3) [m], world frame."""
        p_world: npt.NDArray[np.float64] = self.origin + self.nodes[index] * self.scale
        return p_world


def load_cloth_motion(side: int, seed: int, progress: Callable[[str], None] = lambda _: None) -> ClothMotion:
    """Return the motion of a cloth of `side` x `side` vertices: from the cache, or simulated and stored there."""
    path = _cache_folder() / f"cloth-v{VERSION}-{side}x{side}-{seed}-mujoco-{version('mujoco')}.npz"
    try:
        with path.open("rb") as file, np.load(file) as kept:  # numpy leaves a damaged file open
            return ClothMotion(kept["nodes"], kept["origin"], float(kept["scale"]), kept["faces"])
    except FileNotFoundError:
        pass
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
        progress(f"{path} cannot be read ({error}): simulating again")
    motion = simulate_cloth(side, seed, progress)
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f"{path.stem}.{os.getpid()}.part.npz")  # numpy insists on the ending
    try:
        np.savez(
            part, allow_pickle=False, nodes=motion.nodes, origin=motion.origin, scale=motion.scale, faces=motion.faces
        )
        part.replace(path)
    except OSError as error:
        part.unlink(missing_ok=True)
        progress(f"the motion cannot be cached: {error}")
    return motion


def simulate_cloth(side: int, seed: int, progress: Callable[[str], None] = lambda _: None) -> ClothMotion:
    """Simulate `SECONDS` of the cloth. The same arguments give the same motion on the same version of MuJoCo."""
    spacing = EDGE_M / (side - 1)
    hands = _Hands(seed)
    left, right = (" ".join(map(str, p)) for p in hands.positions_at(0.0))
    progress(f"simulating a cloth of {side} x {side} vertices once: this takes ten minutes for 100 x 100")
    model = mujoco.MjModel.from_xml_string(
        _SCENE.format(
            grips=_format_grips(side),
            timestep=TIMESTEP_S,
            top=TOP_M,
            left=left,
            right=right,
            side=side,
            spacing=spacing,
        )
    )
    data = mujoco.MjData(model)
    frames = np.empty((HZ * SECONDS, model.nflexvert, 3))
    began_s = time.monotonic()
    for frame in range(len(frames)):
        if frame and frame % (HZ // 2) == 0:
            left_s = (time.monotonic() - began_s) * (len(frames) / frame - 1.0)
            progress(f"{frame / HZ:g} s of {SECONDS} s are simulated, {left_s:.0f} s left")
        for _ in range(STEPS_PER_FRAME):
            data.mocap_pos[:] = hands.positions_at(data.time)
            mujoco.mj_step(model, data)
        frames[frame] = data.flexvert_xpos
    if not np.isfinite(frames).all():
        raise BenchError(
            f"the simulated cloth of {side} x {side} vertices (seed {seed}) diverged: choose another --seed"
        )
    origin = frames.min(axis=(0, 1))
    scale = float((frames.max(axis=(0, 1)) - origin).max()) / _LEVELS
    nodes = np.rint((frames - origin) / scale).astype(np.uint16)
    return ClothMotion(nodes, origin, scale, np.array(model.flex_elem, np.int32).reshape(-1, 3))


def _format_grips(side: int) -> str:
    """Return the constraints by which the hands hold the ends of the first row."""
    held = max(1, round(_GRIP * side))
    ends = (("left", range(held)), ("right", range(side - held, side)))
    return "".join(
        f'<connect body1="cloth_{vertex}" body2="{hand}" anchor="0 0 0"/>' for hand, end in ends for vertex in end
    )


class _Hands:
    """Motion of two hands that hold two corners of one edge: slow large movements plus small fast ones, from rest."""

    def __init__(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        self._phase = rng.uniform(0.0, 2.0 * math.pi, (2, 3))
        self._hz = rng.uniform(1.2, 2.2, (2, 3))

    def positions_at(self, t: float) -> npt.NDArray[np.float64]:
        """Return the positions of left and right hand at time `t` [s], (2, 3) [m]."""
        ramp = min(1.0, t)
        turn = 2.0 * math.pi * t / SECONDS
        reach = 0.35 * (1.0 - math.cos(turn))  # over the ball and back
        height = TOP_M - 0.45 * (1.0 - math.cos(turn))  # down to 0.5 m, and up again
        gap = 0.5 - 0.18 * (1.0 - math.cos(turn))
        shake = 0.05 * ramp * (np.sin(2.0 * math.pi * self._hz * t + self._phase) - np.sin(self._phase))
        base = np.array(((-0.5 + reach, -gap, height), (-0.5 + reach, gap, height)))
        return np.asarray(base + shake)


def _cache_folder() -> Path:
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "iris-session" / "bench"
