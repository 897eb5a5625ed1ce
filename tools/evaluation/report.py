"""Format a result: as text for a person, and as plain values for a program."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import fields, is_dataclass
from typing import Any

from buddyline.tools.evaluation.detection import DetectionFigures
from buddyline.tools.evaluation.ned import NedHonesty
from buddyline.tools.evaluation.pairing import Pairing
from buddyline.tools.evaluation.poses import WRONG_SHARE
from buddyline.tools.evaluation.result import Accuracy, RangeBin, Result
from buddyline.tools.evaluation.statistics import Stats
from buddyline.tools.evaluation.tracks import GAP_S, TrackFigures
from buddyline.tools.measure.tables import number, percent, text_table

_DEGREES = 180.0 / math.pi


def as_dict(result: Result) -> dict[str, Any]:
    """Return the figures as JSON values: unknown ones are null; there is no NaN and no infinity."""
    return {key: value for key, value in _plain(result).items() if key != "errors"}


def _plain(value: Any) -> Any:
    if is_dataclass(value) and not isinstance(value, type):
        plain = {field.name: _plain(getattr(value, field.name)) for field in fields(value) if field.name != "errors"}
        if isinstance(value, Pairing):
            plain |= {"right_share": value.right_share, "right_detected_share": value.right_detected_share}
        return plain
    if isinstance(value, dict):
        return {"all" if key == 0 else str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_plain(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def as_text(result: Result) -> str:
    """Return the figures as aligned tables."""
    parts = [_triggers_text(result)]
    if result.pairing is not None:
        parts.append(_pairing_text(result.pairing))
    if result.accuracy.poses:
        parts += [_accuracy_text(result.accuracy) + _ned_text(result.ned), _bins_text(result.bins)]
    parts += [_track_text(track) for track in result.tracks if track.samples]
    if result.detection is not None:
        parts.append(_detection_text(result.detection))
    return "\n\n".join(parts)


def _counts(counts: dict[str, int]) -> str:
    return ", ".join(f"{count} {name}" for name, count in counts.items()) or "none"


def _triggers_text(result: Result) -> str:
    triggers, skew = result.triggers, result.skew
    where = f" in {result.environment}" if result.environment else ""
    lines = [
        f"pair {result.node_a}/{result.node_b}{where}: {result.poses} poses of {triggers.total} triggers"
        f" in {triggers.span_s:.1f} s ({number(triggers.poses_hz, 2)} of {number(triggers.triggers_hz, 2)} Hz,"
        f" longest time without a pose {number(triggers.gap_s, 2)} s)",
        f"rejected: {_counts(triggers.rejected)}",
        f"triggers without a result: {'not known' if triggers.unanswered is None else triggers.unanswered}"
        f", with more than one: {triggers.doubled}",
    ]
    if result.without_truth:
        lines.append(f"poses without truth, not compared: {result.without_truth}")
    if skew is not None:
        drift = "" if skew.drift_ppm is None else f", drift {skew.drift_ppm:.1f} +- {skew.drift_sd_ppm:.1f} ppm"
        lines.append(
            f"stamps {result.node_a} - {result.node_b}: median {1e3 * skew.median_s:.2f} ms,"
            f" 95 % within {1e3 * skew.p95_s:.2f} ms, at most {1e3 * skew.largest_s:.2f} ms{drift}"
        )
    return "\n".join(lines)


def _pairing_text(pairing: Pairing) -> str:
    how = "all four lights in view" if pairing.marked else "all four lights inside the pictures (by projection)"
    lines = [f"triggers with {how}: {pairing.visible}"]
    if pairing.right is not None:
        lines.append(f"  right pair   {percent(pairing.right_share):>7}  {pairing.right} poses")
        lines.append(f"  another pair          {pairing.other_pair} poses")
        lines.append(f"  three lights          {pairing.partial} poses")
        lines.append(f"  wrong poses           {pairing.wrong}")
        lines.append(f"  no pose               {_counts(pairing.ended)}")
    if pairing.detected is not None:
        lines.append(f"  with a candidate near all four: {pairing.detected}")
    if pairing.right_detected is not None:
        lines.append(f"    right pair {percent(pairing.right_detected_share):>7}  {pairing.right_detected} poses")
    return "\n".join(lines)


def _stats_row(name: str, stats: Stats, digits: int, scale: float = 1.0) -> list[str]:
    figures = (stats.median, stats.p95, stats.rmse, stats.mean)
    scaled = [number(None if figure is None else figure * scale, digits) for figure in figures]
    return [name, str(stats.count), *scaled]


def _accuracy_text(accuracy: Accuracy) -> str:
    rows = [
        ["error", "poses", "median", "p95", "RMSE", "mean"],
        _stats_row("position, m", accuracy.translation_m, 4),
        _stats_row("rotation, deg", accuracy.rotation_rad, 3, _DEGREES),
        _stats_row("range, m", accuracy.range_m, 4),
        _stats_row("bearing, deg", accuracy.bearing_rad, 3, _DEGREES),
    ]
    if accuracy.azimuth_rad.count:
        rows.append(_stats_row("azimuth, deg", accuracy.azimuth_rad, 3, _DEGREES))
        rows.append(_stats_row("inclination, deg", accuracy.inclination_rad, 3, _DEGREES))
    rows += [
        _stats_row("NEES, pose", accuracy.nees6, 2),
        ["  expected", "", "5.35", "12.59", "6.93", "6.00"],
        _stats_row("NEES, position", accuracy.nees3, 2),
        ["  expected", "", "2.37", "7.81", "3.87", "3.00"],
    ]
    inside = (
        f"inside the 95 % bound of the covariance: pose {percent(accuracy.honest6)},"
        f" position {percent(accuracy.honest3)}"
    )
    wrong = (
        f"wrong poses (position off by more than {WRONG_SHARE:.0%} of the range): {accuracy.wrong} of {accuracy.poses}"
    )
    return f"{wrong}, {percent(accuracy.wrong_share)}\n{text_table(rows)}\n{inside}"


def _track_text(track: TrackFigures) -> str:
    rows = [
        ["error", "samples", "median", "p95", "RMSE", "mean"],
        _stats_row("position, m", track.position_m, 4),
        _stats_row(f"  in gaps (no light for {GAP_S:g} s)", track.in_gaps_m, 4),
        _stats_row("  outside gaps", track.outside_m, 4),
        _stats_row("rotation, deg", track.rotation_rad, 3, _DEGREES),
        _stats_row("NEES, pose (honest: mean 6)", track.nees6, 2),
        _stats_row("NEES, position (honest: mean 3)", track.nees3, 2),
    ]
    return (
        f"track ({track.mode}): covers {percent(track.covered)} of the time"
        f" from the first to the last {track.covered_from};"
        f" wrong: {track.wrong} of {track.samples}, in gaps {track.wrong_in_gaps}\n"
        f"{text_table(rows)}{_ned_text(track.ned)}"
    )


def _ned_text(ned: NedHonesty | None) -> str:
    """Return a line about the sigmas in NED; "" without figures."""
    if ned is None:
        return ""
    figures = ", ".join(
        f"{name} {number(getattr(ned, name), 2)}" for name in ("north", "east", "down", "azimuth", "inclination")
    )
    return f"\nerror over sigma against true NED, mean of squares (honest: 1): {figures}"


def _bins_text(bins: Sequence[RangeBin]) -> str:
    rows = [
        ["range, m", "in view", "right pair", "poses", "wrong", "position", "p95, m", "rotation", "p95, deg", "NEES"]
    ]
    for part in bins:
        accuracy = part.accuracy
        rotation = (accuracy.rotation_rad.median, accuracy.rotation_rad.p95)
        rows.append(
            [
                f"{part.from_m:g} - {part.to_m:g}" if math.isfinite(part.to_m) else f"{part.from_m:g} -",
                str(part.pairing.visible if part.pairing else 0),
                percent(part.pairing.right_share if part.pairing else None),
                str(accuracy.poses),
                percent(accuracy.wrong_share),
                number(accuracy.translation_m.median, 4),
                number(accuracy.translation_m.p95, 4),
                *(number(None if angle is None else angle * _DEGREES) for angle in rotation),
                number(accuracy.nees6.median, 2),
            ]
        )
    return f"by range (medians beside p95)\n{text_table(rows)}"


def _detection_text(detection: DetectionFigures) -> str:
    first = {n: share for n, share in detection.both_first.items() if n}
    rows = [
        ["recall within 2 px", percent(detection.recall_close)],
        ["recall within 1 % of the width", percent(detection.recall_near)],
        *([f"both lights among the first {n}", percent(share)] for n, share in first.items()),
        ["both lights among all", percent(detection.both_first[0])],
        ["candidates per picture", number(detection.candidates_per_picture, 1)],
        ["false candidates per picture", number(detection.false_per_picture, 2)],
        ["error of the nearest, median, px", number(detection.error_median_px, 2)],
        ["error of the nearest, p90, px", number(detection.error_p90_px, 2)],
        ["error over sigma, per axis, RMS (honest: 1)", number(detection.normalized_rms, 2)],
        ["the same from the median", number(detection.normalized_robust, 2)],
    ]
    lost = f", {detection.lost_pictures} of them without candidates" if detection.lost_pictures else ""
    head = (
        f"detection: {detection.pictures} pictures{lost}; {detection.visible_lights} lights in view,"
        f" {detection.both_visible} pictures with both"
    )
    return f"{head}\n{text_table(rows)}"
