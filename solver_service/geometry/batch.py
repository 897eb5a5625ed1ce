"""What the pictures and sensors of many triggers hold, in the rigs' bar frames; all of one pair of rigs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from buddyline.solver_service.geometry.candidates import CandidateBearings, find_candidates
from buddyline.solver_service.geometry.observation import Observation, Settings
from buddyline.solver_service.geometry.pairs import Pairs, find_pairs
from buddyline.solver_service.geometry.rig import Rig, RigPair, pair_of
from buddyline.solver_service.geometry.sensors import Sensors, find_sensors


@dataclass(eq=False, slots=True)
class Batch:
    """T triggers: their candidates, pairs of candidates, and sensors."""

    rigs: RigPair
    settings: Settings
    candidates: CandidateBearings
    pairs: Pairs
    sensors: Sensors

    @staticmethod
    def of(observations: Sequence[Observation], rigs: tuple[Rig, Rig], settings: Settings) -> Batch:
        """Bring all into the bar frames."""
        pair = pair_of(*rigs)
        candidates, sensors = find_candidates(observations, pair), find_sensors(observations, pair, settings.checks)
        return Batch(pair, settings, candidates, find_pairs(candidates, pair, sensors.down, settings), sensors)

    @property
    def triggers(self) -> int:
        """Number of triggers."""
        return self.candidates.triggers

    @property
    def range_limits(self) -> str:
        """The range limits in words."""
        return f"between {self.settings.range_min_m:g} and {self.settings.range_max_m:g} m"
