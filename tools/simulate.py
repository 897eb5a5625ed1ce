"""`buddyline simulate`: a dive log of two or more simulated nodes, with the truth in it."""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Sequence
from dataclasses import asdict, fields
from typing import Any, Final

from buddyline.node.sim.scenario import (
    DECOYS,
    ENVIRONMENTS,
    EXPOSURES,
    INERTIAL_GRADES,
    TRAJECTORIES,
    DivePlan,
    Scenario,
    more_nodes,
)
from buddyline.protocol.clock import MS_NS, S_NS
from buddyline.protocol.errors import BuddylineError
from buddyline.protocol.options import finite
from buddyline.tools.progress import Progress

START_NS = 1_764_000_000 * S_NS
ASPECT = 616 / 820
# Options that change nothing in a dive without pictures, and in one of pictures.
IN_PICTURES: Final = {"--exposure": "exposure", "--tags": "tags", "--decoy": "decoy", "--pwm-hz": "pwm_hz"}
OF_CANDIDATES: Final = {"--gross": "gross_share", "--misses": "miss_share", "--false": "false_lights"}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments. What is a field of Scenario or DivePlan has its name, and its default."""
    scenario, plan = Scenario(), DivePlan()

    def choice(to: argparse._ActionsContainer, field: str, choices: Sequence[str], text: str = "") -> None:
        default = getattr(scenario if hasattr(scenario, field) else plan, field)
        to.add_argument(f"--{field}", choices=choices, default=default, help=f"{text}default: %(default)s")

    def number(to: argparse._ActionsContainer, option: str, field: str, metavar: str, text: str = "") -> None:
        default = getattr(scenario if hasattr(scenario, field) else plan, field)
        help_text = f"{text}default: %(default)s"
        kind = finite if isinstance(default, float) else int
        to.add_argument(option, dest=field, type=kind, default=default, metavar=metavar, help=help_text)

    parser.add_argument("output", metavar="OUT.mcap", help="the dive log to write; must not exist")
    choice(parser, "environment", ENVIRONMENTS, "the waters; ")
    number(parser, "--seconds", "seconds", "S")
    number(parser, "--rate", "rate_hz", "HZ", "triggers a second; ")
    parser.add_argument("--seed", type=int, default=1, help="each seed gives another dive; default: %(default)s")
    parser.add_argument("--images", action="store_true", help="rendered pictures in place of synthetic candidates")
    choice(parser, "exposure", EXPOSURES, "of pictures; auto: locked to the lamps, as a node's camera does it; ")
    parser.add_argument("--imu", action="store_true", help="with raw inertial samples")
    grades = "fair: mounted 1 deg off, late, shaken at 7 to 18 Hz; poor: shaken by fins, with walking biases; "
    choice(parser, "inertial", INERTIAL_GRADES, grades)
    number(parser, "--width", "width_px", "PX", "of the pictures; ")
    world = parser.add_argument_group("the dive")
    choice(world, "trajectory", TRAJECTORIES, "how b swims about a; rest: both hold still; ")
    number(world, "--range-min", "range_min_m", "M", "nearest distance between the nodes; ")
    number(world, "--range-max", "range_max_m", "M", "farthest; 0: as far as the water allows; ")
    number(world, "--baseline", "baseline_a_m", "M", "distance between a node's lights; ")
    world.add_argument(
        "--nodes",
        type=int,
        default=2,
        metavar="N",
        help="how many nodes: a, b, c, ...; above 2 they are in two groups; default: %(default)s",
    )
    world.add_argument(
        "--fixed", action="append", default=[], metavar="NODE", help="a node that stands still, such as a; repeatable"
    )
    world.add_argument("--blink", action="store_true", help="each node's left lamp blinks by a code of its own")
    number(world, "--others", "other_lamps", "N", "how many lamps of other divers; ")
    world.add_argument("--tags", action="store_true", help="two AR tags on each node, for comparison")
    world.add_argument("--undisturbed", action="store_true", help="no diver looks away, nothing passes before a light")
    faults = parser.add_argument_group("noise and faults")
    number(faults, "--sigma-px", "sigma_px", "PX", "1 sd of a candidate's place; ")
    number(faults, "--gross", "gross_share", "SHARE", "candidates that are off by several pixels; ")
    number(faults, "--misses", "miss_share", "SHARE", "lights not found; ")
    number(faults, "--false", "false_lights", "N", "false candidates in each picture; ")
    number(faults, "--lost", "lost_share", "SHARE", "frames lost; ")
    faults.add_argument("--clock-offset-ms", type=finite, default=0.0, metavar="MS", help="b's clock ahead of a's")
    faults.add_argument(
        "--clock-drift-ppm", type=finite, default=0.0, metavar="PPM", help="how fast b's clock gains on a's"
    )
    faults.add_argument(
        "--magnetometer-off-deg", type=finite, default=0.0, metavar="DEG", help="b's heading is wrong by this"
    )
    faults.add_argument(
        "--dead-lamp", action="append", default=[], metavar="NODE.SIDE", help="a dark lamp, such as b.left; repeatable"
    )
    faults.add_argument(
        "--decoy",
        action="append",
        default=[],
        choices=DECOYS,
        help="show in pictures what may be taken for lamps; repeatable",
    )
    number(faults, "--pwm-hz", "pwm_hz", "HZ", "the lights are dimmed by pulses; 0: not dimmed; ")
    number(faults, "--strobe-s", "strobe_s", "S", "time between a strobe's flashes; 0: no strobe; ")
    faults.add_argument(
        "--row-time-us", type=finite, default=0.0, metavar="US", help="rolling shutter: time from row to row; 0: none"
    )


def run(args: argparse.Namespace) -> int:
    """Write the dive; return 0."""
    import cv2
    from buddyline.node.sim.dive import messages
    from buddyline.node.sim.world import World
    from buddyline.tools.newfile import new_dive_log

    _check_effect(args)
    cv2.setNumThreads(1)
    plan = DivePlan(**_given(args, DivePlan))
    scenario = Scenario(
        **_given(args, Scenario),
        start_ns=START_NS,
        more_nodes=more_nodes(args.nodes),
        fixed_nodes=tuple(args.fixed),
        height_px=round(args.width_px * ASPECT),
        row_time_ns=round(args.row_time_us * 1000),
        baseline_b_m=args.baseline_a_m,
        interruptions=not args.undisturbed,
        clock_offset_ns=round(args.clock_offset_ms * MS_NS),
        clock_drift=1e-6 * args.clock_drift_ppm,
        magnetometer_off_rad=math.radians(args.magnetometer_off_deg),
        dead_lamps=tuple(args.dead_lamp),
        decoys=tuple(args.decoy),
        blink_slot_ns=plan.period_ns if args.blink else 0,
    )
    metadata = {name: str(value) for name, value in (_differing(scenario) | asdict(plan)).items()}
    with (
        new_dive_log(args.output, metadata) as writer,
        Progress("simulate", plan.seconds) as progress,
    ):
        for stamp_ns, key, message in messages(World(scenario), plan):
            writer.write_message(message, key=key)
            progress.show((stamp_ns - START_NS) / S_NS)
        count = writer.count
    print(f"{args.output}: {plan.seconds:g} s of {scenario.environment}, {count} messages", file=sys.stderr)
    return 0


def _check_effect(args: argparse.Namespace) -> None:
    """Raise BuddylineError if an option would change nothing: the dive would not be what was asked for."""
    scenario, plan = Scenario(), DivePlan()
    usual: dict[str, object] = {
        "exposure": plan.exposure,
        "tags": scenario.tags,
        "decoy": [],
        "pwm_hz": scenario.pwm_hz,
    }
    for option, field in IN_PICTURES.items():
        if not args.images and getattr(args, field) != usual[field]:
            raise BuddylineError(f"{option}: changes pictures only; add --images")
    for option, field in OF_CANDIDATES.items():
        if args.images and getattr(args, field) != getattr(scenario, field):
            raise BuddylineError(f"{option}: changes synthetic candidates only; leave out --images")
    if args.inertial != scenario.inertial and not args.imu:
        raise BuddylineError(f"--inertial {args.inertial}: changes inertial samples only; add --imu")


def _given(args: argparse.Namespace, kind: type[Scenario | DivePlan]) -> dict[str, Any]:
    """Return the arguments that have the names of fields."""
    return {field.name: getattr(args, field.name) for field in fields(kind) if hasattr(args, field.name)}


def _differing(scenario: Scenario) -> dict[str, object]:
    """Return the fields of a scenario that differ from their defaults, and those that are always recorded."""
    return {
        field.name: getattr(scenario, field.name)
        for field in fields(scenario)
        if getattr(scenario, field.name) != field.default or field.name in ("environment", "seed")
    }
