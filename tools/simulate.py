"""`buddyline simulate`: a dive log of two or more simulated nodes, with the truth in it."""

from __future__ import annotations

import argparse
import math
import sys
from dataclasses import asdict, fields

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
from buddyline.tools.progress import Progress

START_NS = 1_764_000_000 * S_NS
ASPECT = 616 / 820


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    scenario, plan = Scenario(), DivePlan()
    parser.add_argument("output", metavar="OUT.mcap", help="the dive log to write; must not exist")
    parser.add_argument("--environment", choices=ENVIRONMENTS, default=scenario.environment, help="default: cavern")
    parser.add_argument("--seconds", type=float, default=plan.seconds, help="default: %(default)s")
    parser.add_argument("--rate", type=float, default=plan.rate_hz, metavar="HZ", help="triggers; default: %(default)s")
    parser.add_argument("--seed", type=int, default=1, help="each seed gives another dive; default: %(default)s")
    parser.add_argument("--images", action="store_true", help="rendered pictures in place of synthetic candidates")
    parser.add_argument(
        "--exposure",
        choices=EXPOSURES,
        default=plan.exposure,
        help="of pictures; auto: locked to the lamps, as a node's camera does it; default: %(default)s",
    )
    parser.add_argument("--imu", action="store_true", help="with raw inertial samples")
    parser.add_argument(
        "--inertial",
        choices=INERTIAL_GRADES,
        default=scenario.inertial,
        help="poor: mounted 1 deg off, stamped late, with walking biases, shaken by fins; default: %(default)s",
    )
    parser.add_argument("--width", type=int, default=scenario.width_px, metavar="PX", help="default: %(default)s")
    world = parser.add_argument_group("the dive")
    world.add_argument("--trajectory", choices=TRAJECTORIES, default=scenario.trajectory, help="default: circles")
    world.add_argument(
        "--range-min", type=float, default=scenario.range_min_m, metavar="M", help="default: %(default)s"
    )
    world.add_argument("--range-max", type=float, default=0.0, metavar="M", help="default: as far as the water allows")
    world.add_argument(
        "--baseline", type=float, default=scenario.baseline_a_m, metavar="M", help="default: %(default)s"
    )
    world.add_argument(
        "--nodes", type=int, default=2, metavar="N", help="a, b, c, ...: above 2 in two groups; default: %(default)s"
    )
    world.add_argument(
        "--fixed", action="append", default=[], metavar="NODE", help="a node that stands still, such as a; repeatable"
    )
    world.add_argument("--blink", action="store_true", help="each node's left lamp blinks by a code of its own")
    world.add_argument("--others", type=int, default=scenario.other_lamps, metavar="N", help="other divers' lamps")
    world.add_argument("--tags", action="store_true", help="two AR tags on each node, for comparison")
    world.add_argument("--undisturbed", action="store_true", help="no diver looks away, nothing passes before a light")
    faults = parser.add_argument_group("noise and faults")
    faults.add_argument("--sigma-px", type=float, default=scenario.sigma_px, metavar="PX", help="noise of candidates")
    faults.add_argument("--gross", type=float, default=scenario.gross_share, metavar="SHARE", help="off by pixels")
    faults.add_argument("--misses", type=float, default=scenario.miss_share, metavar="SHARE", help="lights not found")
    faults.add_argument("--false", type=int, default=scenario.false_lights, metavar="N", help="false ones a picture")
    faults.add_argument("--lost", type=float, default=plan.lost_share, metavar="SHARE", help="frames lost")
    faults.add_argument("--clock-offset-ms", type=float, default=0.0, metavar="MS", help="b's clock ahead of a's")
    faults.add_argument("--clock-drift-ppm", type=float, default=0.0, metavar="PPM", help="and gaining")
    faults.add_argument("--magnetometer-off-deg", type=float, default=0.0, metavar="DEG", help="b's heading is wrong")
    faults.add_argument(
        "--dead-lamp", action="append", default=[], metavar="NODE.SIDE", help="a dark lamp, such as b.left; repeatable"
    )
    faults.add_argument(
        "--decoy", action="append", default=[], choices=DECOYS, help="in pictures, what is taken for lamps; repeatable"
    )
    faults.add_argument("--pwm-hz", type=float, default=0.0, metavar="HZ", help="lights dimmed by pulses")
    faults.add_argument("--strobe-s", type=float, default=0.0, metavar="S", help="a strobe flashes so often")
    faults.add_argument("--row-time-us", type=float, default=0.0, metavar="US", help="rolling shutter: time a row")


def run(args: argparse.Namespace) -> int:
    """Write the dive; return 0."""
    import cv2
    from buddyline.node.sim.dive import messages
    from buddyline.node.sim.world import World
    from buddyline.tools.newfile import new_dive_log

    cv2.setNumThreads(1)
    plan = DivePlan(
        seconds=args.seconds,
        rate_hz=args.rate,
        images=args.images,
        exposure=args.exposure,
        imu=args.imu,
        lost_share=args.lost,
    )
    scenario = Scenario(
        environment=args.environment,
        seed=args.seed,
        start_ns=START_NS,
        more_nodes=more_nodes(args.nodes),
        fixed_nodes=tuple(args.fixed),
        width_px=args.width,
        height_px=round(args.width * ASPECT),
        row_time_ns=round(args.row_time_us * 1000),
        baseline_a_m=args.baseline,
        baseline_b_m=args.baseline,
        trajectory=args.trajectory,
        range_min_m=args.range_min,
        range_max_m=args.range_max,
        sigma_px=args.sigma_px,
        gross_share=args.gross,
        miss_share=args.misses,
        false_lights=args.false,
        other_lamps=args.others,
        tags=args.tags,
        interruptions=not args.undisturbed,
        clock_offset_ns=round(args.clock_offset_ms * MS_NS),
        clock_drift=1e-6 * args.clock_drift_ppm,
        magnetometer_off_rad=math.radians(args.magnetometer_off_deg),
        inertial=args.inertial,
        dead_lamps=tuple(args.dead_lamp),
        decoys=tuple(args.decoy),
        blink_slot_ns=plan.period_ns if args.blink else 0,
        pwm_hz=args.pwm_hz,
        strobe_s=args.strobe_s,
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


def _differing(scenario: Scenario) -> dict[str, object]:
    """Return the fields of a scenario that differ from their defaults, and those that are always recorded."""
    return {
        field.name: getattr(scenario, field.name)
        for field in fields(scenario)
        if getattr(scenario, field.name) != field.default or field.name in ("environment", "seed")
    }
