"""Measure the detection of sheets by distance, tilt and resolution: found, position and angle error, milliseconds.

    python tools/detection_table.py            the table of docs/evidence/detection.md, as Markdown
    python tools/detection_table.py --json     the same as one JSON object

Renders a sheet as PDF, rasterises it, photographs it from random directions (`render_sheet.py`), and detects it: the
whole sheet, and for comparison the code alone with OpenCV.
"""

from __future__ import annotations

import argparse
import json
import math
import statistics
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))

from render_sheet import Conditions, Page, photograph

from anchors.camera import CameraModel
from anchors.detection import SheetDetection, SheetDetector, detect_codes
from anchors.pose import PoseTuple, compose, distance, quat_angle, quat_conj, quat_from_rotvec, quat_mul, quat_to_rotvec
from anchors.sheet import NEWEST_LAYOUT, Sheet
from anchors.sheet_print import to_pdf

#: 640 x 480 with the intrinsics of a real depth camera, and an ordinary lens; 1280 x 960 is the same, read out finer.
CAMERA = CameraModel(640, 480, 585.0, 585.0, 319.5, 239.5, (0.08, -0.18, 0.0008, -0.0005, 0.0))
CHI2_6_95 = 12.592  # 95 % quantile of chi-square with 6 degrees of freedom


@dataclass
class Cell:
    """Results at one distance, tilt and resolution. Errors in mm and deg."""

    tried: int = 0
    mm: list[float] = field(default_factory=list)
    deg: list[float] = field(default_factory=list)
    ms: list[float] = field(default_factory=list)
    inside: list[bool] = field(default_factory=list)
    ambiguous: int = 0

    def add(self, seen: list[SheetDetection], true: PoseTuple, ms: float) -> None:
        self.tried += 1
        self.ms.append(ms)
        for one in seen[:1]:
            if one.ambiguous:
                self.ambiguous += 1
                continue
            at = one.T_camera_sheet
            self.mm.append(1e3 * distance(at[0], true[0]))
            self.deg.append(math.degrees(quat_angle(at[1], true[1])))
            turn = quat_to_rotvec(quat_mul(at[1], quat_conj(true[1])))
            d = np.concatenate([np.subtract(at[0], true[0]), turn])
            self.inside.append(bool(d @ np.linalg.solve(np.reshape(one.covariance, (6, 6)), d) < CHI2_6_95))

    def row(self) -> dict[str, Any]:
        def median(values: list[float]) -> float | None:
            return round(statistics.median(values), 3) if values else None

        return {
            "found": len(self.mm),
            "tried": self.tried,
            "ambiguous": self.ambiguous,
            "mm_p50": median(self.mm),
            "mm_max": round(max(self.mm), 3) if self.mm else None,
            "deg_p50": median(self.deg),
            "deg_max": round(max(self.deg), 3) if self.deg else None,
            "coverage_95": round(sum(self.inside) / len(self.inside), 3) if self.inside else None,
            "ms_p50": median(self.ms),
        }


def pose_at(distance_m: float, tilt_deg: float, rng: np.random.Generator) -> PoseTuple:
    """A sheet near the middle of the picture, its normal tilted from the line of sight in a random direction."""
    p = (distance_m * rng.uniform(-0.1, 0.1), distance_m * rng.uniform(-0.08, 0.08), distance_m)
    # Faces the camera, square to the line of sight, at a random roll.
    view = np.array(p) / np.linalg.norm(p)
    towards = np.cross([0.0, 0.0, 1.0], view)
    angle, roll = rng.uniform(0.0, 2.0 * math.pi, 2)
    tilt = math.radians(tilt_deg)
    turns = [
        (math.asin(min(float(np.linalg.norm(towards)), 1.0)) * towards / max(float(np.linalg.norm(towards)), 1e-12)),
        np.array([tilt * math.cos(angle), tilt * math.sin(angle), 0.0]),
        np.array([0.0, 0.0, roll]),
        np.array([math.pi, 0.0, 0.0]),
    ]
    pose: PoseTuple = ((0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))
    for x, y, z in turns:
        pose = compose(pose, ((0.0, 0.0, 0.0), quat_from_rotvec((float(x), float(y), float(z)))))
    return (float(p[0]), float(p[1]), float(p[2])), pose[1]


