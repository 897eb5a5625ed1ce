"""Golden results: JSON lines, a record a line, compared with stated tolerances and rewritten where they differ.

The first line says with which OpenCV, numpy and processor the rest was made, and the command's exit status.
"""

import json
import platform
import zlib
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

from tests.golden.stages import UPPER, Record

FOLDER = Path(__file__).parent / "references"
# Of its own sigma: what rounding may do to a pose, and nothing else may.
SIGMAS = 1e-6
PIXELS = 1e-6
# Another OpenCV or processor decodes a JPEG, and blurs a picture, to within a grey level: not to the same bits.
# What is made of pictures is then compared as loosely as this, and those candidates that are likelier lamps than not.
LOOSE_SIGMAS = 0.1
LOOSE_PIXELS = 0.05
LOOSE_SCORE = 0.5
SHOWN = 12
ANGLES = ("azimuth_rad", "sigma_azimuth_rad", "inclination_rad", "sigma_inclination_rad")

Compare = Callable[[Record, Record, bool], list[str]]


def made_with() -> dict[str, str]:
    """Return what the last digits of a result depend on, beside our own code.

    products: a checksum of some matrix products. numpy's linear algebra adds up their terms in an order that depends on
    the processor. The detector samples pictures at 32nds of a pixel, so the last bit of a place may change a sample by
    a grey level.
    """
    terms = np.sqrt(np.arange(7200.0)).reshape(150, 48)
    sums = [rows @ columns for rows in (terms, terms.astype(np.float32)) for columns in (rows[:10].T, rows[0])]
    products = zlib.crc32(b"".join(each.tobytes() for each in sums))
    processor = platform.machine()
    return {"opencv": cv2.__version__, "numpy": np.__version__, "processor": processor, "products": f"{products:08x}"}


def check(
    name: str,
    result: tuple[int, list[Record]],
    compare: Compare,
    update: bool,
    pictures: bool = False,
    other_machine: bool = False,
) -> None:
    """Compare a stage's result with its reference, or rewrite of the reference what has changed.

    pictures: whether the result depends on OpenCV, and is compared loosely where that is another one. other_machine:
    the result is not of the processor on which this runs.
    """
    path = FOLDER / f"{name}.jsonl"
    status, found = result
    header: Record = {"exit": status, "made_with": made_with()}
    if update:
        old = _read(path)
        same = bool(old) and old[0].get("made_with") == header["made_with"]
        # A line that is still right stays as it is: a diff shows what has changed, not the machine's last digits.
        kept = _by_key(old[1:]) if same else {}
        lines = [header] + [
            kept[key] if key in kept and not compare(kept[key], one, False) else one
            for key, one in _by_key(found).items()
        ]
        path.parent.mkdir(exist_ok=True)
        path.write_text("".join(json.dumps(line, separators=(",", ":")) + "\n" for line in lines))
        return
    assert path.exists(), f"{path.name} is missing: run pytest tests/golden --update-refs"
    reference = _read(path)
    loose = pictures and (other_machine or reference[0]["made_with"] != header["made_with"])
    said = []
    if status != reference[0]["exit"]:
        said.append(f"exit status {status}, was {reference[0]['exit']}")
    said += differences(reference[1:], found, compare, loose)
    hidden = [f"and {len(said) - SHOWN} more"] if len(said) > SHOWN else []
    hint = "if this is meant: pytest tests/golden --update-refs, and say why in the commit"
    assert not said, "\n".join([f"{path.name} differs:", *said[:SHOWN], *hidden, hint])


def differences(reference: list[Record], found: list[Record], compare: Compare, loose: bool = False) -> list[str]:
    """Say how two lists of records differ, a line a record."""
    old, new = _by_key(reference), _by_key(found)
    said = []
    for key in sorted(old.keys() | new.keys()):
        name = " ".join(map(str, key))
        if key not in new:
            said.append(f"{name}: is gone; was {_brief(old[key])}")
        elif key not in old:
            said.append(f"{name}: is new: {_brief(new[key])}")
        else:
            wrong = compare(old[key], new[key], loose)
            said += [f"{name}: {', '.join(wrong)}"] if wrong else []
    return said


