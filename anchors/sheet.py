"""The printed sheet: a QR code with the anchor id, framed by four square markers, as one board of known corners.

Headsets track the code natively and report its edge and centre. Cameras find the markers from much further away, and
measure the pose over the whole page. Every length is a fixed share of the edge of the code, so id and edge determine
the sheet, independent of the paper. Which markers it has follows from a hash of the id: sheets are distinguished
even where the code cannot be read. A sheet with marks has four crosses around the frame, to be pricked and touched with
the tip of a controller, by devices that cannot read the code.

Sheet frame: origin in the centre of the code, x right, y up, z out of the paper towards the viewer [m].
PDF and SVG output: `anchors.sheet_print`.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from types import MappingProxyType
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from anchors.pose import Vec3

Array = NDArray[np.float64]

#: White around a code, in modules, on all four sides: ISO/IEC 18004, and Microsoft for HoloLens 2.
QUIET_MODULES: Final = 4
#: Modules of the smallest version of QR codes: its modules, and so its white, are the largest share of the edge.
FEWEST_MODULES: Final = 21
#: Headsets read codes from here on: HoloLens 2, as Microsoft states it [m]; none is stated for Quest 3.
HEADSET_MIN_EDGE_M: Final = 0.050


@dataclass(frozen=True)
class Layout:
    """Places of markers and marks, in shares of the code's edge from its centre. Layouts that were printed stay."""

    number: int
    marker_edge: float
    half_width: float  # to the outer edges of the markers
    half_height: float
    marks: Mapping[str, tuple[float, float]]  # crosses by id, in an order in which the four look the same in no other
    marked_half_width: float  # to the outer ends of the crosses
    marked_half_height: float
    salt: bytes  # of the hash that picks the markers: those of two layouts differ

    @property
    def white(self) -> float:
        """White above and below the code."""
        return self.half_height - self.marker_edge - 0.5


#: Layout 1 left two modules of white. Since layout 2 there are four whatever the id, at 152 mm on A4: then markers, and
#: above and below them the 6 mm that printers leave, take all of its height, and the white takes all of its width.
LAYOUTS: Final = MappingProxyType(
    {
        2: Layout(
            number=2,
            marker_edge=0.244,
            half_width=0.60,
            half_height=0.935,
            marks=MappingProxyType({"1": (-0.66, 0.94), "2": (0.15, 0.97), "3": (0.66, -0.94), "4": (-0.66, -0.94)}),
            marked_half_width=0.69,
            marked_half_height=1.00,
            salt=b"iris-session sheet 2\0",
        ),
        1: Layout(
            number=1,
            marker_edge=0.29,
            half_width=0.60,
            half_height=0.89,
            marks=MappingProxyType({"1": (-0.66, 0.94), "2": (0.66, 0.94), "3": (0.66, -0.40), "4": (-0.66, -0.94)}),
            marked_half_width=0.69,
            marked_half_height=0.97,
            salt=b"iris-session sheet 1\0",
        ),
    }
)
NEWEST_LAYOUT: Final = 2
MARK_ARM: Final = 0.025  # from the crossing to the end of a line
#: ArUco, 4 x 4 bits inside a border of one: the largest modules for a given edge, so the longest range. The code has
#: no error correction to speak of; a sheet is known by several markers in the right places instead.
DICTIONARY: Final = "DICT_4X4_1000"
DICTIONARY_SIZE: Final = 1000
MARKER_MODULES: Final = 6
MARKERS: Final = 4
MAX_ID: Final = 64  # characters, as in the protocol
MIN_EDGE_M: Final = 0.02
MAX_EDGE_M: Final = 2.0


class SheetError(ValueError):
    """An invalid sheet or paper."""


@dataclass(frozen=True)
class Rect:
    """An axis-aligned black rectangle in the sheet frame [m]: lower left corner and extent."""

    x: float
    y: float
    width: float
    height: float


