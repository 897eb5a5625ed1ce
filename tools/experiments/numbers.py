"""The experiments' figures as JSON values, and the table with the main results."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np
from buddyline.protocol.messages import NodeInfo
from buddyline.tools.bound import pose_bounds
from buddyline.tools.evaluation.poses import PoseErrors
from buddyline.tools.evaluation.report import as_dict
from buddyline.tools.evaluation.rotation import Floats
from buddyline.tools.evaluation.statistics import Stats, in_bins, share
from buddyline.tools.evaluation.truth import TruthTrack
from buddyline.tools.experiments.runs import OURS, OURS_CAMERA, PAPER, PAPER_CAMERA, TAGS, Rendered
from buddyline.tools.measure.tables import percent

HEAD: Final = ("", "ours", "the paper's method (or AR tags) here", "the paper reports")
EDGES_M: Final = (1.5, 2.0, 3.0, 4.0, 5.0, 6.0, 8.0, 10.0, 12.5, 15.0, 17.5, 20.0)
# The results that the paper reports.
PAPER_REPORTS: Final = {
    "right_pairs_camera": 0.724,
    "right_pairs_all_sensors": 0.8446,
    "error_1.5_to_4_m": 0.08,
    "tags_end_m": 5.0,
}
# The headline's rows that the README has; the report has them all.
README_ROWS: Final = (
    "right pair of lights, all sensors",
    "another pair taken, all sensors",
    "range within",
    "position error, median, 8 to 10 m",
    "farthest pose in the lake",
)
# Errors that are drawn for each pose, for the median of errors at the bound.
_DRAWS: Final = 100
# A method reaches as far as the last bin in which at least this share of triggers gave a pose.
_ENDS_AT: Final = 0.5


def by_range(errors: PoseErrors) -> list[dict[str, Any]]:
    """Return position errors by true range, without bins that have no poses."""
    rows = []
    for start_m, end_m, inside in in_bins(EDGES_M, errors.true_range_m):
        if not inside.any():
            continue
        chosen = errors.select(inside)
        position, along = Stats.of(chosen.translation_m), Stats.of(chosen.range_m)
        rows.append(
            {
                "from_m": start_m,
                "to_m": end_m,
                "poses": len(chosen),
                "wrong": int(chosen.wrong.sum()),
                "position_median_m": position.median,
                "position_rmse_m": position.rmse,
                "position_p95_m": position.p95,
                "range_median_m": along.median,
                "range_rmse_m": along.rmse,
            }
        )
    return rows


def bounds(errors: PoseErrors, track: TruthTrack, infos: Mapping[str, NodeInfo], sigma_px: float) -> Floats:
    """Return the Cramér-Rao bound of each position as covariances (N, 3, 3); NaN if a light is out of view."""
    known = [track.at(*one) for one in zip(errors.stamp_ns.tolist(), errors.trigger.tolist(), strict=True)]
    t_m = np.array([one[0] for one in known if one is not None]).reshape(-1, 3)
    q = np.array([one[1] for one in known if one is not None]).reshape(-1, 4)
    bound: Floats = pose_bounds(t_m, q, infos["a"], infos["b"], sigma_px)[:, :3, :3]
    return bound


def over_bound(errors: PoseErrors, bound: Floats) -> list[dict[str, float]]:
    """Return, by range, the position error over the bound, like with like; 1 is the best possible.

    rms_ratio: RMS over the bound's RMS. rms_sd: by how much rms_ratio varies by chance (1 sd) in so few poses of an
    estimator at the bound. median_ratio: median over the median of Gaussian errors of the bound's covariances.
    """
    rows = []
    for start_m, end_m, in_bin in in_bins(EDGES_M, errors.true_range_m):
        inside = in_bin & np.isfinite(bound).all(axis=(1, 2)) & ~errors.wrong
        if not inside.any():
            continue
        off_m, P = errors.translation_m[inside], bound[inside]
        variances = np.trace(P, axis1=1, axis2=2)
        draws = np.random.default_rng(0).standard_normal((len(P), _DRAWS, 3)) @ np.linalg.cholesky(P).swapaxes(1, 2)
        rms_m, median_m = float(np.sqrt(variances.mean())), float(np.median(np.linalg.norm(draws, axis=2)))
        rows.append(
            {
                "from_m": start_m,
                "to_m": end_m,
                "poses": len(off_m),
                "bound_rms_m": rms_m,
                "bound_median_m": median_m,
                "rms_ratio": float(np.sqrt(np.mean(off_m**2))) / rms_m,
                # The variance of a squared Gaussian error is 2 tr(P^2).
                "rms_sd": float(np.sqrt((P**2).sum() / 2)) / float(variances.sum()),
                "median_ratio": float(np.median(off_m)) / median_m,
            }
        )
    return rows


def reach(truth_ranges_m: Floats, truth_triggers: Sequence[int], errors: PoseErrors) -> dict[str, Any]:
    """Return the share of triggers with a pose by range, the farthest pose, and the range that a method reaches.

    ends_m: the far edge of the last bin in which half of the triggers gave a pose; all count, in view or not.
    """
    solved = set(errors.trigger[~errors.wrong].tolist())
    got = np.array([trigger in solved for trigger in truth_triggers])
    bins, ends_m = [], None
    for start_m, end_m, inside in in_bins(EDGES_M, truth_ranges_m):
        if inside.any():
            part = float(got[inside].mean())
            bins.append({"from_m": start_m, "to_m": end_m, "triggers": int(inside.sum()), "share": part})
            ends_m = end_m if part >= _ENDS_AT else ends_m
    farthest = errors.true_range_m[~errors.wrong]
    return {"ends_m": ends_m, "farthest_m": float(farthest.max()) if len(farthest) else None, "bins": bins}


def near_share(errors: PoseErrors) -> float | None:
    """Return the share of poses between 1.5 and 4 m whose range is within the paper's 0.08 m."""
    near = errors.select((errors.true_range_m >= 1.5) & (errors.true_range_m < 4.0))
    return share(int((np.abs(near.range_m) <= PAPER_REPORTS["error_1.5_to_4_m"]).sum()), len(near))


