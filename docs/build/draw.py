"""Draw the pictures of docs/build: `python docs/build/draw.py`. They are plain SVG, without any library."""

from __future__ import annotations

from pathlib import Path
from typing import Final

HERE: Final = Path(__file__).parent
HEAD: Final = (
    '<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" width="{width}" height="{height}" '
    'font-family="sans-serif" font-size="13" stroke-linecap="round" role="img">\n<title>{title}</title>\n'
    '<rect width="{width}" height="{height}" fill="#ffffff"/>'
)
DARK, WATER, GLASS, LIGHT, METAL, BOARD = "#1f2933", "#d6ecf5", "#7fb3d5", "#f2b705", "#b8c0c8", "#3c8d5a"
WIRES: Final = {"3.3 V": "#c0392b", "SDA": "#2471a3", "SCL": "#d68910", "GND": "#1f2933"}


class Drawing:
    """One picture: shapes in the order in which they are drawn. All lengths are in pixels of the picture."""

    def __init__(self, title: str, width: int, height: int) -> None:
        self._parts = [HEAD.format(title=title, width=width, height=height)]

    def rect(self, x: float, y: float, w: float, h: float, fill: str, round_: float = 0.0) -> None:
        """A rectangle from its upper left corner."""
        self._parts.append(
            f'<rect x="{x:g}" y="{y:g}" width="{w:g}" height="{h:g}" rx="{round_:g}" fill="{fill}" '
            f'stroke="{DARK}" stroke-width="1.2"/>'
        )

    def circle(self, x: float, y: float, r: float, fill: str) -> None:
        """A circle."""
        self._parts.append(
            f'<circle cx="{x:g}" cy="{y:g}" r="{r:g}" fill="{fill}" stroke="{DARK}" stroke-width="1.2"/>'
        )

    def line(self, *points: tuple[float, float], colour: str = DARK, width: float = 1.5, dashed: bool = False) -> None:
        """A line through points."""
        dashes = ' stroke-dasharray="6 4"' if dashed else ""
        path = " ".join(f"{x:g},{y:g}" for x, y in points)
        self._parts.append(
            f'<polyline points="{path}" fill="none" stroke="{colour}" stroke-width="{width:g}"{dashes}/>'
        )

    def path(self, d: str, colour: str = DARK, fill: str = "none", width: float = 1.5) -> None:
        """A path in SVG's own words."""
        self._parts.append(f'<path d="{d}" fill="{fill}" stroke="{colour}" stroke-width="{width:g}"/>')

    def arrow(self, x1: float, y1: float, x2: float, y2: float, colour: str = DARK) -> None:
        """A line with a head at its end."""
        length = ((x2 - x1) ** 2 + (y2 - y1) ** 2) ** 0.5
        u, v = (x2 - x1) / length, (y2 - y1) / length
        self.line((x1, y1), (x2, y2), colour=colour)
        for side in (1, -1):
            self.line((x2, y2), (x2 - 9 * u - side * 4 * v, y2 - 9 * v + side * 4 * u), colour=colour)

    def span(self, x1: float, x2: float, y: float, words: str) -> None:
        """A measure between two verticals."""
        self.arrow((x1 + x2) / 2, y, x1, y)
        self.arrow((x1 + x2) / 2, y, x2, y)
        self.text((x1 + x2) / 2, y - 6, words, "middle")

    def text(self, x: float, y: float, words: str, anchor: str = "start", bold: bool = False) -> None:
        """A line of text; y is its base line."""
        weight = ' font-weight="bold"' if bold else ""
        safe = words.replace("&", "&amp;").replace("<", "&lt;")
        self._parts.append(f'<text x="{x:g}" y="{y:g}" text-anchor="{anchor}" fill="{DARK}"{weight}>{safe}</text>')

    def __str__(self) -> str:
        return "\n".join([*self._parts, "</svg>", ""])


