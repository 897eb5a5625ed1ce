"""`buddyline evaluate`: poses, pairs and candidates against truth; or all nodes of a net."""

from __future__ import annotations

import argparse
import json
import logging
from dataclasses import asdict

from buddyline.protocol.errors import BuddylineError
from buddyline.tools.draw import figures
from buddyline.tools.draw.errors import write_figures
from buddyline.tools.evaluation.logs import load_for_evaluation
from buddyline.tools.evaluation.network import load_network, network_figures, network_text, shows_network
from buddyline.tools.evaluation.report import as_dict, as_text
from buddyline.tools.evaluation.result import evaluate
from buddyline.tools.newfile import new_folder

log = logging.getLogger(__name__)


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
        raise BuddylineError(f"{args.logs[0]}: no pose has truth at its trigger or time; is the truth of this dive?")
    print(json.dumps(as_dict(result), allow_nan=False) if args.json else as_text(result))
    if args.plots is not None:
        for path in write_figures(result, args.plots):
            log.info("%s", path)
    return 0


def _evaluate_network(args: argparse.Namespace) -> int:
    if args.plots is not None or args.pair is not None:
        raise BuddylineError("--plots and --pair: of a pair, not of a net")
    figures = network_figures(*load_network(args.logs, args.truth))
    print(json.dumps({"network": [asdict(one) for one in figures]}) if args.json else network_text(figures))
    return 0
