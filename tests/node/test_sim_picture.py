"""Rendered pictures against what is known of light in water, and against their own truth."""

import cv2
import numpy as np
import pytest
from buddyline.node.sim.glow import FAR_PX, GLARE, NEAR_PX, SCALE_PX, GlowRenderer, phase, stands_out
from buddyline.node.sim.rig import SPILL
from buddyline.node.sim.scenario import DECOYS, ENVIRONMENTS, WATERS, Scenario
from buddyline.node.sim.scene import Lamp
from buddyline.node.sim.world import World
from buddyline.protocol.errors import BuddylineError

S_NS = 1_000_000_000
BEAM_RAD = np.radians(12)
QUIET = {"interruptions": False, "other_lamps": 0}


def _cores(image, level):
    """Return (area, u, v) of the regions where every colour is at least at level."""
    count, _, stats, centres = cv2.connectedComponentsWithStats((image.min(axis=2) >= level).astype(np.uint8))
    return [(int(stats[i, cv2.CC_STAT_AREA]), *centres[i]) for i in range(1, count)]


@pytest.mark.parametrize("environment", ENVIRONMENTS)
def test_a_near_light_is_a_clipped_core_at_its_true_place(environment):
    """Dark water clips most lights; scattering may pull a core along the beam, by less than its own radius."""
    world = World(Scenario(environment=environment, seed=2, **QUIET))
    image = world.render("a", S_NS)
    assert image.shape == (616, 820, 3)
    assert image.dtype == np.uint8
    cores = _cores(image, 250)
    for light in world.light_truth("a", S_NS, 0).lights:
        assert light.visible
        area, u, v = min(cores, key=lambda core: np.hypot(core[1] - light.u_px, core[2] - light.v_px))
        assert np.hypot(u - light.u_px, v - light.v_px) < 0.5 * np.sqrt(area / np.pi)


def test_without_scattering_the_centroid_is_the_source_to_a_fraction_of_a_pixel():
    """In the clear basin: the disc, its edge and the sub-pixel place are unbiased."""
    errors = []
    for seed in range(2):
        world = World(Scenario(environment="basin", seed=seed, **QUIET))
        stamps = [k * S_NS for k in (1, 2, 4)]
        views = [
            (world.render("b", ns).astype(float), x) for ns in stamps for x in world.light_truth("b", ns, 0).lights
        ]
        for image, light in views:
            u, v = round(light.u_px), round(light.v_px)
            if not (light.visible and 20 < u < 800 and 20 < v < 596):
                continue
            patch = np.clip(image[v - 18 : v + 19, u - 18 : u + 19].min(axis=2) - 150, 0, None)
            rows, columns = np.mgrid[v - 18 : v + 19, u - 18 : u + 19]
            errors.append(((patch * columns).sum() / patch.sum() - light.u_px,
                           (patch * rows).sum() / patch.sum() - light.v_px))  # fmt: skip
    assert len(errors) >= 8
    assert np.abs(np.mean(errors, axis=0)).max() < 0.1
    assert np.abs(errors).max() < 0.5


def _lamp(toe_rad, range_m=2.0, width_px=820, height_px=616):
    aim = np.array([np.sin(toe_rad), 0.0, -np.cos(toe_rad)])
    return Lamp(np.array([0.0, 0.0, range_m]), aim, np.array([(width_px - 1) / 2, (height_px - 1) / 2]), 1.0, BEAM_RAD)


def _linear(renderer, lamp, width_px=820, height_px=616):
    coarse = np.zeros((*renderer.coarse_shape, 3), np.float32)
    table = renderer.table(lamp)
    renderer.add_wide(coarse, lamp, table)
    full = cv2.resize(coarse, (width_px, height_px))
    renderer.add_near(full, lamp, table)
    return full


