"""`buddyline align`: estimate the offset between two nodes' clocks from a dive in which they moved."""

from __future__ import annotations

import argparse
import json
import logging
from dataclasses import asdict
from typing import Final

from buddyline.protocol.clock import S_NS
from buddyline.protocol.errors import BuddylineError
from buddyline.solver_service.alignment import ClockOffset
from buddyline.solver_service.config import SolveConfig
from buddyline.solver_service.core import SolverCore
from buddyline.tools.dives import Dive
from buddyline.tools.solve import messages_of, pair_of

log = logging.getLogger(__name__)

# Assumed 1 sd of the clocks' offset: it widens the gates on range and twist gaps.
SKEW_SIGMA_S: Final = 0.05
PASSES: Final = 4


def run(args: argparse.Namespace) -> int:
    """Estimate the offset; return 1 if the dive does not determine it."""
    with Dive(args.dives) as dive:
        node_a, node_b = pair_of(dive, args.nodes)
        offset: ClockOffset | None = None
        # Each pass corrects B's times by the offset found so far, until what is left is well below its sigma.
        for number in range(1, PASSES + 1):
            found = _pass(dive, args, (node_a, node_b), offset.offset_s if offset else 0.0, number)
            offset = found and ClockOffset(
                found.offset_s + (offset.offset_s if offset else 0.0), found.sigma_s, found.fixes
            )
            if found is None or abs(found.offset_s) < 0.1 * found.sigma_s:
                break
    if offset is None:
        log.error("align: the fixes do not determine the offset: they are too few, or the pair did not move")
        return 1
    if args.json:
        print(json.dumps({"node_a": node_a, "node_b": node_b, **asdict(offset)}))
    else:
        print(
            f"the clock of {node_b} is {offset.offset_s * 1e3:+.2f} ms from that of {node_a} "
            f"(1 sd {offset.sigma_s * 1e3:.2f} ms, {offset.fixes} fixes)\n"
            f"solve with it: buddyline solve ... --clock-offset {offset.offset_s:.4f}"
        )
    return 0


def _pass(
    dive: Dive, args: argparse.Namespace, pair: tuple[str, str], offset_s: float, number: int
) -> ClockOffset | None:
    settings = SolveConfig(skew_sigma_s=SKEW_SIGMA_S).settings("align")
    core = SolverCore(settings, [pair], {pair[1]: round(offset_s * S_NS)}, align=True)
    for envelope in messages_of(dive, args, dive.infos(), *pair, doing=f"align, pass {number}"):
        core.handle(envelope.message)
    core.flush()
    if not core.counts["solved"]:
        raise BuddylineError(f"{dive.name}: no trigger was solved, so the clocks' offset cannot be estimated")
    alignment = core.pairs[pair].alignment
    return None if alignment is None else alignment.estimate()
