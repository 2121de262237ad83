"""A sheet as PDF or SVG at its exact size, with a ruler that shows whether the printer kept it.

Both are a handful of vector shapes, written here by hand: one filled path per symbol (so that adjacent modules have
no seam), a few lines, and text in a font that every viewer has. Lengths are millimetres from the upper left corner of
the page until the very end.
"""

from __future__ import annotations

from typing import Final, NamedTuple
from xml.sax.saxutils import escape

from anchors.sheet import (
    FEWEST_MODULES,
    LAYOUTS,
    MARK_ARM,
    NEWEST_LAYOUT,
    QUIET_MODULES,
    Rect,
    Sheet,
    SheetError,
    half_extent,
)

#: Width and height [mm], upright. ISO 216, and ANSI A for `letter`, ANSI B for `tabloid`.
PAPERS: Final = {
    "a5": (148.0, 210.0),
    "a4": (210.0, 297.0),
    "a3": (297.0, 420.0),
    "a2": (420.0, 594.0),
    "letter": (215.9, 279.4),
    "tabloid": (279.4, 431.8),
}
#: White that printers leave at every side [mm].
MARGIN_MM: Final = 6.0
MM_PER_INCH: Final = 25.4
POINTS_PER_MM: Final = 72.0 / MM_PER_INCH
_LINE_MM: Final = 0.2


class _Text(NamedTuple):
    x: float  # centre [mm]
    y: float  # base line
    height: float  # of the font [mm]
    text: str


class _Page(NamedTuple):
    """Shapes and texts of a page [mm], origin in the upper left corner, y down."""

    width: float
    height: float
    shapes: list[list[Rect]]  # each one path; `y` is the upper edge here
    texts: list[_Text]
    title: str


def largest_edge_mm(paper: str, has_marks: bool = False, layout: int = NEWEST_LAYOUT) -> int:
    """Return the edge [mm] of the largest code, in whole millimetres, whose sheet fits on the paper.

    Left and right of the code the white reaches to the edge of the paper: what lies beyond it may be dark.
    """
    if paper not in PAPERS:
        raise SheetError(f"no paper {paper!r}: {', '.join(PAPERS)}")
    width, height = PAPERS[paper]
    half = half_extent(LAYOUTS[layout], has_marks)
    edge = min((width / 2 - MARGIN_MM) / half[0], (height / 2 - MARGIN_MM) / half[1])
    if layout > 1:
        edge = min(edge, width / 2 / (0.5 + QUIET_MODULES / FEWEST_MODULES))
    return int(edge)


def to_svg(sheet: Sheet, paper: str = "a4") -> str:
    """Return the sheet as an SVG whose user unit is one millimetre."""
    page = _lay_out(sheet, paper)
    lines = [
        '<?xml version="1.0" encoding="UTF-8"?>',
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{page.width:g}mm" height="{page.height:g}mm" '
        f'viewBox="0 0 {page.width:g} {page.height:g}">',
        f"<title>{escape(page.title)}</title>",
        f'<rect width="{page.width:g}" height="{page.height:g}" fill="white"/>',
    ]
    for shape in page.shapes:
        path = "".join(
            f"M{_format_mm(r.x)} {_format_mm(r.y)}h{_format_mm(r.width)}v{_format_mm(r.height)}h{_format_mm(-r.width)}z"
            for r in shape
        )
        lines.append(f'<path d="{path}"/>')
    for text in page.texts:
        lines.append(
            f'<text x="{_format_mm(text.x)}" y="{_format_mm(text.y)}" font-family="Courier, monospace" '
            f'font-size="{_format_mm(text.height)}" text-anchor="middle">{escape(text.text)}</text>'
        )
    return "\n".join([*lines, "</svg>", ""])


def to_pdf(sheet: Sheet, paper: str = "a4") -> bytes:
    """Return the sheet as a one-page PDF 1.4; it asks viewers not to scale it (`/PrintScaling /None`)."""
    page = _lay_out(sheet, paper)
    content = "\n".join([f"{POINTS_PER_MM:.9f} 0 0 {-POINTS_PER_MM:.9f} 0 {page.height * POINTS_PER_MM:.6f} cm", "0 g"])
    for shape in page.shapes:
        content += (
            "\n"
            + "\n".join(
                f"{_format_mm(r.x)} {_format_mm(r.y)} {_format_mm(r.width)} {_format_mm(r.height)} re" for r in shape
            )
            + "\nf"
        )
    for text in page.texts:
        x = text.x - 0.5 * _text_width(text.text) * text.height
        # The page's y points down: the text matrix turns it back up.
        place = f"1 0 0 -1 {_format_mm(x)} {_format_mm(text.y)} Tm"
        content += f"\nBT /F1 {_format_mm(text.height)} Tf {place} ({_escape_pdf(text.text)}) Tj ET"
    stream = content.encode("ascii")
    box = f"[0 0 {page.width * POINTS_PER_MM:.4f} {page.height * POINTS_PER_MM:.4f}]"
    objects = [
        b"<< /Type /Catalog /Pages 2 0 R /ViewerPreferences << /PrintScaling /None >> >>",
        b"<< /Type /Pages /Kids [3 0 R] /Count 1 >>",
        f"<< /Type /Page /Parent 2 0 R /MediaBox {box} /Contents 4 0 R "
        "/Resources << /Font << /F1 5 0 R >> >> >>".encode("ascii"),
        b"<< /Length %d >>\nstream\n%s\nendstream" % (len(stream), stream),
        b"<< /Type /Font /Subtype /Type1 /BaseFont /Courier /Encoding /WinAnsiEncoding >>",
        f"<< /Title ({_escape_pdf(page.title)}) >>".encode("ascii"),
    ]
    return _assemble_pdf(objects)