def measure(arguments: argparse.Namespace) -> list[dict[str, Any]]:
    """One row per resolution, distance and tilt."""
    import cv2

    cv2.setNumThreads(1)
    sheet = Sheet("table", arguments.size_mm / 1000.0, layout=arguments.layout)
    page = Page(to_pdf(sheet))
    rng = np.random.default_rng(arguments.seed)
    conditions = Conditions(blur_px=arguments.blur_px, noise=arguments.noise)
    rows = []
    for width in arguments.widths:
        camera = CAMERA.scaled(width, width * 3 // 4)
        detector = SheetDetector([sheet], camera)
        for distance_m in arguments.distances:
            for tilt in arguments.tilts:
                cells = {"sheet": Cell(), "code": Cell()}
                for _ in range(arguments.repeats):
                    true = pose_at(distance_m, tilt, rng)
                    picture = photograph([(page, true)], camera, conditions, rng)
                    start = time.perf_counter()
                    seen = detector.detect(picture)
                    middle = time.perf_counter()
                    code = detect_codes(picture, camera, {sheet.anchor_id: sheet.edge_m})
                    end = time.perf_counter()
                    cells["sheet"].add(seen, true, 1e3 * (middle - start))
                    cells["code"].add(code, true, 1e3 * (end - middle))
                rows.append(
                    {"width": width, "height": camera.height, "distance_m": distance_m, "tilt_deg": tilt}
                    | {name: cell.row() for name, cell in cells.items()}
                )
    return rows


def markdown(rows: list[dict[str, Any]]) -> str:
    def cell(row: dict[str, Any]) -> str:
        if not row["found"]:
            return f"0/{row['tried']} | | "
        error = f"{row['mm_p50']:.2f} ({row['mm_max']:.2f}) | {row['deg_p50']:.2f} ({row['deg_max']:.2f})"
        return f"{row['found']}/{row['tried']} | {error}"

    lines = [
        "| pixels | distance | tilt | sheet found | mm, median (worst) | deg | ms | code found | mm | deg |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    lines += [
        f"| {row['width']} x {row['height']} | {row['distance_m']:g} m | {row['tilt_deg']:g} deg | "
        f"{cell(row['sheet'])} | {row['sheet']['ms_p50']:.0f} | {cell(row['code'])} |"
        for row in rows
    ]
    return "\n".join(lines)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--widths", type=int, nargs="+", default=[640, 1280], help="of the picture [px]; 4:3")
    parser.add_argument("--distances", type=float, nargs="+", default=[0.5, 1.0, 2.0, 3.0], help="[m]")
    parser.add_argument("--tilts", type=float, nargs="+", default=[0.0, 30.0, 60.0], help="from square on [deg]")
    parser.add_argument("--repeats", type=int, default=10, help="photographs per row")
    parser.add_argument("--size-mm", type=float, default=150.0, help="edge of the code")
    parser.add_argument("--layout", type=int, default=NEWEST_LAYOUT, help="of the sheet")
    parser.add_argument("--blur-px", type=float, default=0.6, help="standard deviation of the lens [px]")
    parser.add_argument("--noise", type=float, default=1.5, help="of a pixel, grey levels")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", action="store_true", help="print one JSON object instead of a table")
    arguments = parser.parse_args()
    rows = measure(arguments)
    if arguments.json:
        options = {key: value for key, value in vars(arguments).items() if key != "json"}
        print(json.dumps({"params": options, "rows": rows}))
    else:
        print(markdown(rows))
    return 0


if __name__ == "__main__":
    sys.exit(main())