def test_the_glow_leans_along_the_beam():
    """detection.md, 1: a lamp toed out by a few degrees pulls its own glow outwards; one that points here does not."""
    renderer = GlowRenderer(WATERS["lake"], 820, 616, 904.0)
    for toe_deg, expected in ((0.0, 0.0), (6.0, 1.0), (-6.0, -1.0)):
        glow = _linear(renderer, _lamp(np.radians(toe_deg)))[..., 1]
        right, left = glow[:, 450:].sum(), glow[:, :370].sum()
        assert np.sign(np.round(right / left - 1, 2)) == expected


def test_a_lamp_is_called_visible_where_its_pixel_stands_out():
    """The judgement against the rendering: at either side of it the pixel is, and is not, lost in noise."""
    water = WATERS["lake"]
    renderer = GlowRenderer(water, 820, 616, 904.0)
    judged = []
    for range_m in np.arange(2.0, 30.0, 1.0):
        lamp = _lamp(np.radians(20), range_m)
        light = _linear(renderer, lamp)[307:309, 409:411].max(axis=(0, 1))
        step = 255 * (np.sqrt(light + water.ambient) - np.sqrt(water.ambient)).max()
        judged.append((stands_out(lamp, water, 904.0), step / water.noise))
    seen, lost = ([step for told, step in judged if told is answer] for answer in (True, False))
    assert seen
    assert lost
    assert min(seen) > 3
    assert max(lost) < 10


def test_more_turbid_water_has_more_glow_about_a_weaker_light():
    cavern, lake = (GlowRenderer(WATERS[name], 820, 616, 904.0) for name in ("cavern", "lake"))
    shares = []
    for renderer, name in ((cavern, "cavern"), (lake, "lake")):
        linear = _linear(renderer, _lamp(np.radians(5)))[..., 1] / WATERS[name].lamp_gain
        shares.append((linear[307, 409], linear[300, 470]))
    assert shares[1][0] < shares[0][0]
    assert shares[1][1] / shares[1][0] > 2 * shares[0][1] / shares[0][0]


def test_near_and_wide_glow_join_without_a_seam():
    """The glow falls steadily through the ring where the full picture takes over from the coarse one."""
    lamp = _lamp(np.radians(5))
    row = _linear(GlowRenderer(WATERS["night_reef"], 820, 616, 904.0), lamp)[307, 410:, 1].astype(float)
    rho = np.arange(0.5, row.size)
    ring = (rho > NEAR_PX - 12) & (rho < FAR_PX + 30)
    x, y = np.log(rho[ring]), np.log(row[ring])
    np.testing.assert_allclose(y, np.polyval(np.polyfit(x, y, 3), x), atol=0.01)


def test_the_table_follows_the_integral():
    """The polar table against a plain sum over the sight ray, at one place of a picture."""
    water, lamp = WATERS["night_reef"], _lamp(np.radians(6), range_m=3.0)
    renderer = GlowRenderer(water, 820, 616, 904.0)
    offset_px = 90.0
    coarse = np.zeros((*renderer.coarse_shape, 3), np.float32)
    renderer.add_wide(coarse, lamp, renderer.table(lamp))
    found = coarse[77, round((409.5 + offset_px) / 4), 1]
    ray = np.array([((round((409.5 + offset_px) / 4) + 0.5) * 4 - 0.5 - 409.5) / 904, 0.5 / 904, 1.0])
    ray /= np.linalg.norm(ray)
    s = np.linspace(0.005, 25, 200_000)
    path = s[:, None] * ray - lamp.position_m
    d1 = np.linalg.norm(path, axis=1)
    cos_scatter = -(path @ ray) / d1
    cos_beam = path @ lamp.aim / d1
    beam = SPILL + (1 - SPILL) * np.exp(-(1 - cos_beam) / BEAM_RAD**2)
    k = water.absorption_per_m[1] + 0.3 * water.scattering_per_m[1]
    scattered = water.scattering_per_m[1] * np.trapezoid(
        phase(cos_scatter, water) * beam * np.exp(-k * (d1 + s)) / d1**2, s
    )
    flux_px = (
        904.0**2 * np.exp(-k * 3.0) / 9.0 * (SPILL + (1 - SPILL) * np.exp(-(1 - np.cos(np.radians(6))) / BEAM_RAD**2))
    )
    rho = np.hypot(ray[0], ray[1]) / ray[2] * SCALE_PX
    glare = GLARE * (SCALE_PX / 904.0) ** 2 / (2 * np.pi) / (rho**2 + 9) ** 1.25 * flux_px
    assert found == pytest.approx(water.lamp_gain * (scattered + glare), rel=0.05)


