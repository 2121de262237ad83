"""The printed sheet: ids and layout that stay valid, and PDF and SVG of exact size."""

from __future__ import annotations

import re
from itertools import pairwise
from xml.etree import ElementTree

import cv2
import numpy as np
import pypdfium2
import pytest
from numpy.typing import NDArray

from anchors.sheet import (
    FEWEST_MODULES,
    LAYOUTS,
    MARK_ARM,
    QUIET_MODULES,
    Sheet,
    SheetError,
    compute_marks,
    load_dictionary,
)
from anchors.sheet_print import MARGIN_MM, PAPERS, largest_edge_mm, to_pdf, to_svg

TABLE = Sheet("table", 0.150)
OLD_TABLE = Sheet("table", 0.160, layout=1)
PER_MM = 10.0  # pixels of the rasterised page


def _raster(pdf: bytes) -> NDArray[np.uint8]:
    picture = pypdfium2.PdfDocument(pdf)[0].render(scale=PER_MM * 25.4 / 72.0, grayscale=True).to_numpy()
    return np.asarray(picture).reshape(picture.shape[:2])


def test_layout_of_printed_sheets_never_changes() -> None:
    """A change of these numbers would invalidate every printed sheet."""
    assert OLD_TABLE.marker_ids == (929, 562, 578, 437)
    assert Sheet("door", 0.16, layout=1).marker_ids == (544, 3, 618, 419)
    assert OLD_TABLE.marker_edge_m == pytest.approx(0.0464)
    assert OLD_TABLE.marker_corners[0][0] == pytest.approx([-0.096, 0.1424, 0.0])
    assert OLD_TABLE.marker_corners[2][2] == pytest.approx([0.096, -0.1424, 0.0])
    assert OLD_TABLE.code_corners[1] == pytest.approx([0.08, 0.08, 0.0])
    assert TABLE.marker_ids == (143, 816, 88, 64)
    assert TABLE.marker_edge_m == pytest.approx(0.0366)
    assert TABLE.marker_corners[0][0] == pytest.approx([-0.09, 0.14025, 0.0])
    assert TABLE.marker_corners[2][2] == pytest.approx([0.09, -0.14025, 0.0])


@pytest.mark.parametrize("has_marks", [False, True])
@pytest.mark.parametrize("paper", ["a4", "a5", "letter"])
@pytest.mark.parametrize("anchor_id", ["table", "x" * 64])
def test_code_has_four_modules_of_white_on_all_sides(anchor_id: str, paper: str, has_marks: bool) -> None:
    """Also where the paper ends, and between markers, words and crosses. The largest sheet is the tightest one."""
    sheet = Sheet(anchor_id, largest_edge_mm(paper, has_marks) / 1000.0, has_marks)
    modules = len(sheet.code)
    assert FEWEST_MODULES <= modules <= 57, "version 10"
    ink = 1.0 - _raster(to_pdf(sheet, paper)).astype(np.float64) / 255.0
    per_m = 1e3 * ink.shape[1] / PAPERS[paper][0]
    half = (0.5 + QUIET_MODULES / modules) * sheet.edge_m * per_m
    row, column = ink.shape[0] / 2, ink.shape[1] / 2
    assert column - half >= -1.0, "the paper is wide enough"
    quiet = np.ones(ink.shape, dtype=bool)
    quiet[: int(row - half) + 1] = quiet[int(row + half) :] = False
    quiet[:, : max(int(column - half) + 1, 0)] = quiet[:, int(column + half) :] = False
    code = int(0.5 * sheet.edge_m * per_m) + 1
    quiet[int(row) - code : int(row) + code + 1, int(column) - code : int(column) + code + 1] = False
    assert quiet.any()
    assert ink[quiet].max() < 0.1
    assert all(layout.white * modules >= QUIET_MODULES - 0.01 for layout in LAYOUTS.values() if layout.number > 1)


def test_ids_of_sheets_differ() -> None:
    all_ids = [Sheet(f"anchor-{k}", 0.16).marker_ids for k in range(500)]
    assert all(len(set(ids)) == 4 and min(ids) >= 0 and max(ids) < 1000 for ids in all_ids)
    assert len({frozenset(ids) for ids in all_ids}) == 500


@pytest.mark.parametrize(("anchor_id", "edge"), [("", 0.16), ("x" * 65, 0.16), ("Tür", 0.16), ("a\nb", 0.16)])
def test_non_portable_ids_are_refused(anchor_id: str, edge: float) -> None:
    with pytest.raises(SheetError, match="64 printable ASCII"):
        Sheet(anchor_id, edge)


@pytest.mark.parametrize("edge", [0.0, -0.1, float("nan"), float("inf"), 16.0])
def test_impossible_sizes_are_refused(edge: float) -> None:
    with pytest.raises(SheetError, match="20 to 2000 mm"):
        Sheet("table", edge)


@pytest.mark.parametrize("paper", PAPERS)
def test_largest_sheet_fits_and_a_larger_one_is_refused(paper: str) -> None:
    largest = largest_edge_mm(paper)
    sheet = Sheet("table", largest / 1000.0)
    width, height = PAPERS[paper]
    assert 1e3 * sheet.size_m[0] <= width - 2 * MARGIN_MM + 1e-6
    assert 1e3 * sheet.size_m[1] <= height - 2 * MARGIN_MM + 1e-6
    assert to_pdf(sheet, paper).endswith(b"%%EOF\n")
    with pytest.raises(SheetError, match=f"on {paper}: at most {largest} mm"):
        to_svg(Sheet("table", (largest + 1) / 1000.0), paper)


