"""Coordinate systems by the names that Survex and Therion give them. Needs pyproj."""

from __future__ import annotations

import math
import re
from functools import lru_cache
from typing import TYPE_CHECKING, Any, Final

from buddyline.protocol.errors import BuddylineError
from buddyline.tools.survey.geodesy import convergence_rad
from buddyline.tools.survey.old.model import OldFix, OldSurvey

if TYPE_CHECKING:
    from pyproj import CRS

DEGREES: Final = "long-lat"
# Names to codes of the EPSG registry; iJTSK is S-JTSK with axes to east and north.
CODES: Final = {"long-lat": 4326, "s-merc": 3857, "ijtsk": 5514, "ijtsk03": 8353, "etrs": 4258}


@lru_cache(maxsize=64)
def crs_of(name: str) -> CRS:
    """Return a coordinate system; raise BuddylineError naming it."""
    try:
        from pyproj import CRS
        from pyproj.exceptions import CRSError
    except ModuleNotFoundError as error:
        raise BuddylineError("a coordinate system needs pyproj: make install EXTRAS=survey") from error
    word, known = name.strip(), CODES.get(name.strip().lower())
    wanted: Any = known
    if match := re.fullmatch(r"(?i)utm(\d{1,2})([ns]?)", word):
        wanted = (32700 if match[2].lower() == "s" else 32600) + int(match[1])
    elif match := re.fullmatch(r"(?i)eur79z(\d{1,2})", word):
        wanted = 23000 + int(match[1])
    elif match := re.fullmatch(r"(?i)etrs(\d{1,2})", word):
        wanted = 25800 + int(match[1])
    elif match := re.fullmatch(r"(?i)(epsg|esri):(\d+)", word):
        wanted = f"{match[1].upper()}:{match[2]}"
    elif match := re.fullmatch(r"(?i)(?:custom\s+)?(\+.*)", word):
        wanted = match[1]
    if wanted is None:
        raise BuddylineError(f"coordinate system {name!r} is not known here; name it by its EPSG code")
    try:
        return CRS.from_user_input(wanted)
    except CRSError as error:
        raise BuddylineError(f"coordinate system {name!r}: PROJ has none of this name") from error


def moved(fix: OldFix, system: str) -> tuple[float, float]:
    """Return a fixed point's x and y in another coordinate system; raise BuddylineError outside of it."""
    from pyproj import Transformer

    if not fix.system or fix.system == system:
        return fix.position[:2]
    change = Transformer.from_crs(crs_of(fix.system), crs_of(system), always_xy=True)
    x, y = change.transform(*fix.position[:2])
    if not math.isfinite(x + y):
        raise BuddylineError(f"{fix.place}: {fix.position[:2]} is outside of {system}")
    return float(x), float(y)


def map_system(survey: OldSurvey) -> str:
    """Return the map grid that a survey is computed in: stated, or that of its fixed points; empty without one."""
    if survey.system:
        return survey.system
    systems = [fix for fix in survey.fixes if fix.system]
    for fix in systems:
        if crs_of(fix.system).is_projected:
            return fix.system
    for fix in systems:
        longitude_deg, latitude_deg = fix.position[:2] if fix.system == DEGREES else moved(fix, DEGREES)
        return f"UTM{min(int((longitude_deg + 180) // 6) + 1, 60)}{'N' if latitude_deg >= 0 else 'S'}"
    return ""


def convergence_deg(survey: OldSurvey, system: str = "") -> float:
    """Return the azimuth of grid north at the first fixed point of a survey; 0 without a map grid."""
    system = system or map_system(survey)
    known = next((fix for fix in survey.fixes if fix.system), None)
    if not system or known is None or not crs_of(system).is_projected:
        return 0.0
    from pyproj import Transformer

    longitude_deg, latitude_deg = known.position[:2] if known.system == DEGREES else moved(known, DEGREES)
    to_map = Transformer.from_crs("EPSG:4326", crs_of(system), always_xy=True)
    return math.degrees(convergence_rad(to_map, latitude_deg, longitude_deg))
