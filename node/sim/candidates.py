"""Light candidates without pictures: what a detector with given noise and given errors would publish."""

from __future__ import annotations

import math

import numpy as np
from buddyline.node.sim.glow import stands_out
from buddyline.node.sim.randomness import generator
from buddyline.node.sim.scene import LAMP_RADIUS_M, Lamp, Scene, SceneView
from buddyline.protocol.messages import MAX_BLOBS, Blob


def visible(scene: Scene, index: int, view: SceneView, lamp: Lamp) -> bool:
    """Return whether a lamp is inside the picture, not hidden, and bright enough to be seen.

    index: of the observer.
    """
    u, v = lamp.pixel
    scenario, camera = scene.scenario, scene.rigs[index].camera
    inside = -0.5 <= u <= scenario.width_px - 0.5 and -0.5 <= v <= scenario.height_px - 0.5
    return bool(inside) and not view.hidden(lamp.pixel) and stands_out(lamp, scenario.water, camera.fx_px)


def blobs(scene: Scene, index: int, view: SceneView, stamp_ns: int) -> tuple[list[Blob], int]:
    """Return the candidates of one picture in random order, and how many did not fit into a message.

    Lights in view have the noise sigma_px; some are off by gross_px more, some are missed. Other lamps and reflections
    are treated as lights are. `false_lights` more are at random places.
    """
    scenario = scene.scenario
    rng = generator(scenario.seed, "candidates", index, stamp_ns)
    found: list[Blob] = []
    for lamp in (*view.lights, *view.others):
        draw = rng.standard_normal(4)
        missed, gross = rng.random(2) < (scenario.miss_share, scenario.gross_share)
        if missed or not visible(scene, index, view, lamp):
            continue
        pixel = lamp.pixel + scenario.sigma_px * draw[:2] + gross * scenario.gross_px * draw[2:]
        size_px = 2 + 2 * LAMP_RADIUS_M * scene.rigs[index].camera.fx_px / lamp.range_m
        found += _blob(scene, pixel, math.pi * size_px**2 * float(rng.uniform(0.8, 1.25)))
    for _ in range(scenario.false_lights):
        pixel = rng.uniform((-0.5, -0.5), (scenario.width_px - 0.5, scenario.height_px - 0.5))
        found += _blob(scene, pixel, float(rng.lognormal(4.5, 0.7)))
    order = rng.permutation(len(found))[:MAX_BLOBS]
    return [found[i] for i in order], len(found) - len(order)


def _blob(scene: Scene, pixel: np.ndarray[tuple[int], np.dtype[np.float64]], area_px: float) -> list[Blob]:
    """Return one candidate, or an empty list where it is outside the picture."""
    scenario = scene.scenario
    u, v = float(pixel[0]), float(pixel[1])
    if not (-0.5 <= u <= scenario.width_px - 0.5 and -0.5 <= v <= scenario.height_px - 0.5):
        return []
    return [
        Blob(
            u_px=u,
            v_px=v,
            sigma_px=scenario.sigma_px,
            area_px=area_px,
            peak=255.0,
            elongation=1.0,
            dt_ns=round(scene.row_delay_s(v) * 1e9),
        )
    ]