def rig() -> Drawing:
    """A node from above and from its side: bar, lights, housing, and the frames."""
    d = Drawing("A node from above and from the side", 860, 470)
    d.text(20, 28, "From above", bold=True)
    d.rect(90, 150, 680, 14, METAL, 4)
    for x, words in ((90, "left light"), (770, "right light")):
        d.rect(x - 14, 110, 28, 60, METAL, 6)
        d.rect(x - 14, 104, 28, 10, LIGHT, 3)
        d.path(f"M {x - 10} 102 L {x - 46} 50 M {x + 10} 102 L {x + 46} 50", LIGHT, width=2)
        d.text(x, 192, words, "middle")
    d.rect(395, 112, 70, 150, "#eef2f5", 10)
    d.rect(397, 108, 66, 8, GLASS, 2)
    d.rect(415, 122, 30, 16, DARK, 2)
    d.text(476, 110, "camera behind a flat port")
    d.text(476, 222, "housing: Pi, inertial unit, battery")
    d.span(90, 770, 288, "light to light: 0.88 m in the examples (0.5 to 1 m)")
    d.arrow(430, 130, 430, 60)
    d.text(438, 70, "z: the way the camera looks")
    d.arrow(430, 130, 520, 130)
    d.text(526, 134, "x")
    d.text(20, 328, "From the side", bold=True)
    d.rect(240, 372, 320, 64, "#eef2f5", 12)
    d.rect(232, 372, 8, 64, GLASS, 2)
    d.rect(246, 394, 22, 20, DARK, 2)
    d.rect(296, 384, 110, 12, BOARD, 2)
    d.text(302, 380, "Pi")
    d.rect(296, 412, 26, 8, BOARD, 1)
    d.text(326, 422, "inertial unit, far from the battery")
    d.rect(450, 380, 84, 24, METAL, 4)
    d.text(456, 396, "battery")
    d.rect(560, 384, 22, 14, METAL, 3)
    d.text(590, 396, "depth sensor")
    d.rect(560, 412, 22, 14, METAL, 3)
    d.text(590, 424, "penetrators: lights, tether; vent")
    d.rect(218, 350, 30, 14, METAL, 4)
    d.rect(210, 350, 10, 14, LIGHT, 3)
    d.text(256, 362, "lights beside and behind the port: never in the camera's own view")
    d.arrow(257, 404, 180, 404)
    d.text(150, 396, "z")
    d.arrow(257, 404, 257, 456)
    d.text(264, 456, "y, down")
    return d


def wiring() -> Drawing:
    """The sensors' bus and the panel at the Pi's pins."""
    d = Drawing("Wiring of a node", 860, 470)
    d.rect(40, 40, 170, 390, "#e8f3ec", 8)
    d.text(125, 64, "Raspberry Pi", "middle", bold=True)
    ys = {"3.3 V": 100, "SDA": 130, "SCL": 160, "GND": 190}
    pins = {"3.3 V": "1", "SDA": "3 (GPIO 2)", "SCL": "5 (GPIO 3)", "GND": "9"}
    chips = (("MinIMU-9", 330), ("Bar30 / Bar02", 480), ("battery gauge", 630))
    for name, y in ys.items():
        d.text(200, y + 4, f"{name}: pin {pins[name]}", "end")
        d.line((210, y), (760, y), colour=WIRES[name], width=2.5)
    for words, x in chips:
        d.rect(x, 236, 118, 54, "#e8f3ec", 6)
        d.text(x + 59, 268, words, "middle")
        for k, (name, y) in enumerate(ys.items()):
            at = x + 19 + 27 * k
            d.line((at, y), (at, 236), colour=WIRES[name], width=2)
            d.circle(at, y, 3, WIRES[name])
    d.text(330, 84, "one bus, 30 cm of wire in all; the Pi's 1.8 kOhm pull-ups suffice")
    panel = (
        (320, "GPIO 17, pin 11", "reed switch or button to ground"),
        (345, "GPIO 27, pin 13", "LED, 330 Ohm, ground"),
        (370, "GPIO 22, pin 15", "gate of the buzzer's MOSFET, 10 kOhm to ground"),
        (395, "GPIO 23, pin 16", "enable of the lights' driver, 10 kOhm to ground"),
        (420, "GPIO 24, pin 18", "leak probe: 3.3 V through 1 kOhm when wet"),
    )
    for y, pin, part in panel:
        d.text(200, y + 4, pin, "end")
        d.line((210, y), (330, y))
        d.text(340, y + 4, part)
    return d


