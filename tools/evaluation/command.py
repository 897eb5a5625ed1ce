"""`buddyline evaluate`: poses, pairs and candidates against truth; or all nodes of a net."""

from __future__ import annotations

import argparse
import json
import logging
from collections.abc import Iterable
from dataclasses import asdict
from typing import Final

from buddyline.protocol.errors import BuddylineError
from buddyline.tools.draw import figures
from buddyline.tools.draw.errors import write_figures
from buddyline.tools.evaluation.logs import load_for_evaluation
from buddyline.tools.evaluation.network import load_network, network_figures, network_text, shows_network
from buddyline.tools.evaluation.report import as_dict, as_text
from buddyline.tools.evaluation.result import evaluate
from buddyline.tools.newfile import new_folder

log = logging.getLogger(__name__)

# Of two dives four fifths and more of all poses and rows are wrong, of one dive a few in a hundred at most. Fewer than
# these say nothing: with dark lamps a dive may have one pose, and a wrong one.
_MIN_COMPARED: Final = 10


def run(args: argparse.Namespace) -> int:
    """Measure, print, and draw where asked for; return 0."""
    if args.plots is not None:
        figures.check()
        new_folder(args.plots)
    if args.net or (args.pair is None and shows_network(args.logs)):
        return _evaluate_network(args)
    recorded = load_for_evaluation(args.logs, args.truth, args.pair)
    for problem in recorded.problems:
        log.warning("%s", problem)
    result = evaluate(recorded)
    if result.poses and result.without_truth == result.poses:
        raise BuddylineError(
            f"{args.logs[0]}: no pose has truth at its trigger or time; is the truth"
            f"{_of_truth(args)} of this dive? Name the log of this dive's truth with --truth T.mcap"
        )
    print(json.dumps(as_dict(result), allow_nan=False) if args.json else as_text(result))
    if args.plots is not None:
        for path in write_figures(result, args.plots):
            log.info("%s", path)
    compared = [(result.accuracy.wrong, result.accuracy.poses), *((one.wrong, one.samples) for one in result.tracks)]
    _tell_of_two_dives(args, compared)
    return 0


def _evaluate_network(args: argparse.Namespace) -> int:
    if args.plots is not None or args.pair is not None:
        raise BuddylineError("--plots and --pair: of a pair, not of a net")
    figures = network_figures(*load_network(args.logs, args.truth))
    print(json.dumps({"network": [asdict(one) for one in figures]}) if args.json else network_text(figures))
    _tell_of_two_dives(args, [(one.wrong, one.samples) for one in figures if not one.fixed])
    return 0


def _of_truth(args: argparse.Namespace) -> str:
    """Return ` in` and the logs that truth may be from, beside the first."""
    others = ", ".join(map(str, args.truth or args.logs[1:]))
    return f" in {others}" if others else ""


def _tell_of_two_dives(args: argparse.Namespace, compared: Iterable[tuple[int, int]]) -> None:
    """Say where most of what was compared (wrong, of how many) is wrong by a truth of another log.

    The figures stand: only poses may tell two dives of one time apart, and all poses of a dive may be wrong.
    """
    of_truth = _of_truth(args)
    contradicted = next(((wrong, n) for wrong, n in compared if n >= _MIN_COMPARED and wrong > n / 2), None)
    if of_truth and contradicted is not None:
        log.warning(
            "%s: %d of %d poses or rows are wrong by the truth%s: it seems to be of another dive; name the log of this "
            "dive's truth with --truth T.mcap. If it is of this dive, look for wrong clocks, bars or calibrations",
            *(args.logs[0], *contradicted, of_truth),
        )
