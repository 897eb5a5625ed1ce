"""What is in force for rows of readings, and the commands that set it: what Survex and Therion share."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import date
from typing import Final, Literal

from buddyline.tools.survey.old.model import North, Style
from buddyline.tools.survey.old.source import SourceLine

# Other names of quantities, in both languages.
QUANTITIES: Final[Mapping[str, str]] = {
    "length": "tape",
    "backlength": "backtape",
    "bearing": "compass",
    "backbearing": "backcompass",
    "gradient": "clino",
    "backgradient": "backclino",
    "counter": "count",
    "ceiling": "up",
    "floor": "down",
    "easting": "dx",
    "northing": "dy",
    "altitude": "dz",
    "fromcounter": "fromcount",
    "tocounter": "tocount",
    "dep": "depth",
    "fromdep": "fromdepth",
    "todep": "todepth",
}
ANGLES: Final = frozenset(("compass", "backcompass", "clino", "backclino", "declination", "level", "plumb"))
LENGTHS: Final = frozenset(
    ("tape", "backtape", "count", "depth", "dx", "dy", "dz", "left", "right", "up", "down", "position", "x", "y", "z")
)
FOOT_M: Final = 0.3048
LENGTH_UNITS: Final[Mapping[str, float]] = {
    **dict.fromkeys(("metric", "metres", "meters", "metre", "meter", "m"), 1.0),
    **dict.fromkeys(("feet", "foot", "ft"), FOOT_M),
    **dict.fromkeys(("yards", "yard", "yd"), 3 * FOOT_M),
    **dict.fromkeys(("centimeters", "centimetres", "centimeter", "cm"), 0.01),
    **dict.fromkeys(("inches", "inch", "in"), FOOT_M / 12),
}
ANGLE_UNITS: Final[Mapping[str, float]] = {
    **dict.fromkeys(("degs", "degrees", "degree", "deg"), 1.0),
    **dict.fromkeys(("grads", "grad", "mils", "mil"), 0.9),
    **dict.fromkeys(("minutes", "minute", "min"), 1 / 60),
    **dict.fromkeys(("percent", "percentage", "quads", "quadrants"), math.nan),
}
STYLES: Final[Mapping[str, Style | Literal["passage", "ignore"]]] = {
    **{name: "normal" for name in ("normal", "topofil", "default")},
    **{"diving": "diving", "cartesian": "cartesian", "cylpolar": "cylpolar", "nosurvey": "nosurvey"},
    **{"passage": "passage", "dimensions": "passage", "ignore": "ignore"},
}
NORMAL_ORDER: Final = ("from", "to", "tape", "compass", "clino")


@dataclass(frozen=True)
class RowSettings:
    """What is in force for the next row. units: factor to metres or degrees; zeros, scales: of calibrations."""

    style: Style | Literal["passage", "ignore"] = "normal"
    order: tuple[str, ...] = NORMAL_ORDER
    units: Mapping[str, float] = field(default_factory=dict)
    percent: frozenset[str] = frozenset()
    zeros: Mapping[str, float] = field(default_factory=dict)
    scales: Mapping[str, float] = field(default_factory=dict)
    sigmas: Mapping[str, float] = field(default_factory=dict)
    flags: frozenset[str] = frozenset()
    inferred: frozenset[str] = frozenset()
    north: North = field(default_factory=North)
    when: date | None = None
    extend: str = ""


def quantities(words: Sequence[str], line: SourceLine) -> list[str]:
    """Return the quantities that a command names; raise OldSurveyError."""
    found = [QUANTITIES.get(word.lower(), word.lower()) for word in words]
    for word, name in zip(words, found, strict=True):
        if name not in ANGLES | LENGTHS:
            raise line.error(f"{word!r} is no quantity")
    return found


def factor_of(word: str, names: Sequence[str], line: SourceLine) -> float:
    """Return a unit's factor to metres or degrees; NaN for per cent and quadrants."""
    factors = ANGLE_UNITS if names and names[0] in ANGLES else LENGTH_UNITS
    if word.lower() not in factors:
        raise line.error(f"{word!r} is no unit of {names[0] if names else 'anything'}")
    return factors[word.lower()]


def with_units(settings: RowSettings, words: Sequence[str], line: SourceLine) -> RowSettings:
    """Return settings after `units QUANTITY... [FACTOR] UNIT`."""
    if [word.lower() for word in words] == ["default"]:
        return replace(settings, units={}, percent=frozenset())
    head, times = list(words[:-1]), 1.0
    if head and is_number(head[-1]):
        times = line.number_of(head.pop(), "factor")
        if times == 0:
            raise line.error("factor: '0' makes every reading zero")
    if not head:
        raise line.error(f"units: {' '.join(words)!r} is not QUANTITY... UNIT")
    names = quantities(head, line)
    factor = factor_of(words[-1], names, line)
    percent = settings.percent - set(names)
    if math.isnan(factor):
        percent, factor = percent | set(names), 1.0
    return replace(settings, units={**settings.units, **dict.fromkeys(names, factor * times)}, percent=percent)


