"""Simulated networks whose stations have tags, which the nodes' own cameras read: two loops, two dives, nothing typed.

python -m tests.tools.tagged_survey                   # 20 networks, some minutes
python -m tests.tools.tagged_survey --forgotten 0.1   # one marker in ten is never held before a camera
"""

from __future__ import annotations

import argparse

import numpy as np
from buddyline.node.config import StationTagsConfig
from buddyline.node.station_tags import NUMBERS, StationTags, name_of
from buddyline.protocol.clock import S_NS
from buddyline.tools.survey.derive import Derived
from buddyline.tools.survey.network import adjust
from buddyline.tools.survey.readings import of_messages
from buddyline.tools.survey.settings import AlarmSettings, SurveySettings

from tests.tagged import CAMERA, frame
from tests.tools import survey_world as world

LEGS = 20
REST_S, SWIM_S, PAUSE_S = 10.0, 4.0, 36.0
LEG_S = 3.0 + REST_S + SWIM_S + PAUSE_S
# Where the second loop hangs on the first one.
JUNCTION = 7
# One context picture in this time.
LOOK_S = 2.0


def courses(rng):
    """Two loops (courses without marks) that share one station, and each one's tags by station."""
    first, second = world.loop(rng, LEGS), world.loop(rng, LEGS)
    second.stations_m += first.stations_m[JUNCTION] - second.stations_m[0]
    first.marks.clear()
    second.marks.clear()
    tags = [[NUMBERS[0] + k for k in range(LEGS)], [NUMBERS[0] + 50 + k for k in range(LEGS)]]
    tags[1][0] = tags[0][JUNCTION]
    return list(zip((first, second), tags, strict=True))


def looks(course, tags, rng, forgotten):
    """What the nodes' cameras see of tags: by node, (seconds from the first leg's begin, tags by distance).

    forgotten: the share of arrivals at which the diver does not hold the camera before the marker.
    """
    seen = ([], [])

    def look(node, from_s, count, number, nearest_m, farthest_m):
        for k in range(count):
            seen[node].append((from_s + LOOK_S * k, {number: rng.uniform(nearest_m, farthest_m)}))

    for number, (start, end, rear) in enumerate(course.legs):
        rest_s = number * LEG_S + 3.0
        arriving = [(1 - rear, end)] + ([(rear, start)] if number == 0 else [])
        for node, station in arriving:
            # Before tying off the diver holds the camera before the marker for some seconds.
            count = int(rng.integers(4, 7)) if rng.random() >= forgotten else 0
            look(node, rest_s - rng.uniform(12, 15), count, tags[station], 0.4, 0.9)
        if number:
            passed_s = rest_s - 3.0 - SWIM_S - PAUSE_S + rng.uniform(10, 16)
            look(1 - rear, passed_s, int(rng.choice(4, p=[0.4, 0.45, 0.1, 0.05])), tags[start], 0.5, 1.4)
            if rng.random() < 0.3:
                look(rear, passed_s, 3, tags[start], 0.4, 1.2)
    return [sorted(one, key=lambda seen: seen[0]) for one in seen]


def read(course, tags, rng, forgotten):
    """The marks of both nodes, read in rendered pictures; between looks the camera sees no tag."""
    marks = []
    for node, seen in zip(world.NODES, looks(course, tags, rng, forgotten), strict=True):
        reader, last_s = StationTags(node, StationTagsConfig(), CAMERA.fx_px), -1e3
        for at_s, shown in seen:
            stamp_ns = world.START_NS + round(at_s * S_NS)
            if at_s - last_s > 1.5 * LOOK_S:
                reader.read(frame(rng, stamp_ns - round(LOOK_S * S_NS), {}))
            last_s = at_s
            if (mark := reader.read(frame(rng, stamp_ns, shown))) is not None:
                marks.append(mark)
    return marks


def survey(seed, forgotten):
    """Return the derived network of a seed, and each leg's true ends."""
    rng = np.random.default_rng([seed, 11])
    derived, truth = Derived(), []
    for number, (course, tags) in enumerate(courses(rng), 1):
        messages = world.dive(course, rng, world.Flaws(), REST_S, SWIM_S, pause_s=PAUSE_S)
        marks = read(course, tags, rng, forgotten)
        derived.add(of_messages([*messages, *marks]), SurveySettings(), AlarmSettings(), number)
        truth += [(name_of(tags[start]), name_of(tags[end])) for start, end, _ in course.legs]
    return derived, truth


def judge(seed, forgotten=0.0):
    """Return whether all names and both loops are right, and whether some station has another one's name."""
    derived, truth = survey(seed, forgotten)
    named = [(leg.from_, leg.to) for leg in derived.legs]
    loops = adjust(world.project_of(derived.legs, turn=derived.turns)).loops
    wanted = {frozenset(name for ends in truth[part] for name in ends) for part in (slice(LEGS), slice(LEGS, None))}
    right = named == truth and {frozenset(loop.stations) for loop in loops} == wanted and len(loops) == 2
    # A number is no identity: nobody has stated it.
    silent = len(named) == len(truth) and any(
        said != true and said.startswith("T")
        for ends, true_ends, leg in zip(named, truth, derived.legs, strict=True)
        if not any(alarm.startswith("stations") for alarm in leg.alarms)
        for said, true in zip(ends, true_ends, strict=True)
    )
    return right, silent


def main():
    """Print how many networks are right."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--networks", type=int, default=20)
    parser.add_argument("--forgotten", type=float, default=0.0, help="share of arrivals without a look at the marker")
    args = parser.parse_args()
    found = []
    for seed in range(args.networks):
        found.append(judge(seed, args.forgotten))
        print(seed, *found[-1], flush=True)
    print(f"right: {sum(right for right, _ in found)} of {len(found)}; false identities: {sum(s for _, s in found)}")


if __name__ == "__main__":
    main()
