"""`buddyline align`: what a dive in which both nodes moved tells of their clocks."""

from __future__ import annotations

import argparse
import json
import logging
from dataclasses import asdict
from typing import Final

from buddyline.protocol.errors import BuddylineError
from buddyline.solver_service.alignment import ClockOffset
from buddyline.solver_service.clock_curve import ClockCurve
from buddyline.solver_service.config import SolveConfig, track_settings
from buddyline.solver_service.core import SolverCore
from buddyline.solver_service.track.clocks import Clocks
from buddyline.tools.dives import Dive
from buddyline.tools.solve import CLOCK_KNOWN_S, check_detector, messages_of, pair_of

log = logging.getLogger(__name__)

# Assumed 1 sd of the clocks' offset: it widens the gates on range and twist gaps.
SKEW_SIGMA_S: Final = 0.05
PASSES: Final = 4


def run(args: argparse.Namespace) -> int:
    """Estimate offset and drift; return 1 where the dive does not tell the offset."""
    with Dive(args.dives) as dive:
        pair = pair_of(dive, args.nodes)
        check_detector(dive, pair, args.detector, args.environment)
        found = clocks_of(dive, pair, args.detector, args.environment)
    if found is None:
        log.error(
            "align: the fixes do not tell the offset within %.0f ms: they are too few, or the pair did not move; take "
            "seconds in which both moved and saw each other's lights",
            1e3 * CLOCK_KNOWN_S,
        )
        return 1
    if args.json:
        print(clocks_json(pair, found))
    else:
        print(
            f"the clock of {pair[1]} is {found.offset_s * 1e3:+.2f} ms from that of {pair[0]} "
            f"(1 sd {found.sigma_s * 1e3:.2f} ms, {found.fixes} fixes)\n"
            f"{_drift_text(found)}\n"
            f"{_solve_text(found)}"
        )
    return 0


def clocks_of(dive: Dive, pair: tuple[str, str], detector: str, environment: str) -> Clocks | ClockOffset | None:
    """Return what the dive tells of the clocks of a pair, None for nothing; raise BuddylineError for no fix.

    An offset that is not known to CLOCK_KNOWN_S would make poses worse, and is nothing.
    """
    missing = [node for node in pair if node not in dive.infos()]
    if missing:
        raise BuddylineError(f"{dive.name}: no NodeInfo of node {missing[0]}; name a log that has it, too")
    left = found = _pass(dive, pair, detector, environment, 0.0, 1)
    # By gaps alone, each pass corrects B's times by the offset found so far, until what is left is below its sigma.
    number = 1
    while isinstance(found, ClockOffset) and left is not None and number < PASSES:
        if abs(left.offset_s) < 0.1 * left.sigma_s:
            break
        number += 1
        left = _pass(dive, pair, detector, environment, found.offset_s, number)
        found = left and ClockOffset(found.offset_s + left.offset_s, left.sigma_s, left.fixes)
    return found if found is not None and found.sigma_s < CLOCK_KNOWN_S else None


def clocks_json(pair: tuple[str, str], found: Clocks | ClockOffset) -> str:
    """Return it as `solve --clocks` reads it."""
    return json.dumps({"node_a": pair[0], "node_b": pair[1], **asdict(found)})


def _drift_text(found: Clocks | ClockOffset) -> str:
    if isinstance(found, ClockOffset):
        return "the drift is not told: that takes inertial samples of both nodes throughout"
    if found.drift is not None and found.drift_sigma is not None:
        return f"it gains {found.drift * 1e6:+.1f} us a second (1 sd {found.drift_sigma * 1e6:.1f})"
    if found.drift_sigma is None:
        return "the drift is not told: the dive is too short"
    return f"the drift is not told: the dive would tell it within {found.drift_sigma * 1e6:.0f} us a second, 1 sd"


def _solve_text(found: Clocks | ClockOffset) -> str:
    if isinstance(found, Clocks) and found.drift is not None:
        return "solve with both: buddyline align ... --json > clocks.json; buddyline solve ... --clocks clocks.json"
    return f"solve with it: buddyline solve ... --clock-offset {found.offset_s:.4f}"


def _pass(
    dive: Dive, pair: tuple[str, str], detector: str, environment: str, offset_s: float, number: int
) -> Clocks | ClockOffset | None:
    settings = SolveConfig(skew_sigma_s=SKEW_SIGMA_S).settings("align")
    clocks = {pair[1]: ClockCurve.constant(offset_s)}
    # The track finds any offset in one pass; later ones are by gaps.
    track = track_settings("smooth", 1.0) if number == 1 else None
    core = SolverCore(settings, [pair], clocks, align=True, track=track)
    doing = f"align, pass {number}"
    for envelope in messages_of(dive, dive.infos(), *pair, detector=detector, environment=environment, doing=doing):
        core.handle(envelope.message)
    found = core.pairs[pair].clocks()
    if not core.counts["solved"]:
        why = ", ".join(f"{count} {reason}" for reason, count in core.counts.most_common())
        raise BuddylineError(
            f"{dive.name}: no fix tells the clocks' offset ({why or 'no candidates'}): name logs of seconds in which "
            f"{pair[0]} and {pair[1]} saw each other's lights"
        )
    return found