def compare_outcomes(old: Record, new: Record, loose: bool) -> list[str]:
    """Compare two outcomes of one trigger: decisions exactly, poses in units of the reference's sigma."""
    numbers = ("t_a_b_m", "q_a_b_xyzw", "covariance", "chi2", "t_ned_m")
    said = _unequal(old, new, numbers)
    if said or old["outcome"] != "pose":
        return said
    allowed = LOOSE_SIGMAS if loose else SIGMAS
    old_covariance, new_covariance = _covariance(old), _covariance(new)
    sigma = np.sqrt(np.diag(old_covariance))
    moved = np.subtract(new["t_a_b_m"], old["t_a_b_m"]) / sigma[:3]
    turned = _rotation_rad(old["q_a_b_xyzw"], new["q_a_b_xyzw"]) / sigma[3:]
    spread = (new_covariance - old_covariance) / np.outer(sigma, sigma)
    scales = {
        "position": moved,
        "rotation": turned,
        "covariance": spread,
        "chi2": (new["chi2"] - old["chi2"]) / max(1.0, old["chi2"]),
    }
    if "t_ned_m" in old:
        scales["t_ned_m"] = np.subtract(new["t_ned_m"], old["t_ned_m"]) / sigma[:3].max()
    worst = {name: float(np.abs(value).max()) for name, value in scales.items()}
    return [f"{name} by {value:.2g} sigma" for name, value in worst.items() if not value <= allowed]


def compare_tracks(old: Record, new: Record, loose: bool) -> list[str]:
    """Compare two rows of a track of one time: lights and mode exactly, numbers in units of the reference's sigma."""
    numbers = ("t_a_b_m", "q_a_b_xyzw", "covariance", "v_a_b_mps", "v_covariance", "t_ned_m", "sigma_ned_m", *ANGLES)
    said = _unequal(old, new, numbers)
    if said:
        return said
    old_covariance, new_covariance = _covariance(old), _covariance(new)
    sigma = np.sqrt(np.diag(old_covariance))
    v_sigma = np.sqrt([old["v_covariance"][index] for index in (0, 3, 5)])
    v_scale = np.outer(v_sigma, v_sigma)[np.triu_indices(3)]
    ned_sigma = np.array(old["sigma_ned_m"])
    scales = {
        "position": np.subtract(new["t_a_b_m"], old["t_a_b_m"]) / sigma[:3],
        "rotation": _rotation_rad(old["q_a_b_xyzw"], new["q_a_b_xyzw"]) / sigma[3:],
        "covariance": (new_covariance - old_covariance) / np.outer(sigma, sigma),
        "velocity": np.subtract(new["v_a_b_mps"], old["v_a_b_mps"]) / v_sigma,
        "v_covariance": np.subtract(new["v_covariance"], old["v_covariance"]) / v_scale,
        "t_ned_m": np.subtract(new["t_ned_m"], old["t_ned_m"]) / ned_sigma,
        "sigma_ned_m": np.subtract(new["sigma_ned_m"], old["sigma_ned_m"]) / ned_sigma,
    }
    for name in ANGLES:
        scales[name] = np.subtract(new[name], old[name]) / old[f"sigma_{name.removeprefix('sigma_')}"]
    worst = {name: float(np.abs(value).max()) for name, value in scales.items()}
    return [f"{name} by {value:.2g} sigma" for name, value in worst.items() if not value <= SIGMAS]


