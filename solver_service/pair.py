"""Solve one pair of nodes: matched frames in, a fix or the reason for having none out.

The pair's memory (motion prior, heading bias, clock alignment) is kept here and nowhere else.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final

import numpy as np
from buddyline.protocol.blinking import lit
from buddyline.protocol.clock import S_NS
from buddyline.protocol.messages import Candidates, NodeInfo
from buddyline.solver_service.alignment import ClockAlignment
from buddyline.solver_service.blinking import LampFollower
from buddyline.solver_service.geometry.fix import Fix, NoFix
from buddyline.solver_service.geometry.observation import Heading, Observation, Prior, Sensed, Settings, View
from buddyline.solver_service.geometry.rig import Rig
from buddyline.solver_service.geometry.trigger import TriggerReadings, read_triggers
from buddyline.solver_service.headings import HeadingOffset
from buddyline.solver_service.prior import PosePrior
from buddyline.solver_service.rarity import Rarity
from buddyline.solver_service.resting import LOOK_APART, LOOKS, NO_TIME, NOT_IN_VIEW, Resting, look_apart
from buddyline.solver_service.results import NUMERIC_ERRORS, view_of
from msgspec import UNSET

# Limits of one batch: its triggers, and their combinations of pairs of candidates. Larger arrays do not fit into the
# processor's caches and, with crowded pictures, into memory.
_MAX_TOGETHER: Final = 128
_MAX_COMBINATIONS: Final = 250_000
# Pictures further apart than this are brought to one instant only by what so many poses, which agree, told of the
# motion, the last one less than LATELY_S before: a diver who turns moves the other by metres a second in his pictures.
FAR_NS: Final = S_NS // 10
AGREED: Final = 2
LATELY_S: Final = 0.45


@dataclass(frozen=True, eq=False)
class Matched:
    """The frames of nodes a and b for one trigger, with the calibration and the sensor readings for each frame.

    stamp_ns: mean of both frames' stamps. Each frame has its calibration's picture size.
    """

    trigger: int
    stamp_ns: int
    frame_a: Candidates
    frame_b: Candidates
    info_a: NodeInfo
    info_b: NodeInfo
    rig_a: Rig
    rig_b: Rig
    sensed_a: Sensed
    sensed_b: Sensed

    @cached_property
    def apart(self) -> bool:
        """Whether by their attitudes the nodes look apart, in a trigger that need not be solved."""
        return self.trigger % LOOKS != 0 and look_apart((self.sensed_a, self.sensed_b), (self.rig_a, self.rig_b))

    @property
    def dark(self) -> bool:
        """Whether a lamp is switched off by its code."""
        seen = (self.info_a, self.frame_b), (self.info_b, self.frame_a)
        return any(info.blink is not UNSET and not all(lit(info.blink, frame.stamp_ns)) for info, frame in seen)


def _tells_motion(prior: Prior | None) -> bool:
    """Whether poses of just before tell how the nodes move."""
    return prior is not None and prior.agreed >= AGREED and prior.since_s < LATELY_S


def _batches(matched: Sequence[Matched]) -> Iterator[list[Matched]]:
    """Split triggers into batches, which are solved at once; all triggers of a batch have the same calibration."""
    batch: list[Matched] = []
    total = 0
    for one in matched:
        combinations = (len(one.frame_a.blobs) * len(one.frame_b.blobs)) ** 2 // 4
        total += combinations
        full = len(batch) == _MAX_TOGETHER or total > _MAX_COMBINATIONS
        if batch and (full or one.rig_a is not batch[0].rig_a or one.rig_b is not batch[0].rig_b):
            yield batch
            batch, total = [], combinations
        batch.append(one)
    if batch:
        yield batch


class PairSolver:
    """Solves the triggers of one pair.

    alignment: gets each fix, to estimate the clock offset; None for none. clock_s: B's clock minus A's, as far as the
    stamps still hold it: pictures of one stamp were taken so far apart. crowded: whether there are many other pairs.
    one_in: of so many triggers one is to be solved, of a pair that rests one in LOOKS^2; not of all where the solver of
    these pairs cannot keep up.
    """

    def __init__(self, settings: Settings, alignment: ClockAlignment | None = None, clock_s: float = 0.0) -> None:
        self.settings = settings
        self.alignment = alignment
        self._clock_ns = round(clock_s * S_NS)
        self.crowded, self.one_in = False, 1
        self._prior = PosePrior()
        self._headings = HeadingOffset()
        self._rarity = Rarity()
        self._followers = LampFollower(), LampFollower()
        self._resting = Resting()

    def solve(self, matched: Sequence[Matched]) -> list[Fix | NoFix]:
        """Return one result for each trigger.

        The triggers come in increasing order, also from call to call. Their distribution over calls does not change
        the results.
        """
        # Absurd values give rejections, not numpy's warnings, also in the filters that learn from the fixes.
        with np.errstate(all="ignore"):
            return [fix for batch in _batches(matched) for fix in self._solve_batch(batch)]

    def forget(self) -> None:
        """Forget all earlier fixes, after a clock was set or a value was out of numeric range."""
        self._prior.reset()
        self._headings.reset()
        self._rarity.reset()
        self._resting.forget()
        for follower in self._followers:
            follower.forget()

    def heading(self, stamp_ns: int) -> Heading | None:
        """Return the difference of the two headings' biases at stamp_ns; None without an estimate."""
        return self._headings.predict(stamp_ns)

    def _solve_batch(self, batch: Sequence[Matched]) -> list[Fix | NoFix]:
        # What is read does not depend on which triggers are read with it.
        may_rest = {id(one): self._may_rest(one) for one in batch}
        wanted = [one for one in batch if self._left_out(one, may_rest[id(one)]) is None]
        try:
            readings = self._read(wanted) if wanted else None
        except NUMERIC_ERRORS as error:
            if len(batch) == 1:
                return [self._out_of_range(batch[0], error)]
            # One trigger has absurd but finite values, such as 1e300, which make a matrix singular: solve one by one.
            return [fix for one in batch for fix in self._solve_batch([one])]
        places = {id(one): place for place, one in enumerate(wanted)}
        found: list[Fix | NoFix] = []
        for one in batch:
            if (left_out := self._left_out(one, may_rest[id(one)])) is not None:
                found.append(left_out)
            elif id(one) in places and readings is not None:
                found.append(self._decide(one, readings, places[id(one)]))
            else:
                found.append(self._look(one))
        return found

    def _left_out(self, one: Matched, may_rest: str) -> NoFix | None:
        """Return the outcome of a trigger that is not solved, as long as no trigger before it has woken the pair.

        may_rest: what `_may_rest` says of it.
        """
        rests = bool(may_rest or self.one_in > 1) and self._resting.rests(one.stamp_ns)
        if may_rest and rests:
            return NoFix("too_few_candidates", may_rest)
        if self.one_in > 1 and one.trigger % (LOOKS * LOOKS if rests else self.one_in):
            return NoFix("unmatched", NO_TIME)
        return None

    def _may_rest(self, one: Matched) -> str:
        """Return why a trigger need not be solved where the pair rests, "" where it is solved in any case."""
        if one.apart and "attitude" in self.settings.checks:
            return LOOK_APART
        return NOT_IN_VIEW if self.crowded and one.trigger % LOOKS else ""

    def _look(self, one: Matched) -> Fix | NoFix:
        """Solve one trigger by itself."""
        try:
            readings = self._read([one])
        except NUMERIC_ERRORS as error:
            return self._out_of_range(one, error)
        return self._decide(one, readings, 0)

    def _read(self, batch: Sequence[Matched]) -> TriggerReadings:
        observations = [
            Observation(
                view_a=self._view(0, one.frame_a, one.info_b),
                view_b=self._view(1, one.frame_b, one.info_a),
                sensed_a=one.sensed_a,
                sensed_b=one.sensed_b,
            )
            for one in batch
        ]
        return read_triggers(observations, batch[0].rig_a, batch[0].rig_b, self.settings)

    def _view(self, node: int, frame: Candidates, other: NodeInfo) -> View:
        """Return a frame of node a (0) or b (1) by A's clock, with what the other's code says of its candidates."""
        view = view_of(frame)
        if node:
            view = replace(view, stamp_ns=view.stamp_ns - self._clock_ns)
        if other.blink is UNSET:
            return view
        whole = frame.elsewhere is UNSET
        told = self._followers[node].take(frame.stamp_ns, view.pixels, frame.width_px, other.blink, whole=whole)
        return replace(view, blinking=told)

    def _decide(self, matched: Matched, readings: TriggerReadings, place: int) -> Fix | NoFix:
        stamp_ns = matched.stamp_ns
        try:
            learned = self._prior.predict(stamp_ns), self._headings.predict(stamp_ns)
            found = readings.decide(place, *learned, self._rarity.factor)
            if not matched.dark:
                self._rarity.take(found)
            self._headings.take(stamp_ns, found)
            self._resting.take(stamp_ns, found)
            if isinstance(found, Fix):
                self._remember(matched, found)
        except NUMERIC_ERRORS as error:
            return self._out_of_range(matched, error)
        if isinstance(found, Fix) and abs(self._clock_ns) > FAR_NS and not _tells_motion(learned[0]):
            return NoFix("ambiguous", f"pictures {abs(self._clock_ns) / S_NS:.2f} s apart, and no poses just before")
        return found

    def _out_of_range(self, matched: Matched, error: Exception) -> NoFix:
        self.forget()
        nodes = f"{matched.frame_a.node} or {matched.frame_b.node}"
        return NoFix("degenerate", f"values from {nodes} are out of numeric range ({error})")

    def _remember(self, matched: Matched, fix: Fix) -> None:
        if not math.isfinite(fix.T_a_b.t_m.sum() + fix.covariance.sum()):
            raise ArithmeticError("the pose is not finite")
        self._prior.update(matched.stamp_ns, fix)
        if self.alignment is not None:
            stamp_a_ns, stamp_b_ns = matched.frame_a.stamp_ns, matched.frame_b.stamp_ns
            infos, rigs = (matched.info_a, matched.info_b), (matched.rig_a, matched.rig_b)
            sigma_a_rad, sigma_b_rad = (info.sigma_px / info.camera.fx_px for info in infos)
            known_s = (stamp_b_ns - self._clock_ns - stamp_a_ns) / S_NS
            self.alignment.add(stamp_a_ns, fix, rigs, known_s, (sigma_a_rad, sigma_b_rad))
