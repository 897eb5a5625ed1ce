"""Plan and profile as drawings: lines, text and ellipses, written as SVG or as PDF by the same strokes."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Final, Literal

import numpy as np
from buddyline.tools.survey.averages import Floats
from buddyline.tools.survey.network import Adjusted, Position

Colour = Literal["line", "alarm", "point", "faint", "text"]
COLOURS: Final[dict[Colour, str]] = {
    "line": "#1f4e79",
    "alarm": "#c00000",
    "point": "#2e7d32",
    "faint": "#b0b0b0",
    "text": "#202020",
}
WIDTH_PT: Final = 560.0
MARGIN_PT: Final = 36.0
TEXT_PT: Final = 8.0


@dataclass
class Drawing:
    """Strokes on a page, points (1/72 inch), y down."""

    width_pt: float
    height_pt: float
    lines: list[tuple[list[tuple[float, float]], Colour, float]] = field(default_factory=list)
    texts: list[tuple[float, float, str, float]] = field(default_factory=list)

    def line(self, points: list[tuple[float, float]], colour: Colour, thick_pt: float = 1.2) -> None:
        """Draw a polyline."""
        self.lines.append((points, colour, thick_pt))

    def text(self, x: float, y: float, text: str, size_pt: float = TEXT_PT) -> None:
        """Write text from x, y."""
        self.texts.append((x, y, text, size_pt))

    def svg(self) -> str:
        """Return the drawing as SVG."""
        parts = [
            f'<svg xmlns="http://www.w3.org/2000/svg" width="{self.width_pt:.0f}pt" height="{self.height_pt:.0f}pt" '
            f'viewBox="0 0 {self.width_pt:.2f} {self.height_pt:.2f}">',
            f'<rect width="{self.width_pt:.2f}" height="{self.height_pt:.2f}" fill="#ffffff"/>',
        ]
        for points, colour, thick_pt in self.lines:
            path = " ".join(f"{x:.2f},{y:.2f}" for x, y in points)
            parts.append(
                f'<polyline points="{path}" fill="none" stroke="{COLOURS[colour]}" stroke-width="{thick_pt:.2f}"/>'
            )
        for x, y, text, size_pt in self.texts:
            escaped = text.replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;")
            parts.append(
                f'<text x="{x:.2f}" y="{y:.2f}" font-family="Helvetica,Arial,sans-serif" font-size="{size_pt:g}" '
                f'fill="{COLOURS["text"]}">{escaped}</text>'
            )
        return "\n".join([*parts, "</svg>", ""])


def pdf(drawings: list[Drawing]) -> bytes:
    """Return a PDF of one drawing a page (PDF 1.4: strokes and Helvetica, Latin-1)."""
    objects: list[bytes] = []
    pages = [f"{4 + 2 * i} 0 R" for i in range(len(drawings))]
    objects.append(b"<< /Type /Catalog /Pages 2 0 R >>")
    objects.append(f"<< /Type /Pages /Kids [{' '.join(pages)}] /Count {len(pages)} >>".encode())
    objects.append(b"<< /Type /Font /Subtype /Type1 /BaseFont /Helvetica /Encoding /WinAnsiEncoding >>")
    for i, drawing in enumerate(drawings):
        stream = _pdf_stream(drawing)
        objects.append(
            f"<< /Type /Page /Parent 2 0 R /MediaBox [0 0 {drawing.width_pt:.2f} {drawing.height_pt:.2f}] "
            f"/Resources << /Font << /F1 3 0 R >> >> /Contents {5 + 2 * i} 0 R >>".encode()
        )
        objects.append(f"<< /Length {len(stream)} >>\nstream\n".encode() + stream + b"\nendstream")
    out = bytearray(b"%PDF-1.4\n")
    offsets = []
    for number, body in enumerate(objects, 1):
        offsets.append(len(out))
        out += f"{number} 0 obj\n".encode() + body + b"\nendobj\n"
    start = len(out)
    out += f"xref\n0 {len(objects) + 1}\n0000000000 65535 f \n".encode()
    out += "".join(f"{offset:010d} 00000 n \n" for offset in offsets).encode()
    out += f"trailer\n<< /Size {len(objects) + 1} /Root 1 0 R >>\nstartxref\n{start}\n%%EOF\n".encode()
    return bytes(out)


def _pdf_stream(drawing: Drawing) -> bytes:
    rows = []
    for points, colour, thick_pt in drawing.lines:
        red, green, blue = (int(COLOURS[colour][i : i + 2], 16) / 255 for i in (1, 3, 5))
        path = " ".join(f"{x:.2f} {drawing.height_pt - y:.2f} {'l' if k else 'm'}" for k, (x, y) in enumerate(points))
        rows.append(f"{red:.3f} {green:.3f} {blue:.3f} RG {thick_pt:.2f} w {path} S")
    for x, y, text, size_pt in drawing.texts:
        escaped = text.replace("\\", "\\\\").replace("(", "\\(").replace(")", "\\)")
        rows.append(f"BT /F1 {size_pt:g} Tf {x:.2f} {drawing.height_pt - y:.2f} Td ({escaped}) Tj ET")
    return "\n".join(rows).encode("cp1252", "replace")


@dataclass(frozen=True)
class _Scale:
    """From metres (x right, y up) to the page."""

    left_m: float
    top_m: float
    pt_per_m: float

    def at(self, x_m: float, y_m: float) -> tuple[float, float]:
        return MARGIN_PT + (x_m - self.left_m) * self.pt_per_m, 30 + MARGIN_PT + (self.top_m - y_m) * self.pt_per_m


def plan(adjusted: Adjusted, title: str) -> Drawing:
    """Draw the survey from above, north up, with 95 % ellipses."""
    at = {name: position.position_m[:2] for name, position in adjusted.positions.items()}
    everything = [*at.values(), *(point.position_m[:2] for point in adjusted.points)]
    drawing, scale = _page(np.array(everything), f"{title}: plan, {adjusted.grid.north} north up")
    for line in adjusted.lines:
        colour: Colour = "alarm" if line.leg.alarms else "line"
        drawing.line([scale.at(*at[line.leg.from_]), scale.at(*at[line.leg.to])], colour)
    for position in adjusted.positions.values():
        _spot(drawing, scale, position, "line")
    for position in adjusted.points:
        _spot(drawing, scale, position, "point")
    return drawing


def _spot(drawing: Drawing, scale: _Scale, position: Position, colour: Colour) -> None:
    east_m, north_m = float(position.position_m[0]), float(position.position_m[1])
    major_m, minor_m, azimuth = position.ellipse
    if major_m > 1e-3:
        # 95 % of a two-dimensional normal distribution lies within 2.448 standard deviations.
        ring = []
        for angle in np.linspace(0, 2 * math.pi, 33).tolist():
            along, across = 2.448 * major_m * math.cos(angle), 2.448 * minor_m * math.sin(angle)
            east = east_m + along * math.sin(azimuth) + across * math.cos(azimuth)
            ring.append(scale.at(east, north_m + along * math.cos(azimuth) - across * math.sin(azimuth)))
        drawing.line(ring, "faint", 0.6)
    x, y = scale.at(east_m, north_m)
    drawing.line([(x - 2, y - 2), (x + 2, y + 2)], colour, 0.8)
    drawing.line([(x - 2, y + 2), (x + 2, y - 2)], colour, 0.8)
    drawing.text(x + 4, y - 3, position.name)


def profile(adjusted: Adjusted, title: str) -> Drawing:
    """Draw the survey unrolled: the way along the legs against altitude, each leg once."""
    along: dict[str, float] = {}
    segments: list[tuple[float, float, float, float, bool, str]] = []
    reach = 0.0
    for line in adjusted.lines:
        leg = line.leg
        start, end = adjusted.positions[leg.from_].position_m, adjusted.positions[leg.to].position_m
        run_m = math.hypot(*(end - start)[:2].tolist())
        begin = along.setdefault(leg.from_, reach)
        along.setdefault(leg.to, begin + run_m)
        reach = max(reach, begin + run_m)
        segments.append((begin, float(start[2]), begin + run_m, float(end[2]), bool(leg.alarms), leg.to))
    corners = [(x, z) for x0, z0, x1, z1, _, _ in segments for x, z in ((x0, z0), (x1, z1))]
    drawing, scale = _page(np.array(corners or [(0.0, 0.0)]), f"{title}: profile, unrolled along the legs")
    for x0, z0, x1, z1, alarm, name in segments:
        drawing.line([scale.at(x0, z0), scale.at(x1, z1)], "alarm" if alarm else "line")
        x, y = scale.at(x1, z1)
        drawing.text(x + 3, y - 3, name)
    if segments:
        x, y = scale.at(*segments[0][:2])
        drawing.text(x + 3, y - 3, adjusted.lines[0].leg.from_)
    return drawing


def _page(places: Floats, title: str) -> tuple[Drawing, _Scale]:
    low, high = places.min(axis=0), places.max(axis=0)
    size = np.maximum(high - low, 1.0)
    pt_per_m = min((WIDTH_PT - 2 * MARGIN_PT) / size[0], 700.0 / size[1])
    drawing = Drawing(WIDTH_PT, float(size[1] * pt_per_m + 2 * MARGIN_PT + 60))
    scale = _Scale(float(low[0]), float(high[1]), float(pt_per_m))
    drawing.text(MARGIN_PT, 22, title, 11)
    bar_m = 10 ** math.floor(math.log10(float(size.max()) / 2))
    x, y = MARGIN_PT, drawing.height_pt - 18
    drawing.line([(x, y - 4), (x, y), (x + bar_m * pt_per_m, y), (x + bar_m * pt_per_m, y - 4)], "text", 1.0)
    drawing.text(x + bar_m * pt_per_m + 6, y, f"{bar_m:g} m")
    return drawing, scale