@dataclass(frozen=True)
class Sheet:
    """One printed anchor. `edge_m`: edge of the QR code, without its quiet zone. `has_marks`: with four crosses.
    `layout`: number of its `Layout`."""

    anchor_id: str
    edge_m: float
    has_marks: bool = False
    layout: int = NEWEST_LAYOUT

    def __post_init__(self) -> None:
        if not (0 < len(self.anchor_id) <= MAX_ID and self.anchor_id.isascii() and self.anchor_id.isprintable()):
            raise SheetError(
                f"{self.anchor_id!r} cannot be the id of a sheet: 1 to {MAX_ID} printable ASCII characters, "
                "which every reader of QR codes understands alike"
            )
        if not MIN_EDGE_M <= self.edge_m <= MAX_EDGE_M:
            raise SheetError(
                f"a code of {1e3 * self.edge_m:g} mm cannot be: {1e3 * MIN_EDGE_M:g} to {1e3 * MAX_EDGE_M:g} mm"
            )
        if self.layout not in LAYOUTS:
            raise SheetError(f"no layout {self.layout!r} of sheets: {', '.join(map(str, sorted(LAYOUTS)))}")

    @property
    def shape(self) -> Layout:
        return LAYOUTS[self.layout]

    @cached_property
    def marker_ids(self) -> tuple[int, ...]:
        """Markers of the frame: upper left, upper right, lower right, lower left. All different, by SHA-256 of the id.

        Two sheets have all four in common once in 4e10; a single one in 1.6 % of the pairs, which geometry resolves.
        """
        digest = hashlib.sha256(self.shape.salt + self.anchor_id.encode()).digest()
        candidates = (int.from_bytes(digest[k : k + 2], "big") % DICTIONARY_SIZE for k in range(0, len(digest), 2))
        return tuple(dict.fromkeys(candidates))[:MARKERS]

    @property
    def marker_edge_m(self) -> float:
        return self.shape.marker_edge * self.edge_m

    @property
    def size_m(self) -> tuple[float, float]:
        """Width and height of everything black."""
        width, height = half_extent(self.shape, self.has_marks)
        return 2.0 * width * self.edge_m, 2.0 * height * self.edge_m

    @property
    def marks(self) -> dict[str, Vec3]:
        """Positions of the crossings by id [m]; none on a sheet without marks."""
        return compute_marks(self.edge_m, self.layout) if self.has_marks else {}

    @cached_property
    def marker_corners(self) -> Array:
        """Corners of the markers, shape (4, 4, 3) [m]: marker, corner (clockwise from the upper left, as OpenCV)."""
        w, h, m = self.shape.half_width * self.edge_m, self.shape.half_height * self.edge_m, self.marker_edge_m
        left = ((-w, h), (w - m, h), (w - m, m - h), (-w, m - h))
        corners = [[(x, y, 0.0), (x + m, y, 0.0), (x + m, y - m, 0.0), (x, y - m, 0.0)] for x, y in left]
        return _freeze(np.array(corners))

    @cached_property
    def code_corners(self) -> Array:
        """Corners of the code, shape (4, 3) [m], clockwise from the upper left."""
        e = 0.5 * self.edge_m
        return _freeze(np.array([(-e, e, 0.0), (e, e, 0.0), (e, -e, 0.0), (-e, -e, 0.0)]))

    @cached_property
    def code(self) -> NDArray[np.bool_]:
        """Modules of the QR code, True where black, first row on top: the smallest version at error correction M, or
        better where free."""
        import segno

        return np.array(segno.make(self.anchor_id, micro=False, error="m").matrix, dtype=np.bool_)

    def list_black_rects(self) -> dict[str, list[Rect]]:
        """Return the black rectangles of the `code` and of each marker (`marker 0` to `marker 3`)."""
        import cv2

        shapes = {"code": _merge_runs(self.code, self.code_corners[0], self.edge_m)}
        for number, marker_id in enumerate(self.marker_ids):
            corner = self.marker_corners[number][0]
            picture: Any = cv2.aruco.generateImageMarker(load_dictionary(), marker_id, MARKER_MODULES)
            shapes[f"marker {number}"] = _merge_runs(np.asarray(picture) == 0, corner, self.marker_edge_m)
        return shapes


def compute_marks(edge_m: float, layout: int = NEWEST_LAYOUT) -> dict[str, Vec3]:
    """Return the positions of the marks of a sheet by id, in the sheet frame [m], to the micrometre."""
    return {name: (round(x * edge_m, 6), round(y * edge_m, 6), 0.0) for name, (x, y) in LAYOUTS[layout].marks.items()}


def half_extent(layout: Layout, has_marks: bool) -> tuple[float, float]:
    """Return half width and half height of everything black, in edges of the code."""
    if has_marks:
        return layout.marked_half_width, layout.marked_half_height
    return layout.half_width, layout.half_height


def load_dictionary() -> Any:
    """Return OpenCV's marker dictionary of all sheets."""
    import cv2

    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, DICTIONARY))


def _merge_runs(modules: NDArray[np.bool_], upper_left: Array, edge_m: float) -> list[Rect]:
    """Return black modules as rectangles, adjacent ones of a row as one."""
    n = len(modules)
    m = edge_m / n
    rects: list[Rect] = []
    for i, row in enumerate(modules):
        edges = np.flatnonzero(np.diff(np.concatenate([[False], row, [False]]).astype(np.int8)))
        for a, b in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True):
            rects.append(Rect(float(upper_left[0]) + a * m, float(upper_left[1]) - (i + 1) * m, (b - a) * m, m))
    return rects


def _freeze(a: Array) -> Array:
    a.setflags(write=False)
    return a
