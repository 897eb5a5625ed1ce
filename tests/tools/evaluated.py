"""A made-up dive of two nodes with known truth, for the tests of evaluate and export."""

from __future__ import annotations

import numpy as np
from buddyline.protocol.divelog import DiveLogWriter
from buddyline.protocol.messages import (
    Blob,
    CameraModel,
    Candidates,
    LightTruth,
    NodeInfo,
    Rejected,
    RelativePose,
    Track,
    TrueLight,
    Truth,
)

PERIOD_NS = 100_000_000
FIRST = 17_640_000_000
WIDTH, HEIGHT = 820, 616
FACING = (0.0, 1.0, 0.0, 0.0)
COVARIANCE = np.diag([1e-4, 1e-4, 4e-4, 1e-6, 1e-6, 4e-6])
# Both nodes look at each other 3 m apart: the other's left light stands right of the middle.
OFFSET_PX = 904.0 * 0.44 / 3.0
LEFT = (409.5 + OFFSET_PX, 307.5)
RIGHT = (409.5 - OFFSET_PX, 307.5)
FALSE = (100.0, 50.0)


def info(node: str, **changes: object) -> NodeInfo:
    values: dict[str, object] = {
        "node": node,
        "stamp_ns": FIRST * PERIOD_NS,
        "width_px": WIDTH,
        "height_px": HEIGHT,
        "camera": CameraModel(
            model="pinhole", fx_px=904.0, fy_px=904.0, cx_px=409.5, cy_px=307.5, distortion=[0.0] * 5
        ),
        "light_left_m": (-0.44, 0.0, 0.0),
        "light_right_m": (0.44, 0.0, 0.0),
        "sigma_px": 0.5,
        "trigger_period_ns": PERIOD_NS,
    }
    return NodeInfo(**(values | changes))  # type: ignore[arg-type]


INFOS = {node: info(node) for node in "ab"}


def truth(k: int, t_m: tuple[float, float, float] = (0.0, 0.0, 3.0), **changes: object) -> Truth:
    values: dict[str, object] = {"trigger": FIRST + k, "q_a_b_xyzw": FACING}
    return Truth(stamp_ns=(FIRST + k) * PERIOD_NS, t_a_b_m=t_m, **(values | changes))  # type: ignore[arg-type]


def pose(k: int, t_m: tuple[float, float, float] = (0.0, 0.0, 3.0), **changes: object) -> RelativePose:
    values: dict[str, object] = {
        "node_a": "a",
        "node_b": "b",
        "stamp_ns": (FIRST + k) * PERIOD_NS,
        "trigger": FIRST + k,
        "t_a_b_m": t_m,
        "q_a_b_xyzw": FACING,
        "covariance": COVARIANCE.ravel().tolist(),
        "range_m": float(np.linalg.norm(t_m)),
        "range_a_m": 3.0,
        "range_b_m": 3.0,
        "range_gap_m": 0.0,
        "twist_gap_rad": 0.0,
        "chi2": 0.5,
        "hypotheses": 4,
        "blobs_a": (0, 1),
        "blobs_b": (0, 1),
        "method": "refined",
        "checks": ["range", "twist"],
        "skew_ns": 1_000_000,
    }
    return RelativePose(**(values | changes))  # type: ignore[arg-type]


def track(k: int, t_m: tuple[float, float, float] = (0.0, 0.0, 3.0), sigma_m: float = 0.01, **changes: object) -> Track:
    values: dict[str, object] = {
        "node_a": "a",
        "node_b": "b",
        "stamp_ns": (FIRST + k) * PERIOD_NS,
        "t_a_b_m": t_m,
        "q_a_b_xyzw": FACING,
        "covariance": np.diag([sigma_m**2 / 3] * 3 + [1e-6] * 3).ravel().tolist(),
        "v_a_b_mps": (0.0, 0.0, 0.0),
        "v_covariance": np.eye(3).ravel().tolist(),
        "mode": "filter",
        "lights": 4,
        "age_s": 0.0,
        "range_m": float(np.linalg.norm(t_m)),
    }
    return Track(**(values | changes))  # type: ignore[arg-type]


def rejection(k: int, reason: str = "ambiguous") -> Rejected:
    return Rejected(
        node_a="a",
        node_b="b",
        stamp_ns=(FIRST + k) * PERIOD_NS,
        trigger=FIRST + k,
        reason=reason,  # type: ignore[arg-type]
        detail="two, alike",
    )


def frame(
    node: str,
    k: int,
    pixels: tuple[tuple[float, float], ...] = (LEFT, RIGHT, FALSE),
    sigma_px: float = 0.5,
    width_px: int = WIDTH,
) -> Candidates:
    return Candidates(
        node=node,
        stamp_ns=(FIRST + k) * PERIOD_NS,
        trigger=FIRST + k,
        seq=k,
        boot="t",
        width_px=width_px,
        height_px=HEIGHT,
        blobs=[Blob(u_px=u, v_px=v, sigma_px=sigma_px, area_px=20.0, peak=255.0, elongation=1.0) for u, v in pixels],
    )


def light_truth(
    node: str,
    k: int,
    visible: tuple[bool, bool] = (True, True),
    left: tuple[float, float] = LEFT,
    right: tuple[float, float] = RIGHT,
) -> LightTruth:
    return LightTruth(
        node=node,
        stamp_ns=(FIRST + k) * PERIOD_NS,
        trigger=FIRST + k,
        lights=[
            TrueLight(name="left", u_px=left[0], v_px=left[1], visible=visible[0], merged=False),
            TrueLight(name="right", u_px=right[0], v_px=right[1], visible=visible[1], merged=False),
        ],
    )


def write_log(path: object, *messages: object, pair: str = "a/b") -> str:
    """Write messages into a log, truth under the given pair, and tracks as `solve` writes them."""
    with DiveLogWriter(str(path)) as writer:
        for message in messages:
            key = f"buddyline/pair/{pair}/truth" if isinstance(message, Truth) else None
            if isinstance(message, Track) and message.mode != "lag":
                key = f"buddyline/pair/{pair}/track"
            writer.write_message(message, key=key)  # type: ignore[arg-type]
    return str(path)
