"""The figures of a track: coverage, wrong samples, honesty, inside and outside gaps."""

import math

import numpy as np
import pytest
from buddyline.protocol.clock import S_NS
from buddyline.protocol.messages import NodePose, Track, Truth
from buddyline.tools.evaluation.rotation import conjugate, multiply, rotation_vector
from buddyline.tools.evaluation.tracks import covered_share, tracks_figures
from buddyline.tools.evaluation.truth import TruthTrack, ned_of_camera
from msgspec.structs import replace

PERIOD_NS = S_NS // 50
SIGMA_M = 0.02


class Pose:
    """What coverage asks of a pose."""

    def __init__(self, stamp_ns):
        self.stamp_ns = stamp_ns


def track(k, t_m, age_s=0.0, sigma_m=SIGMA_M, mode="smooth"):
    covariance = np.diag([sigma_m**2] * 3 + [0.01**2] * 3)
    return Track(
        node_a="a",
        node_b="b",
        stamp_ns=k * PERIOD_NS,
        t_a_b_m=tuple(map(float, t_m)),
        q_a_b_xyzw=(0.0, 1.0, 0.0, 0.0),
        covariance=covariance.ravel().tolist(),
        v_a_b_mps=(0.0, 0.0, 0.0),
        v_covariance=np.eye(3).ravel().tolist(),
        mode=mode,
        lights=4,
        age_s=age_s,
        range_m=float(np.linalg.norm(t_m)),
    )


def truths(count):
    return TruthTrack(
        [Truth(stamp_ns=k * PERIOD_NS, t_a_b_m=(0.0, 0.0, 4.0), q_a_b_xyzw=(0.0, 1.0, 0.0, 0.0)) for k in range(count)]
    )


def test_a_true_covariance_gives_a_nees_of_its_degrees_of_freedom():
    rng = np.random.default_rng(1)
    tracks = [track(k, [0, 0, 4] + SIGMA_M * rng.standard_normal(3)) for k in range(2000)]
    (figures,) = tracks_figures(tracks, [Pose(0), Pose(1999 * PERIOD_NS)], truths(2000))
    assert figures.samples == 2000
    assert figures.covered == pytest.approx(1.0, abs=1e-3)
    assert figures.wrong == 0
    assert figures.nees3.mean == pytest.approx(3.0, rel=0.1)
    assert figures.rotation_rad.median == pytest.approx(0.0, abs=1e-12)


def swum(stamp_ns):
    """Return T_a_b of a swell of 10 cm and .2 rad in two seconds, on the way with 1 m/s."""
    seconds = stamp_ns / S_NS
    angle = 0.1 * math.sin(math.pi * seconds)
    t_m = (0.1 * math.sin(math.pi * seconds), 0.0, 4.0 + seconds)
    return t_m, (0.0, math.cos(angle), math.sin(angle), 0.0)


def truth_of_swell(stamp_ns, **more):
    t_m, q_xyzw = swum(stamp_ns)
    return Truth(stamp_ns=stamp_ns, t_a_b_m=t_m, q_a_b_xyzw=q_xyzw, **more)


