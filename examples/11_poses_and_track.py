"""Plot a dive's range: poses as dots, the track through them as a line with its band of two sigma."""

import sys

import buddyline
import matplotlib.pyplot as plt
import numpy as np

*logs, picture = sys.argv[1:]
solved = buddyline.solve(*logs)
poses, track = solved.poses, solved.track
start_ns = track.stamp_ns[0]
toward = track.t_a_b_m / track.range_m[:, None]
sigma_m = np.sqrt(np.einsum("ni,nij,nj->n", toward, track.covariance[:, :3, :3], toward))
seconds = (track.stamp_ns - start_ns) / 1e9

figure, axes = plt.subplots(figsize=(9, 4))
axes.fill_between(seconds, track.range_m - 2 * sigma_m, track.range_m + 2 * sigma_m, alpha=0.3)
axes.plot(seconds, track.range_m, label=f"track ({track.mode})")
axes.plot((poses.stamp_ns - start_ns) / 1e9, poses.range_m, ".", label="poses")
axes.set(xlabel="s", ylabel="range, m")
axes.legend()
figure.savefig(picture)
print(f"{len(poses)} poses, {len(track)} rows of track; longest without a light {track.age_s.max():.1f} s")