def power() -> Drawing:
    """From the battery to the Pi and the lights."""
    d = Drawing("Power of a node", 860, 260)
    d.rect(30, 90, 130, 60, METAL, 6)
    d.text(95, 116, "battery, 3 cells", "middle")
    d.text(95, 136, "9.6 to 12.6 V", "middle")
    d.line((160, 120), (200, 120), width=3)
    d.rect(200, 106, 60, 28, "#ffffff", 4)
    d.text(230, 125, "fuse 5 A", "middle")
    d.line((260, 120), (300, 120), width=3)
    d.rect(300, 100, 90, 40, "#e8f3ec", 6)
    d.text(345, 125, "INA219", "middle")
    d.line((390, 120), (440, 120), width=3)
    d.line((440, 60), (440, 190), width=3)
    d.line((440, 60), (490, 60), width=3)
    d.rect(490, 36, 150, 48, "#ffffff", 6)
    d.text(565, 56, "buck to 5.1 V, 5 A", "middle")
    d.text(565, 74, "(Pi 4: 3 A)", "middle")
    d.arrow(640, 60, 700, 60)
    d.rect(700, 36, 120, 48, "#e8f3ec", 6)
    d.text(760, 65, "Pi, camera", "middle")
    d.line((440, 190), (490, 190), width=3)
    d.rect(490, 166, 150, 48, "#ffffff", 6)
    d.text(565, 186, "constant-current", "middle")
    d.text(565, 204, "driver, not pulses", "middle")
    d.arrow(640, 182, 700, 150, LIGHT)
    d.arrow(640, 198, 700, 222, LIGHT)
    d.circle(722, 142, 20, LIGHT)
    d.circle(722, 228, 20, LIGHT)
    d.text(750, 147, "left light")
    d.text(750, 233, "right light")
    d.line((565, 246), (565, 214), dashed=True)
    d.text(556, 254, "enable: GPIO 23", "end")
    d.text(30, 196, "one ground for all; the Pi's supply branches off")
    d.text(30, 214, "before the lights' thick wires")
    return d


def ports() -> Drawing:
    """Where the entrance pupil goes behind a flat port and in a dome."""
    d = Drawing("Flat port and dome: where the entrance pupil is", 960, 330)
    d.path("M 0 0 H 215 V 330 H 0 Z", WATER, WATER)
    d.text(20, 28, "Flat port", bold=True)
    d.rect(215, 60, 14, 200, GLASS)
    d.rect(262, 135, 60, 50, DARK, 4)
    for side in (-1, 1):
        d.line((20, 160 + 90 * side), (215, 160 + 23 * side), (229, 160 + 19 * side), (262, 160), colour="#c0392b")
        d.line((215, 160 + 23 * side), (278, 160), colour="#c0392b", dashed=True)
    d.circle(262, 160, 4, LIGHT)
    d.circle(278, 160, 4, "#c0392b")
    d.text(150, 54, "glass, t")
    d.text(300, 96, "yellow: the pupil; red: where")
    d.text(300, 114, "the water sees it, 1.33 g + 0.89 t")
    d.text(300, 132, "behind the glass's outer face")
    d.span(229, 262, 292, "g")
    d.text(244, 312, "gap g: at most 10 mm")
    d.path("M 540 0 H 760 V 330 H 540 Z", WATER, WATER)
    d.path("M 760 40 A 120 120 0 0 0 760 280 Z", "#ffffff", "#ffffff")
    d.text(560, 28, "Dome", bold=True)
    d.path("M 760 45 A 115 115 0 0 0 760 275", GLASS, width=10)
    d.rect(760, 135, 60, 50, DARK, 4)
    for side in (-1.6, -0.7, 0.7, 1.6):
        d.line((580, 160 + 75 * side), (760, 160), colour="#c0392b")
    d.circle(760, 160, 4, LIGHT)
    d.text(780, 84, "the pupil in the dome's")
    d.text(780, 102, "centre: no ray is bent, but")
    d.text(780, 120, "far things appear 4 R away")
    d.span(645, 760, 312, "R")
    return d


DRAWINGS: Final = {"rig.svg": rig, "wiring.svg": wiring, "power.svg": power, "ports.svg": ports}


def main() -> None:
    """Write all pictures beside this file."""
    for name, draw in DRAWINGS.items():
        (HERE / name).write_text(str(draw()), encoding="utf-8")


if __name__ == "__main__":
    main()
