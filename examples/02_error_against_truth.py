"""Compare the poses of a simulated dive with its truth, trigger by trigger."""

import sys

import buddyline
import numpy as np

truth = buddyline.open_dive(*sys.argv[1:]).truth()
poses = buddyline.solve(*sys.argv[1:], track="none").poses
_, of_pose, of_truth = np.intersect1d(poses.trigger, truth.trigger, return_indices=True)
error_m = np.linalg.norm(poses.t_a_b_m[of_pose] - truth.t_a_b_m[of_truth], axis=1)
for start_m in range(1, 10):
    inside = (poses.range_m[of_pose] >= start_m) & (poses.range_m[of_pose] < start_m + 1)
    if inside.any():
        print(f"{start_m} to {start_m + 1} m: {1e3 * np.median(error_m[inside]):6.1f} mm  ({inside.sum()} poses)")