def _assemble_pdf(objects: list[bytes]) -> bytes:
    """Return objects 1, 2, ... with header, cross-reference table and trailer (PDF reference 1.4, section 3.4)."""
    out = b"%PDF-1.4\n%\xe2\xe3\xcf\xd3\n"
    offsets = []
    for number, text in enumerate(objects, 1):
        offsets.append(len(out))
        out += b"%d 0 obj\n%s\nendobj\n" % (number, text)
    start = len(out)
    out += b"xref\n0 %d\n0000000000 65535 f \n" % (len(objects) + 1)
    out += b"".join(b"%010d 00000 n \n" % offset for offset in offsets)
    trailer = b"trailer\n<< /Size %d /Root 1 0 R /Info %d 0 R >>\nstartxref\n%d\n%%%%EOF\n"
    return out + trailer % (len(objects) + 1, len(objects), start)


def _lay_out(sheet: Sheet, paper: str) -> _Page:
    edge = 1e3 * sheet.edge_m
    largest = largest_edge_mm(paper, sheet.has_marks, sheet.layout)
    width, height = PAPERS[paper]
    if edge > largest + 1e-9:
        raise SheetError(
            f"a code of {edge:g} mm with its frame {'and marks ' * sheet.has_marks}does not fit on {paper}: at most "
            f"{largest} mm there, or larger paper"
        )
    x0, y0 = 0.5 * width, 0.5 * height
    shapes = [
        [Rect(x0 + 1e3 * r.x, y0 - 1e3 * (r.y + r.height), 1e3 * r.width, 1e3 * r.height) for r in rects]
        for rects in sheet.list_black_rects().values()
    ]
    ruler, figures = _place_ruler(x0, y0 + 0.80 * edge, edge)
    unit = 0.03 * edge  # height of the text; everything grows with the sheet
    texts = [
        *_place_title(x0, y0 - 0.80 * edge, sheet, unit),
        _Text(x0, y0 - 0.70 * edge, unit, f"code {edge:g} mm  ^ up"),
        _Text(x0, y0 + 0.73 * edge, 0.8 * unit, "print at 100 %, measure the code's edge"),
        *figures,
        _Text(x0, y0 + 0.87 * edge, 0.8 * unit, "tape it down, draw its corners"),
    ]
    crosses = []
    for name, (x, y, _) in sheet.marks.items():
        cross, label = _place_cross(x0 + 1e3 * x, y0 - 1e3 * y, MARK_ARM * edge, 1.0 if x < 0.0 else -1.0, name)
        crosses.append(cross)
        texts.append(label)
    title = f"anchor {sheet.anchor_id}, code {edge:g} mm"
    return _Page(width, height, [*shapes, ruler, *crosses], texts, title)


def _place_cross(x: float, y: float, arm: float, inwards: float, name: str) -> tuple[list[Rect], _Text]:
    """Return a cross of two thin lines around (x, y), and its id above it towards the middle of the sheet."""
    half = 0.5 * _LINE_MM
    rects = [
        Rect(x - arm, y - half, 2.0 * arm, _LINE_MM),
        # Beside the first line: viewers differ in how they fill a path that overlaps itself.
        Rect(x - half, y - arm, _LINE_MM, arm - half),
        Rect(x - half, y + half, _LINE_MM, arm - half),
    ]
    return rects, _Text(x + 0.6 * inwards * arm, y - 0.3 * arm, 0.9 * arm, name)


def _place_title(x: float, y: float, sheet: Sheet, unit: float) -> list[_Text]:
    """Return the id between the two upper markers: as large as fits, long ones in several lines."""
    text = sheet.anchor_id
    room = 2e3 * (sheet.shape.half_width - sheet.shape.marker_edge) * sheet.edge_m - 4.0 * unit
    n = min(len(text), max(16, int(room / (_text_width("m") * unit))))
    parts = [text[k : k + n] for k in range(0, len(text), n)]
    height = min(2.0 * unit, room / _text_width(parts[0]))
    return [_Text(x, y + 1.2 * height * (k - 0.5 * (len(parts) - 1)), height, part) for k, part in enumerate(parts)]


def _place_ruler(x: float, y: float, edge: float) -> tuple[list[Rect], list[_Text]]:
    """Return a ruler of whole centimetres (millimetres on small sheets) between the two lower markers, centred at x."""
    step = 10.0 if edge >= 60.0 else 1.0
    n = int(0.5 * edge / step)
    length = n * step
    left = x - 0.5 * length
    tick = 0.03 * edge
    line = min(_LINE_MM, 0.1 * step)
    # Ticks are centred on their mark: the ruler is measured from the middle of the first to the middle of the last.
    rects = [Rect(left, y - 0.5 * line, length, line)]
    for k in range(n + 1):
        high = tick if k in (0, n) else 0.5 * tick
        rects.append(Rect(left + k * step - 0.5 * line, y - high, line, high))
    height = 0.024 * edge
    return rects, [_Text(x, y + 1.5 * height, height, f"{length:g} mm between the long marks")]


def _text_width(text: str) -> float:
    """Return the width of text over its height: every character of Courier is 0.6 wide."""
    return 0.6 * len(text)


def _format_mm(value: float) -> str:
    """Format a length with a tenth of a micrometre, without trailing zeros."""
    text = f"{value:.4f}".rstrip("0").rstrip(".")
    return "0" if text in ("-0", "") else text


def _escape_pdf(text: str) -> str:
    return text.replace("\\", r"\\").replace("(", r"\(").replace(")", r"\)")
