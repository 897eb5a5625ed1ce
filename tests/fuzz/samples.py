"""A valid message of every type, which the fuzzer corrupts."""

from __future__ import annotations

from buddyline.protocol import messages as m

STAMP_NS = 1_764_000_000_000_000_000
PERIOD_NS = 100_000_000

_PAIR = {"node_a": "a", "node_b": "b", "stamp_ns": STAMP_NS}
_NODE = {"node": "a", "stamp_ns": STAMP_NS}
_UNIT = (0.0, 0.0, 0.0, 1.0)

_INFO = m.NodeInfo(
    **_NODE,
    width_px=820,
    height_px=616,
    camera=m.CameraModel(model="pinhole", fx_px=600.0, fy_px=600.0, cx_px=409.5, cy_px=307.5, distortion=[0.0] * 5),
    light_left_m=(-0.4, 0.0, 0.0),
    light_right_m=(0.4, 0.0, 0.0),
    sigma_px=0.7,
    trigger_period_ns=PERIOD_NS,
    role="full",
    fixed=m.FixedPlace(p_m=(0.0, 0.0, 3.0), q_xyzw=_UNIT),
    blink=m.Blink(code=1, lamp="left", slot_ns=PERIOD_NS),
)


SOUND: tuple[m.Message, ...] = (
    _INFO,
    m.Digest(
        **_NODE,
        boot="x",
        seq=1,
        since_ns=STAMP_NS - 10**9,
        said=[m.Said(topic="imu", count=2, first_ns=STAMP_NS - 10, last_ns=STAMP_NS, sha256="0" * 32)],
    ),
    m.Candidates(
        **_NODE,
        trigger=STAMP_NS // PERIOD_NS,
        seq=1,
        boot="x",
        width_px=820,
        height_px=616,
        blobs=[
            m.Blob(
                u_px=450.0,
                v_px=307.0,
                sigma_px=0.7,
                area_px=9.0,
                peak=250.0,
                elongation=1.0,
                score=0.5,
                lasting_s=1.3,
            )
        ],
    ),
    m.Expect(
        **_NODE,
        seen="b",
        valid_ns=500_000_000,
        lights=[
            m.ExpectedLight(
                side="left",
                u_px=450.0,
                v_px=307.0,
                covariance_px2=(9.0, 1.0, 16.0),
                rate_pxps=(-20.0, 3.0),
                sigma_rate_pxps=100.0,
            )
        ],
    ),
    m.Imu(
        **_NODE, accel_mps2=(0.0, 0.0, -9.8), gyro_radps=(0.0, 0.0, 0.0), mag_t=(2e-5, 0.0, 4e-5), temperature_degc=21.5
    ),
    m.ImuMeans(**_NODE, ages_ns=[50_000_000, 0], accel_mps2=[(0.0, 0.0, -9.8)] * 2, gyro_radps=[(0.1, 0.0, 0.0)] * 2),
    m.Attitude(**_NODE, q_ned_body_xyzw=_UNIT, sigma_rad=(0.02, 0.02, 0.1)),
    m.Depth(**_NODE, depth_m=5.0, sigma_m=0.02, pressure_pa=150000.0, temperature_degc=8.0),
    m.CompressedImage(
        timestamp=m.FoxgloveTime(sec=1_764_000_000, nsec=0), frame_id="a_camera", data=b"\xff\xd8\xff", format="jpeg"
    ),
    m.NodeStatus(
        **_NODE,
        boot="x",
        software="x",
        uptime_s=1.0,
        rates_hz={"candidates": 10.0},
        drops={"frame": 0},
        ages_s={"camera": 0.1},
        clock_offset_s=0.001,
        clock_rms_s=0.0005,
        clock_bound_s=0.002,
        clock_frequency_ppm=-3.5,
        clock_source="192.0.2.1",
        temperature_degc=61.0,
        lights_seen=2,
        throttled_bits=0x50000,
        battery_v=11.1,
        battery_a=0.8,
        battery_cell_v=3.7,
        leak=False,
        load="no_pictures",
    ),
    m.ClockBeacon(
        **_NODE,
        boot="x",
        heard=[m.HeardClock(node="b", boot="y", sent_ns=STAMP_NS, received_ns=STAMP_NS + 300_000)],
        raw_ns=5_000_000_000,
    ),
    m.ClockSet(**_NODE, boot="x", moved_ns=-1_000_000_000),
    m.LightTruth(**_NODE, trigger=3, lights=[m.TrueLight(name="left", u_px=1.0, v_px=2.0, visible=True, merged=False)]),
    m.Mark(**_NODE, name="12"),
    m.RelativePose(
        **_PAIR,
        trigger=3,
        t_a_b_m=(0.0, 0.0, 5.0),
        q_a_b_xyzw=_UNIT,
        covariance=[0.0] * 36,
        range_m=5.0,
        range_a_m=5.0,
        range_b_m=5.0,
        range_gap_m=0.0,
        twist_gap_rad=0.0,
        chi2=1.0,
        hypotheses=2,
        blobs_a=(0, 1),
        blobs_b=(1, 0),
        method="refined",
        checks=["range"],
        skew_ns=0,
        azimuth_rad=0.1,
    ),
    m.Track(
        **_PAIR,
        t_a_b_m=(0.0, 0.0, 5.0),
        q_a_b_xyzw=_UNIT,
        covariance=[0.0] * 36,
        v_a_b_mps=(0.1, 0.0, 0.0),
        v_covariance=[0.0] * 9,
        mode="filter",
        lights=4,
        age_s=0.1,
        range_m=5.0,
        t_ned_m=(5.0, 0.0, 0.0),
        sigma_ned_m=(0.1, 0.1, 0.1),
    ),
    m.NodePose(
        **_NODE,
        net="main",
        p_m=(1.0, 2.0, 3.0),
        q_xyzw=_UNIT,
        v_mps=(0.0, 0.0, 0.0),
        covariance=[0.0] * 36,
        fixed=False,
        mode="filter",
        age_s=0.1,
    ),
    m.Rejected(**_PAIR, trigger=3, reason="ambiguous", detail="two poses"),
    m.Truth(stamp_ns=STAMP_NS, t_a_b_m=(0.0, 0.0, 5.0), q_a_b_xyzw=_UNIT),
    m.SolverStatus(
        **_PAIR,
        software="x",
        received_a=1,
        received_b=1,
        matched=1,
        solved=1,
        rejected={"late": 1},
        late=0,
        duplicates=0,
        bad_messages=0,
        pending=0,
    ),
)
