"""Solve a dive in memory, and say how far apart the divers were and how sure that is."""

import sys

import buddyline
import numpy as np

solved = buddyline.solve(*sys.argv[1:])
poses = solved.poses
print(f"nodes {solved.pair[0]} and {solved.pair[1]}: {len(poses)} poses, {len(solved.rejections)} triggers without one")
print(f"range {poses.range_m.min():.2f} to {poses.range_m.max():.2f} m")
print(f"position, 1 sd: {1e3 * np.median(np.linalg.norm(poses.sigma_m, axis=1)):.0f} mm (median)")
reasons, counts = np.unique(solved.rejections.reason, return_counts=True)
for reason, count in zip(reasons, counts, strict=True):
    print(f"  {count:5d} {reason}")