def test_truth_at_five_a_second_is_known_between_to_a_millimetre():
    between = TruthTrack([truth_of_swell(k * S_NS // 5) for k in range(20)])
    for stamp_ns in range(0, 19 * S_NS // 5, 7_654_321):
        t_m, q_xyzw = between.interpolated(stamp_ns)
        true_m, true_q = swum(stamp_ns)
        # At the ends there is a sample less.
        within_m = 1e-3 if S_NS // 5 <= stamp_ns <= 18 * S_NS // 5 else 4e-3
        assert t_m == pytest.approx(np.array(true_m), abs=within_m)
        turn = rotation_vector(multiply(q_xyzw, conjugate(np.array(true_q))))
        assert np.linalg.norm(turn) < 2 * within_m


def test_a_covariance_is_judged_where_truth_is_known_and_not_between_sparse_truths():
    """A track that is true between the truths too, with a sigma far below what interpolation misses there."""
    tracks = []
    for k in range(1, 180):
        t_m, q_xyzw = swum(k * PERIOD_NS)
        tracks.append(replace(track(k, t_m, sigma_m=1e-5), q_a_b_xyzw=q_xyzw))
    sparse = TruthTrack([truth_of_swell(k * S_NS // 5) for k in range(20)])
    dense = TruthTrack([truth_of_swell(k * PERIOD_NS) for k in range(200)])
    (of_sparse,), (of_dense,) = tracks_figures(tracks, [], sparse), tracks_figures(tracks, [], dense)
    assert of_sparse.samples == of_dense.samples == of_dense.nees6.count == 179
    assert of_sparse.nees6.count == 17
    assert of_sparse.nees6.mean == pytest.approx(0.0, abs=0.1)
    assert of_dense.nees6.mean == pytest.approx(0.0, abs=0.1)
    assert of_sparse.worst_m > 10e-5


def test_truth_is_close_beside_a_sample_and_between_dense_ones():
    history = TruthTrack([truth_of_swell(stamp) for stamp in (0, S_NS // 25, S_NS // 5, 2 * S_NS // 5)])
    assert history.is_close(S_NS // 50)
    assert history.is_close(S_NS // 5 - 4_000_000)
    assert not history.is_close(S_NS // 10)
    assert not history.is_close(S_NS)
    assert not TruthTrack([]).is_close(0)


def test_a_gap_in_the_truth_is_not_bridged():
    stamps_ns = [0, S_NS // 5, 2 * S_NS // 5, 2 * S_NS, 11 * S_NS // 5, 12 * S_NS // 5]
    broken = TruthTrack([truth_of_swell(stamp) for stamp in stamps_ns])
    assert broken.interpolated(S_NS) is None
    t_m, _ = broken.interpolated(S_NS // 3)
    assert t_m == pytest.approx(np.array(swum(S_NS // 3)[0]), abs=4e-3)


def test_the_truth_of_a_trigger_is_moved_to_when_its_pictures_were_taken():
    known = TruthTrack([truth_of_swell(k * S_NS // 5, trigger=k) for k in range(20)])
    late_ns = 2 * S_NS + 5_000_000
    assert known.at(late_ns, 10)[0] == pytest.approx(np.array(swum(late_ns)[0]), abs=1e-3)
    # With clocks that differ by more, the trigger's number tells which truth it is.
    assert known.at(2 * S_NS + 150_000_000, 10)[0] == pytest.approx(np.array(swum(2 * S_NS)[0]), abs=1e-9)


def test_errors_in_gaps_are_separate_and_wrong_needs_sigma_and_range():
    tracks = [track(0, [0, 0, 4.0]), track(1, [0, 0, 4.5], age_s=1.0), track(2, [0, 0, 4.5], sigma_m=0.4)]
    (figures,) = tracks_figures(tracks, [Pose(0), Pose(2 * PERIOD_NS)], truths(3))
    assert (figures.wrong, figures.wrong_in_gaps) == (1, 1)
    assert figures.in_gaps_m.count == 1
    assert figures.in_gaps_m.median == pytest.approx(0.5)
    assert figures.outside_m.count == 2


def test_time_without_a_sample_or_with_a_wide_sigma_is_not_covered():
    poses = [Pose(0), Pose(99 * PERIOD_NS)]
    half = [track(k, [0, 0, 4.0], sigma_m=0.02 if k < 50 else 0.3) for k in range(100)]
    assert covered_share(half, poses) == pytest.approx(0.5, abs=0.02)
    assert covered_share(half[:50], poses) == pytest.approx(0.5, abs=0.02)
    assert covered_share([], poses) == 0.0


def test_below_two_poses_the_time_from_the_first_to_the_last_trigger_is_to_be_covered():
    tracks = [track(k, [0, 0, 4.0]) for k in range(50, 100)]
    triggers_ns = [k * PERIOD_NS for k in range(0, 200, 5)]
    for poses in ([], [Pose(60 * PERIOD_NS)]):
        assert covered_share(tracks, poses) is None
        assert covered_share(tracks, poses, triggers_ns) == pytest.approx(50 / 195, abs=0.01)
        assert covered_share([], poses, triggers_ns) == 0.0
        (figures,) = tracks_figures(tracks, poses, truths(100), triggers_ns=triggers_ns)
        assert (figures.covered_from, figures.covered) == ("trigger", covered_share(tracks, poses, triggers_ns))
    # Two poses say more of where there was something to be seen.
    poses = [Pose(60 * PERIOD_NS), Pose(80 * PERIOD_NS)]
    assert covered_share(tracks, poses, triggers_ns) == covered_share(tracks, poses) == 1.0
    assert tracks_figures(tracks, poses, truths(100), triggers_ns=triggers_ns)[0].covered_from == "pose"


def test_each_mode_has_its_own_figures():
    tracks = [track(k, [0, 0, 4.0], mode=mode) for k in range(4) for mode in ("filter", "lag")]
    assert [figures.mode for figures in tracks_figures(tracks, [], truths(4))] == ["filter", "lag"]


def test_sigmas_in_ned_are_judged_by_true_ned():
    rng = np.random.default_rng(4)
    sigma = np.array([0.02, 0.04, 0.01, 0.05, 0.01])
    # A looks north: its camera's z is north, x east, y down.
    looks_north = NodePose(
        net="main",
        node="a",
        stamp_ns=0,
        p_m=(0.0, 0.0, 10.0),
        q_xyzw=(0.5, 0.5, 0.5, 0.5),
        v_mps=(0.0, 0.0, 0.0),
        covariance=[0.0] * 36,
        fixed=False,
        mode="truth",
        age_s=0.0,
    )
    camera = ned_of_camera([replace(looks_north, stamp_ns=k * PERIOD_NS) for k in range(3000)], [], None)
    told = []
    for k in range(3000):
        # Due south: published azimuths are about pi, true ones too, on either side of the cut.
        north, east, down, azimuth, inclination = np.array([-4.0, 0.0, 0.0, np.pi, 0.0]) + sigma * rng.standard_normal(
            5
        )
        told.append(
            replace(
                track(k, [0, 0, -4.0]),
                t_ned_m=(north, east, down),
                sigma_ned_m=tuple(sigma[:3]),
                azimuth_rad=azimuth,
                sigma_azimuth_rad=sigma[3],
                inclination_rad=inclination,
                sigma_inclination_rad=sigma[4],
            )
        )
    south = TruthTrack(
        [Truth(stamp_ns=k * PERIOD_NS, t_a_b_m=(0, 0, -4.0), q_a_b_xyzw=(0, 1, 0, 0)) for k in range(3000)]
    )
    (figures,) = tracks_figures(told, [], south, camera)
    ned = figures.ned
    assert ned.samples == 3000
    assert [ned.north, ned.east, ned.down, ned.azimuth, ned.inclination] == pytest.approx([1.0] * 5, rel=0.1)
    (doubled,) = tracks_figures([replace(one, sigma_azimuth_rad=0.025) for one in told], [], south, camera)
    assert doubled.ned.azimuth == pytest.approx(4 * ned.azimuth)
    (unknown,) = tracks_figures(told, [], south)
    assert unknown.ned is None