@pytest.mark.parametrize("environment", ENVIRONMENTS)
def test_scattering_loses_and_makes_no_light(environment):
    cos_angle = np.linspace(-1, 1, 2_000_001)
    total = 2 * np.pi * np.trapezoid(phase(cos_angle, WATERS[environment]), cos_angle)
    assert total == pytest.approx(1.0, abs=1e-3)


def test_a_passer_hides_the_light_that_truth_calls_hidden():
    world = World(Scenario(seed=3, environment="cavern", other_lamps=0))
    checked = 0
    for stamp_ns in range(0, 150 * S_NS, S_NS // 2):
        for node in "ab":
            lights = world.light_truth(node, stamp_ns, 0).lights
            for light in lights:
                u, v = round(light.u_px), round(light.v_px)
                if light.visible or light.merged or not (0 <= u < 820 and 0 <= v < 616):
                    continue
                assert world.render(node, stamp_ns)[v, u].max() < 200
                checked += 1
        if checked >= 3:
            break
    assert checked >= 3


def test_lights_that_are_close_are_marked_as_merged():
    for baseline_m, merged in ((0.05, True), (0.88, False)):
        world = World(Scenario(environment="cavern", seed=1, baseline_b_m=baseline_m, **QUIET))
        truth = world.light_truth("a", 4 * S_NS, 0)
        assert [light.merged for light in truth.lights] == [merged] * 2
        assert world.light_truth("b", 4 * S_NS, 0).lights[0].merged is False


@pytest.mark.parametrize(("width_px", "height_px"), [(1640, 1232), (333, 211), (64, 48)])
def test_any_picture_size_works(width_px, height_px):
    world = World(Scenario(environment="basin", width_px=width_px, height_px=height_px))
    image = world.render("b", 3 * S_NS)
    assert image.shape == (height_px, width_px, 3)
    assert image.std() > 1


def test_noise_is_new_in_every_frame_and_of_the_stated_size():
    world = World(Scenario(environment="lake", seed=1, trajectory="rest", **QUIET))
    one, two = (world.render("a", k * S_NS).astype(float) for k in range(2))
    difference = (one - two)[:60, :300]
    assert np.std(difference) == pytest.approx(np.sqrt(2) * WATERS["lake"].noise, rel=0.15)


@pytest.mark.parametrize("decoy", DECOYS)
def test_each_decoy_is_drawn_and_moves_no_lamp(decoy):
    plain, fooled = (World(Scenario("cavern", seed=4, decoys=decoys, **QUIET)) for decoys in ((), (decoy,)))
    changed = cv2.absdiff(plain.render("a", S_NS), fooled.render("a", S_NS)).max(axis=2) > 20
    assert changed.sum() > 15
    assert plain.light_truth("a", S_NS, 0) == fooled.light_truth("a", S_NS, 0)
    assert np.array_equal(fooled.render("a", S_NS), fooled.render("a", S_NS))


def test_an_unknown_decoy_is_refused():
    with pytest.raises(BuddylineError, match="decoys: 'fish'"):
        Scenario(decoys=("fish",))


def test_the_lamps_of_anyone_are_told_and_reflections_are_not():
    world = World(Scenario("basin", seed=4, other_lamps=2, interruptions=False))
    assert len(world.lamps("a", S_NS)) <= 4
    own = world.light_truth("a", S_NS, 0).lights
    assert {(x.u_px, x.v_px, x.visible) for x in own} <= set(world.lamps("a", S_NS))
