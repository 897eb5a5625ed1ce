"""The page's colours: told apart also by those who see no red or no green."""

from __future__ import annotations

import re
from itertools import combinations

import numpy as np
import pytest

from tests.processes import REPOSITORY

STYLE = (REPOSITORY / "tools" / "monitor" / "web" / "style.css").read_text()
LEAST_DELTA_E = 40.0
# Deuteranopia in linear RGB: Machado, Oliveira, Fernandes 2009, severity 1.
DEUTERANOPE = np.array(
    [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]]
)
TO_XYZ = np.array(
    [[0.4124564, 0.3575761, 0.1804375], [0.2126729, 0.7151522, 0.0721750], [0.0193339, 0.1191920, 0.9503041]]
)
WHITE = np.array([0.95047, 1.0, 1.08883])
# What must not be taken for each other: of each theme's variables, and the banner's grounds.
TOLD_APART = (("left", "right"), ("a", "b"), ("track", "pose"), ("north", "down"))


def lab(colour: str, seen: np.ndarray) -> np.ndarray:
    """Return CIE Lab of #rrggbb as it is seen; seen: a matrix in linear RGB."""
    srgb = np.array([int(colour[k : k + 2], 16) for k in (1, 3, 5)]) / 255
    linear = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
    xyz = TO_XYZ @ np.clip(seen @ linear, 0.0, 1.0) / WHITE
    f = np.where(xyz > 216 / 24389, np.cbrt(xyz), (24389 / 27 * xyz + 16) / 116)
    return np.array([116 * f[1] - 16, 500 * (f[0] - f[1]), 200 * (f[1] - f[2])])


def delta_e(one: str, other: str, seen: np.ndarray) -> float:
    """Return CIE 1976's difference of two colours."""
    return float(np.linalg.norm(lab(one, seen) - lab(other, seen)))


def variables(block: str) -> dict[str, str]:
    return dict(re.findall(r"--(\w+): (#[0-9a-f]{6})", block))


def grounds() -> dict[str, str]:
    """The banner's grounds by what they say."""
    found = {
        name: colour
        for names, colour in re.findall(r"((?:#banner\.\w+, )*#banner\.\w+) \{ background: (#[0-9a-f]{6})", STYLE)
        for name in re.findall(r"#banner\.(\w+)", names)
        if name != "ok"
    }
    (found["ok"],) = re.findall(r"#well \{ background: (#[0-9a-f]{6})", STYLE)
    return found


def test_the_measure_knows_what_a_deuteranope_confuses() -> None:
    assert delta_e("#000000", "#ffffff", np.eye(3)) == pytest.approx(100.0, abs=0.1)
    red_green = delta_e("#c86464", "#848400", np.eye(3)), delta_e("#c86464", "#848400", DEUTERANOPE)
    assert red_green[1] < 0.6 * red_green[0]


@pytest.mark.parametrize(("one", "other"), list(combinations(("problem", "warning", "ok", "unknown"), 2)))
@pytest.mark.parametrize("seen", [np.eye(3), DEUTERANOPE], ids=["all", "deuteranope"])
def test_banners_are_told_apart(one: str, other: str, seen: np.ndarray) -> None:
    found = grounds()
    assert delta_e(found[one], found[other], seen) >= LEAST_DELTA_E


@pytest.mark.parametrize("theme", [":root", ":root.light"])
@pytest.mark.parametrize("pair", TOLD_APART)
@pytest.mark.parametrize("seen", [np.eye(3), DEUTERANOPE], ids=["all", "deuteranope"])
def test_what_is_drawn_is_told_apart(theme: str, pair: tuple[str, str], seen: np.ndarray) -> None:
    found = variables(STYLE.split(f"{theme} {{")[1].split("}")[0])
    assert delta_e(found[pair[0]], found[pair[1]], seen) >= LEAST_DELTA_E