def with_calibration(settings: RowSettings, words: Sequence[str], line: SourceLine) -> RowSettings:
    """Return settings after `calibrate QUANTITY... ZERO [UNIT] [SCALE]`."""
    if [word.lower() for word in words] == ["default"]:
        return replace(settings, zeros={}, scales={}, north=North())
    first = next((i for i, word in enumerate(words) if is_number(word)), None)
    if not first:
        raise line.error(f"calibrate: {' '.join(words)!r} is not QUANTITY... ZERO [SCALE]")
    names, rest = quantities(words[:first], line), list(words[first + 1 :])
    zero = line.number_of(words[first], "zero error")
    outside = bool(rest) and not is_number(rest[0])
    unit = factor_of(rest.pop(0), names, line) if outside else None
    scale = line.number_of(rest[0], "scale") if rest else 1.0
    if len(rest) > 1:
        raise line.error(f"calibrate: {rest[1]!r} is too much")
    if scale == 0:
        raise line.error(f"scale: {rest[0]!r} makes every reading zero")
    if names == ["declination"]:
        return replace(settings, north=North("grid", -zero * (unit or settings.units.get("declination", 1.0))))
    zeros, scales = dict(settings.zeros), dict(settings.scales)
    for name in names:
        own = settings.units.get(name, 1.0) if unit is None else unit
        # A zero of another measure is not scaled: then it counts as what it is before scaling.
        zeros[name] = zero * own / (scale if outside else 1.0)
        scales[name] = scale
    return replace(settings, zeros=zeros, scales=scales)


def with_sigmas(settings: RowSettings, words: Sequence[str], line: SourceLine) -> RowSettings:
    """Return settings after `sd QUANTITY... VALUE UNIT`."""
    if len(words) < 2:
        raise line.error(f"sd: {' '.join(words)!r} is not QUANTITY... VALUE UNIT")
    if is_number(words[-1]):
        head, value, unit = words[:-1], words[-1], ""
    else:
        head, value, unit = words[:-2], words[-2], words[-1]
    names = quantities(head, line)
    sigma = line.number_of(value, "standard deviation")
    if sigma <= 0:
        raise line.error(f"standard deviation: {value!r} is not above zero")
    return replace(
        settings,
        sigmas={**settings.sigmas, **{n: sigma * (factor_of(unit, [n], line) if unit else 1.0) for n in names}},
    )


def is_number(word: str) -> bool:
    """Return whether a word is a number."""
    try:
        float(word)
    except ValueError:
        return False
    return True


def with_inferred(settings: RowSettings, words: Sequence[str], line: SourceLine) -> RowSettings:
    """Return settings after `infer WHAT on|off`."""
    if len(words) != 2 or words[1].lower() not in ("on", "off"):
        raise line.error(f"infer: {' '.join(words)!r} is not WHAT on, or WHAT off")
    what = frozenset((words[0].lower(),))
    on = words[1].lower() == "on"
    return replace(settings, inferred=settings.inferred | what if on else settings.inferred - what)


# Commands that both languages have, to what they change.
CHANGES: Final[Mapping[str, Callable[[RowSettings, Sequence[str], SourceLine], RowSettings]]] = {
    "units": with_units,
    "calibrate": with_calibration,
    "sd": with_sigmas,
    "infer": with_inferred,
}


def with_flags(settings: RowSettings, words: Sequence[str], known: Mapping[str, str], line: SourceLine) -> RowSettings:
    """Return settings after `flags [not] FLAG...`; known: what may be said, to the flag that it means."""
    flags, on = set(settings.flags), True
    for word in (one.lower() for one in words):
        if word == "not":
            on = False
            continue
        if word not in known:
            raise line.error(f"flags {word}: no such flag; known: {' '.join(sorted(known))}")
        flags = flags | {known[word]} if on else flags - {known[word]}
        on = True
    return replace(settings, flags=frozenset(flags))


def sigmas_of_fix(stated: Sequence[float]) -> tuple[float, float, float]:
    """Return 1 sd of x, y and z: none stated, one of all, two of map and height, or three, and then covariances."""
    if not stated:
        return 0.0, 0.0, 0.0
    if len(stated) < 3:
        return stated[0], stated[0], stated[-1]
    return stated[0], stated[1], stated[2]


def date_of(word: str, line: SourceLine) -> date:
    """Return the first day of a date such as 2000, 2000.10, 1987.07.27 or a range of those."""
    iso = re.match(r"(\d{4})-(\d\d)-(\d\d)(?!\d)", word)
    match = iso or re.match(r"(\d{4}|\d{2}(?!\d))(?:\.(\d{1,2}))?(?:\.(\d{1,2}))?(?=$|[-@:.])", word)
    try:
        if match is None:
            raise ValueError
        year = int(match[1]) + (1900 if len(match[1]) == 2 else 0)
        return date(year, int(match[2] or 7), int(match[3] or 1))
    except ValueError:
        raise line.error(f"{word!r} is no date such as 1987.07.27") from None
