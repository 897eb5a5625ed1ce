"""Solve candidates that a program made itself: two nodes face each other, and each sees the other's two lights."""

import buddyline

CAMERA = buddyline.CameraModel(model="pinhole", fx_px=600, fy_px=600, cx_px=410, cy_px=308, distortion=[0.0] * 5)
SIZE = {"width_px": 820, "height_px": 616}

messages: list[buddyline.Message] = []
for node in ("a", "b"):
    bar = {"light_left_m": (-0.44, 0.0, 0.0), "light_right_m": (0.44, 0.0, 0.0)}
    messages.append(
        buddyline.NodeInfo(
            node=node, stamp_ns=0, camera=CAMERA, sigma_px=0.5, trigger_period_ns=100_000_000, **bar, **SIZE
        )
    )
    # 0.88 m seen 132 px wide by a camera of 600 px: 4 m away.
    lights = [
        buddyline.Blob(u_px=u_px, v_px=308, sigma_px=0.5, area_px=40, peak=250, elongation=1) for u_px in (344, 476)
    ]
    messages.append(
        buddyline.Candidates(node=node, stamp_ns=10**9, trigger=10, seq=0, boot="own", blobs=lights, **SIZE)
    )
solved = buddyline.solve_messages(messages)
for range_m, sigma_m in zip(solved.poses.range_m, solved.poses.sigma_m, strict=True):
    print(f"range {range_m:.3f} m, 1 sd along the sight {sigma_m[2]:.3f} m")
for reason in solved.rejections.reason:
    print(f"no pose: {reason}")
