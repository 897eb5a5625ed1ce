"""Stamps of the samples in a chip's FIFO, whose clock is not the node's, and is up to some percent off its rate."""

from __future__ import annotations

import math
from typing import Final

RATE_SIGMA: Final = 0.04
# A chip that cools by 25 K within two minutes may change its rate by 1e-4 a second, always the same way.
RATE_WALK: Final = 6e-4  # after one second
# How many standard deviations before a sample is expected a reading is to come, by turns: with one margin alone an
# error of the period can grow with the readings. Readings are late rather than early.
MARGINS: Final = (1.0, 0.5)
JITTER_S: Final = 10e-6
# Where a reading is less likely than this, the estimate's variances are too small.
DOUBTFUL: Final = 1e-3
WIDER: Final = 2.0


class FifoClock:
    """Estimates the newest sample's instant and the period, each with its uncertainty.

    A level that is read between two instants says that the newest sample was taken before the second one, and the next
    one will be after the first. So a reading rules out what is beyond these bounds: the normal distribution of instant
    and period is cut there, and replaced by the one with the same mean and covariance. Readings near the instants of
    samples tell most (`wake_ns`), and leave an error far below the period.

    period_s: the estimate. sigma_s: 1 sd of the newest sample's instant. lost: samples that are missing so far.
    """

    def __init__(self, period_s: float) -> None:
        self.period_s = period_s
        self.lost = 0
        self._period_variance = (RATE_SIGMA * period_s) ** 2
        self._variance = self._covariance = 0.0
        self._newest_ns = 0
        self._told_ns = 0
        self._in_step = self._started = False
        self._margin = MARGINS[0]

    @property
    def sigma_s(self) -> float:
        """Return 1 sd of the newest sample's instant."""
        return math.sqrt(self._variance)

    def restart(self) -> None:
        """Forget the instants, but not the period: the FIFO was cleared by a start of the chip."""
        self._in_step = self._started = False

    def lose(self) -> None:
        """Count what is missing at the next reading: the FIFO was full, and was cleared."""
        self._in_step = False

    def wake_ns(self, instant_ns: int) -> int:
        """Return the instant near to this one at which a reading tells most: just before a sample is expected."""
        if not self._in_step:
            return instant_ns
        self._margin = MARGINS[self._margin == MARGINS[0]]
        best_ns = self._newest_ns - round(1e9 * self._margin * self.sigma_s)
        samples = round((instant_ns - best_ns) / 1e9 / self.period_s)
        return best_ns + round(1e9 * samples * self.period_s)

    def stamps_ns(self, count: int, before_ns: int, after_ns: int) -> list[int]:
        """Return the stamps of the count (1 or more) samples that a level read between two instants has told of.

        They begin one period after the last ones: a correction is spread over them.
        """
        if self._in_step:
            self._predict(count)
            self._in_step = self._cut(before_ns, after_ns)
        if not self._in_step:
            self._synchronize(count, before_ns, after_ns)
            last_ns = self._newest_ns - round(1e9 * count * self.period_s)
        else:
            last_ns = self._told_ns
        self._told_ns = self._newest_ns
        whole_ns = self._newest_ns - last_ns
        return [last_ns + whole_ns * (i + 1) // count for i in range(count)]

    def _synchronize(self, count: int, before_ns: int, after_ns: int) -> None:
        """Take any instant within a period before the reading for as likely."""
        newest_ns = (before_ns + after_ns) // 2 - round(5e8 * self.period_s)
        if self._started and newest_ns > self._told_ns:
            self.lost += max(0, round((newest_ns - self._told_ns) / 1e9 / self.period_s) - count)
        self._newest_ns = newest_ns
        self._variance, self._covariance = self.period_s**2 / 12 + ((after_ns - before_ns) / 1e9) ** 2 / 12, 0.0
        self._in_step = self._started = True

    def _predict(self, count: int) -> None:
        passed_s = count * self.period_s
        self._newest_ns += round(1e9 * passed_s)
        self._variance += count * (2 * self._covariance + count * self._period_variance + JITTER_S**2)
        self._covariance += count * self._period_variance
        self._period_variance += (RATE_WALK * self.period_s) ** 2 * passed_s

    def _cut(self, before_ns: int, after_ns: int) -> bool:
        """Cut at both bounds of a reading; return False if it contradicts the estimate altogether."""
        return self._bound(after_ns, 0) and self._bound(before_ns, 1)

    def _bound(self, instant_ns: int, ahead: int) -> bool:
        """Cut at an instant: ahead 0: the newest sample was taken before it; 1: the next one comes after it."""
        sign = 1 - 2 * ahead
        while True:
            by_newest = self._variance + ahead * self._covariance
            by_period = self._covariance + ahead * self._period_variance
            variance = by_newest + ahead * by_period
            sigma_s = math.sqrt(variance)
            bound = sign * ((instant_ns - self._newest_ns) / 1e9 - ahead * self.period_s) / sigma_s
            chance = 0.5 * math.erfc(-bound / math.sqrt(2))
            if chance >= DOUBTFUL:
                break
            if self._variance > self.period_s**2:
                return False
            self._variance, self._covariance = WIDER * self._variance, WIDER * self._covariance
            self._period_variance *= WIDER
        slope = math.exp(-0.5 * bound**2) / math.sqrt(2 * math.pi) / chance
        step = -sign * slope / sigma_s
        cut = slope * (slope + bound) / variance
        self._newest_ns += round(1e9 * step * by_newest)
        self.period_s += step * by_period
        self._variance -= cut * by_newest**2
        self._covariance -= cut * by_newest * by_period
        self._period_variance -= cut * by_period**2
        return True