def pairs(dives: Sequence[Rendered]) -> dict[str, dict[str, Any]]:
    """Return the outcomes of the triggers that show all four lights, by method and environment; "all": summed."""
    table: dict[str, dict[str, Any]] = {}
    for name in (OURS, OURS_CAMERA, PAPER, PAPER_CAMERA):
        counts: dict[str, list[int]] = {}
        for dive in dives:
            found = dive.results[name].pairing
            if found is not None and found.right is not None:
                counts[dive.environment] = [found.visible, found.right, found.other_pair or 0, found.wrong]
        counts["all"] = [sum(column) for column in zip(*counts.values(), strict=True)] or [0, 0, 0, 0]
        table[name] = {water: _pair_row(*of_water) for water, of_water in counts.items()}
    return table


def _pair_row(visible: int, right: int, other_pair: int, wrong: int) -> dict[str, Any]:
    counts = {"visible": visible, "right": right, "other_pair": other_pair, "wrong": wrong}
    return {**counts, "right_share": share(right, visible), "right_of_poses": share(right, right + other_pair)}


def environments(dives: Sequence[Rendered]) -> dict[str, Any]:
    """Return all figures of `evaluate`, by environment and method."""
    return {dive.environment: {name: as_dict(result) for name, result in dive.results.items()} for dive in dives}


def headline(numbers: Mapping[str, Any]) -> list[tuple[str, str, str, str]]:
    """Return the rows (what, ours, the paper's method here, what the paper reports)."""
    found, near, distance = numbers["right_pairs"], numbers["near"], numbers["distance"]

    def right(ours: str, papers: str, reported: str) -> tuple[str, str, str]:
        shares = [found[method]["all"]["right_share"] for method in (ours, papers)]
        return percent(shares[0]), percent(shares[1]), percent(PAPER_REPORTS[reported])

    others = [percent(share(one["other_pair"], one["visible"])) for one in (found[OURS]["all"], found[PAPER]["all"])]
    rows = [
        ("right pair of lights, all sensors", *right(OURS, PAPER, "right_pairs_all_sensors")),
        ("right pair of lights, camera only", *right(OURS_CAMERA, PAPER_CAMERA, "right_pairs_camera")),
        ("another pair taken, all sensors", others[0], others[1], "-"),
        ("range within 0.08 m, 1.5 to 4 m", percent(near["ours"]), percent(near["paper's"]), "all"),
    ]
    ours, papers = ({row["from_m"]: row for row in distance[name]} for name in (OURS, "paper's"))
    for from_m, to_m in ((3.0, 4.0), (8.0, 10.0), (17.5, 20.0)):
        if from_m in ours:
            bin_name = f"{from_m:g} to {to_m:g} m"
            bound = next((row for row in numbers["bound"] if row["from_m"] == from_m), None)
            ratio = f" ({bound['median_ratio']:.2f})" if bound else ""
            medians = [
                f"{row['position_median_m']:.3f} m" if row else "-" for row in (ours[from_m], papers.get(from_m))
            ]
            what = f"position error, median, {bin_name} (over the bound's median)"
            rows.append((what, medians[0] + ratio, medians[1], "-"))
    for environment, ends in numbers["reach"].items():
        what = f"farthest pose in the {environment.replace('_', ' ')}: ours / AR tags"
        rows.append((what, _metres(ends.get(OURS)), _metres(ends.get(TAGS)), "tags end at about 5 m"))
    return rows


def _metres(ends: Mapping[str, Any] | None) -> str:
    return "none" if ends is None or ends["farthest_m"] is None else f"{ends['farthest_m']:.1f} m"