def test_pdf_has_the_exact_size() -> None:
    """Edges of the black area of the rasterised page are within a twentieth of a millimetre of the layout."""
    page = _raster(to_pdf(TABLE))
    assert abs(page.shape[1] / PER_MM - 210.0) < 0.15
    assert abs(page.shape[0] / PER_MM - 297.0) < 0.15
    mm = 210.0 / page.shape[1]
    ink = 1.0 - page.astype(np.float64) / 255.0
    middle = page.shape[0] // 2 - round((75.0 - 3.6) / mm)  # through the top row of modules
    row = ink[middle, page.shape[1] // 2 - 900 : page.shape[1] // 2 + 900]
    black = np.flatnonzero(row > 0.5)
    assert (black[-1] - black[0] + 1) * mm == pytest.approx(150.0, abs=0.1)
    for number, corners in enumerate(TABLE.marker_corners):
        (x0, y0), (x1, y1) = 1e3 * corners[0, :2], 1e3 * corners[2, :2]
        near = ink[round((147.5 - y0) / mm) : round((149.5 - y1) / mm), round((104 + x0) / mm) : round((106 + x1) / mm)]
        for axis, edge in ((0, x1 - x0), (1, y0 - y1)):
            black = np.flatnonzero(near.max(axis=axis) > 0.5)
            assert (black[-1] - black[0] + 1) * mm == pytest.approx(edge, abs=0.1), number
            assert black[0] * mm == pytest.approx(1.0, abs=0.15), number


def test_svg_agrees_with_the_pdf() -> None:
    root = ElementTree.fromstring(to_svg(Sheet("<a&b>", 0.150)))
    assert (root.get("width"), root.get("height"), root.get("viewBox")) == ("210mm", "297mm", "0 0 210 297")
    paths = [element.get("d") or "" for element in root if element.tag.endswith("path")]
    assert len(paths) == 6  # code, four markers, ruler
    assert "M30 73.5h" in paths[0]
    assert paths[1].startswith("M15 8.25h36.6")
    ticks = [float(x) for x in re.findall(r"M([\d.]+) ", paths[5])][1:]
    assert np.allclose([b - a for a, b in pairwise(ticks)], 10.0, atol=1e-3)
    texts = [element.text for element in root if element.tag.endswith("text")]
    assert "<a&b>" in texts
    assert "70 mm between the long marks" in texts


def test_marks_are_printed_where_the_sheet_says() -> None:
    """The crossings of the rasterised page are within a tenth of a millimetre of the marks of the sheet."""
    paper, edge = "a4", 0.140
    sheet = Sheet("table", edge, has_marks=True)
    page = _raster(to_pdf(sheet, paper))
    ink = 1.0 - page.astype(np.float64) / 255.0
    width, height = PAPERS[paper]
    mm, mm_down = width / page.shape[1], height / page.shape[0]
    plain = 1.0 - _raster(to_pdf(Sheet("table", edge), paper)).astype(np.float64) / 255.0
    assert set(sheet.marks) == set("1234")
    for name, (x, y, z) in sheet.marks.items():
        assert z == 0.0
        column, row = (0.5 * width + 1e3 * x) / mm, (0.5 * height - 1e3 * y) / mm_down
        near = round(3.0 / mm)
        part = ink[round(row) - near : round(row) + near, round(column) - near : round(column) + near]
        assert plain[round(row) - near : round(row) + near, round(column) - near : round(column) + near].max() < 0.1
        # The arm towards the outer edge of the page: the other has the id beside it.
        outer = part[:, : near // 2] if x < 0.0 else part[:, -near // 2 :]
        across = float(np.average(np.arange(len(part)) + 0.5, weights=outer.sum(axis=1)))
        lower = part[-near // 2 :]
        along = float(np.average(np.arange(len(part)) + 0.5, weights=lower.sum(axis=0)))
        assert (across + round(row) - near - row) * mm_down == pytest.approx(0.0, abs=0.1), name
        assert (along + round(column) - near - column) * mm == pytest.approx(0.0, abs=0.1), name
        for axis in (0, 1):
            outside = (column, row)[axis] * mm
            assert (
                MARGIN_MM + 1e3 * MARK_ARM * edge
                <= outside
                <= (width, height)[axis] - MARGIN_MM - 1e3 * MARK_ARM * edge
            )


def test_sheets_with_marks_are_smaller_and_still_read() -> None:
    assert (largest_edge_mm("a4", has_marks=True), largest_edge_mm("a3", has_marks=True)) == (142, 204)
    with pytest.raises(SheetError, match="frame and marks does not fit on a4: at most 142 mm"):
        to_pdf(Sheet("table", 0.143, has_marks=True))
    assert compute_marks(0.14, layout=1)["3"] == (0.0924, -0.056, 0.0), "this would invalidate every printed sheet"
    assert compute_marks(0.14)["2"] == (0.021, 0.1358, 0.0)
    page = _raster(to_pdf(Sheet("table", 0.140, has_marks=True)))
    page = cv2.resize(page, None, fx=0.3, fy=0.3, interpolation=cv2.INTER_AREA)
    assert cv2.QRCodeDetector().detectAndDecode(page)[0] == "table"
    found = cv2.aruco.ArucoDetector(load_dictionary()).detectMarkers(page)[1]
    assert set(TABLE.marker_ids) <= {int(n) for n in found.ravel()}


@pytest.mark.parametrize(
    "anchor_id", ["table", "lab 3: shelf, left", "lab-3/robot-cell-2/table-by-the-window/left-corner/sheet-no-0001"]
)
def test_code_contains_the_id(anchor_id: str) -> None:
    page = cv2.resize(_raster(to_pdf(Sheet(anchor_id, 0.150))), None, fx=0.3, fy=0.3, interpolation=cv2.INTER_AREA)
    assert cv2.QRCodeDetector().detectAndDecode(page)[0] == anchor_id