def compare_frames(old: Record, new: Record, loose: bool) -> list[str]:
    """Compare the candidates of one frame."""
    said = _unequal(old, new, ("blobs",))
    if said:
        return said
    if loose:
        places = np.array([blob[:2] for blob in new["blobs"]]).reshape(-1, 2)
        return [
            f"no blob at {blob[0]:.2f}, {blob[1]:.2f}"
            for blob in old["blobs"]
            if blob[-1] >= LOOSE_SCORE and not (np.hypot(*(places - blob[:2]).T) < LOOSE_PIXELS).any()
        ]
    if len(old["blobs"]) != len(new["blobs"]):
        return [f"{len(new['blobs'])} blobs, were {len(old['blobs'])}"]
    for index, (was, now) in enumerate(zip(old["blobs"], new["blobs"], strict=True)):
        moved_px = max(abs(was[0] - now[0]), abs(was[1] - now[1]))
        if not moved_px <= PIXELS:
            return [f"blob {index} moved by {moved_px:.2g} px"]
        if not np.allclose(was[2:], now[2:], rtol=1e-6, atol=1e-9):
            return [f"blob {index} is {now[2:]}, was {was[2:]}"]
    return []


def compare_rows(old: Record, new: Record, loose: bool) -> list[str]:
    """Compare two rows of numbers written with few digits: they may differ by one in the last digit."""
    said = []
    for name in sorted(old.keys() | new.keys()):
        was, now = old.get(name), new.get(name)
        if was != now and not (isinstance(was, float) and isinstance(now, float) and _to_last_digit(was, now)):
            said.append(f"{name} is {now}, was {was}")
    return said


def compare_clocks(old: Record, new: Record, loose: bool) -> list[str]:
    """Compare two estimates of the clocks' offset: in units of sigma."""
    said = _unequal(old, new, ("offset_s", "sigma_s"))
    for name in ("offset_s", "sigma_s"):
        apart = abs(new[name] - old[name]) / old["sigma_s"]
        said += [f"{name} by {apart:.2g} sigma"] if not apart <= SIGMAS else []
    return said


def _read(path: Path) -> list[Record]:
    return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []


def _by_key(records: list[Record]) -> dict[tuple[str, ...], Record]:
    """Return records by what they are about; a second one about the same thing gets a number."""
    names = ("pair", "what", "node", "from", "to", "name", "trigger")
    found: dict[tuple[str, ...], Record] = {}
    for record in records:
        key = about = tuple(str(record[name]) for name in names if name in record)
        number = 1
        while key in found:
            number += 1
            key = (*about, f"#{number}")
        found[key] = record
    return found


def _brief(record: Record) -> str:
    shown = ("outcome", "reason", "method", "blobs_a", "blobs_b")
    return json.dumps({name: record[name] for name in shown if name in record} or record)[:200]


def _unequal(old: Record, new: Record, numbers: tuple[str, ...]) -> list[str]:
    return [
        f"{name} is {new.get(name)}, was {old.get(name)}"
        for name in sorted(old.keys() | new.keys())
        if (name in numbers and (name in old) != (name in new))
        or (name not in numbers and old.get(name) != new.get(name))
    ]


def _covariance(record: Record) -> np.ndarray:
    full = np.zeros(36)
    full[UPPER] = record["covariance"]
    full = full.reshape(6, 6)
    return full + np.triu(full, 1).T


def _rotation_rad(old: list[float], new: list[float]) -> np.ndarray:
    """Return the small rotation w, (3,), with R_new = exp(w) R_old."""
    x, y, z, w = old
    # Vector part of q_new * conj(q_old).
    nx, ny, nz, nw = new
    vector = np.array(
        [-nw * x + nx * w - ny * z + nz * y, -nw * y + nx * z + ny * w - nz * x, -nw * z - nx * y + ny * x + nz * w]
    )
    scalar = nw * w + nx * x + ny * y + nz * z
    return 2 * np.arctan2(np.linalg.norm(vector), abs(scalar)) * vector / max(float(np.linalg.norm(vector)), 1e-30)


def _to_last_digit(was: float, now: float) -> bool:
    digits = max(len(repr(value).partition(".")[2]) for value in (was, now))
    return abs(was - now) < 1.01 * 10.0**-digits
