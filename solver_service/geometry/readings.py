"""Readings of triggers: which candidates are the lights, the pose that follows, and what speaks for it."""

from __future__ import annotations

from dataclasses import dataclass

from buddyline.solver_service.geometry.refinement import Refined
from buddyline.solver_service.geometry.rotation import Floats, Indices
from buddyline.solver_service.geometry.se3 import SE3


@dataclass(eq=False, slots=True)
class Poses:
    """K poses between the cameras' frames, and the log likelihood ratio (K,) of each without the past.

    turn: (3, K) against both headings, log_heading (K,) what it counts for, turn_variance (K,) of it by the pictures.
    """

    T_a_b: SE3
    log_ratio: Floats
    turn: Floats
    log_heading: Floats
    turn_variance: Floats


@dataclass(eq=False, slots=True)
class Readings:
    """M readings, ready to be solved for what is known of the motion; poses between the cameras' frames.

    lights: (M, 4) places in the views of B's left and right in A's picture, A's left and right in B's; -1: not seen.
    refined: their poses, without the motion. dt_s: (M, n) of each residual after the instant that the pose is for.
    log_ratio: (M,) against chance, without what the residuals and the past say. tilt_chi2, depth_chi2: (M,) of the
    sensors. gap_chi2: (M,) of the gaps that may speak, by the closed form. range_m: (M, 2) by A's bar and by B's,
    twist_gap_rad (M,); both by the closed form. clutter: (M,) candidates that chance puts into the variance of the
    lights' positions; 0 for three lights and where a gap may not speak. lone_odds: (M,) that the only light of a node
    is another lamp, without the past; lone_density: (M,) of its place by the other three and the sensors, per square of
    its sigma. Both are 0 where both are seen.
    """

    lights: Indices
    refined: Refined
    dt_s: Floats
    log_ratio: Floats
    tilt_chi2: Floats
    depth_chi2: Floats
    gap_chi2: Floats
    range_m: Floats
    twist_gap_rad: Floats
    clutter: Floats
    lone_odds: Floats
    lone_density: Floats


@dataclass(eq=False, slots=True)
class Read:
    """The readings of T triggers, the likeliest of each first, and all poses that were weighed.

    Trigger i has the poses from pose_starts[i] on, and its readings from starts[i] on. pose: (M,) the place of each
    reading's pose.
    """

    pose_starts: Indices
    poses: Poses
    starts: Indices
    pose: Indices
    readings: Readings

    def poses_of(self, trigger: int) -> slice:
        """Give the places of one trigger's poses."""
        return slice(*self.pose_starts[trigger : trigger + 2].tolist())

    def places_of(self, trigger: int) -> slice:
        """Give the places of one trigger's readings."""
        return slice(*self.starts[trigger : trigger + 2].tolist())
