"""Which candidates of one node's pictures blink as another node's lamp does: one more evidence of who is who.

Candidates are followed from picture to picture, and the pictures with and without each are compared with the other
node's code. The result is a likelihood ratio of each candidate, to be weighed with all other evidence. That markers
which blink by known codes tell flying robots apart is the idea of UVDAR (Walter et al., RA-L 4(3), 2019).
"""

from __future__ import annotations

from typing import Final

import numpy as np
from buddyline.protocol.blinking import lit
from buddyline.protocol.clock import MS_NS, S_NS
from buddyline.protocol.messages import Blink
from buddyline.solver_service.geometry.observation import Blinking
from buddyline.solver_service.geometry.rotation import Floats
from numpy.typing import NDArray

# Pictures of this time count: a whole round of the code at 10 Hz.
WINDOW_NS: Final = 1050 * MS_NS
# A lamp that has been in no picture for this long is a new one when it comes back.
LOST_NS: Final = 450 * MS_NS
# Lengths as shares of the picture's width: how far a candidate may be from where it is looked for; how far the camera's
# turning moves all candidates from one picture to the next; how near two such moves must be to count as the same.
GATE: Final = 0.03
TURNED: Final = 0.1
ALIKE: Final = 0.008
# How much of a candidate's last move its foreseen speed takes over.
TAKEN: Final = 0.35
# How likely a lamp that is lit is not found; the same where only parts of the picture were searched; how likely
# something is found in the place of a dark one.
MISSED: Final = 0.06
MISSED_GUIDED: Final = 0.3
FALSE: Final = 0.03
# What is neither steady nor blinks by this code, such as another node's lamp, is found in this share of the pictures.
OTHERWISE: Final = 0.7
# Log odds count at most so much, either way: a candidate may be followed wrongly.
MOST: Final = 6.0


class LampFollower:
    """Follows the candidates of one node's pictures, which come in the order of time."""

    def __init__(self) -> None:
        self.forget()

    def forget(self) -> None:
        """Forget all pictures."""
        # Of each picture: its stamp, and how likely a lit lamp is not found in it.
        self._pictures: list[tuple[int, float]] = []
        # Of each lamp that is followed (N): place, px; speed, px a s; when it was seen last; in which pictures it was:
        # 1, 0, or -1 for those before its first.
        self._place = np.zeros((0, 2))
        self._speed = np.zeros((0, 2))
        self._last_ns = np.zeros(0, np.int64)
        self._seen = np.zeros((0, 0), np.int8)

    def take(self, stamp_ns: int, pixels: Floats, width_px: int, blink: Blink, *, whole: bool = True) -> Blinking:
        """Take a picture's candidates (K, 2), and compare them with a code. whole: all of it was searched."""
        if self._pictures and not 0 < stamp_ns - self._pictures[-1][0] < LOST_NS:
            self.forget()
        lamp = self._follow(stamp_ns, pixels, width_px)
        old = sum(stamp_ns - each_ns > WINDOW_NS for each_ns, _ in self._pictures)
        self._pictures = [*self._pictures[old:], (stamp_ns, MISSED if whole else MISSED_GUIDED)]
        self._seen = self._seen[:, old:]
        return self._compare(self._seen[lamp], blink)

    def _follow(self, stamp_ns: int, pixels: Floats, width_px: int) -> NDArray[np.intp]:
        """Give the lamp (K,) that each candidate is, and count it as seen."""
        before = len(self._place)
        dt_s = (stamp_ns - self._pictures[-1][0]) / S_NS if self._pictures else 1.0
        foreseen = self._place + dt_s * self._speed
        away = pixels - foreseen[:, None]
        turned = _common_move(away[self._last_ns == self._pictures[-1][0]], width_px) if before else np.zeros(2)
        foreseen += turned
        self._speed += turned / dt_s
        away2 = np.square(away - turned).sum(-1)
        lamp = np.full(len(pixels), -1)
        free = np.ones(before, dtype=bool)
        for index in np.argsort(away2, axis=None, kind="stable").tolist():
            which, k = divmod(index, len(pixels))
            if away2[which, k] > (GATE * width_px) ** 2:
                break
            if free[which] and lamp[k] < 0:
                free[which], lamp[k] = False, which
        known = lamp >= 0
        of = lamp[known]
        self._speed[of] += TAKEN * (pixels[known] - foreseen[of]) / dt_s
        foreseen[of] = pixels[known]
        self._last_ns[of] = stamp_ns
        fresh = int((~known).sum())
        lamp[~known] = before + np.arange(fresh)
        none, seen = np.full((fresh, len(self._pictures)), -1, np.int8), np.zeros((before + fresh, 1), np.int8)
        seen[lamp] = 1
        self._place = np.concatenate((foreseen, pixels[~known]))
        # A new one moves with the camera, as the others do.
        common = np.median(self._speed[of], axis=0) if len(of) else np.zeros(2)
        self._speed = np.concatenate((self._speed, np.tile(common, (fresh, 1))))
        self._last_ns = np.concatenate((self._last_ns, np.full(fresh, stamp_ns)))
        self._seen = np.concatenate((np.concatenate((self._seen, none)), seen), axis=1)
        kept = self._last_ns > stamp_ns - LOST_NS
        self._place, self._speed, self._last_ns = self._place[kept], self._speed[kept], self._last_ns[kept]
        self._seen = self._seen[kept]
        moved_to: NDArray[np.intp] = (np.cumsum(kept) - 1)[lamp]
        return moved_to

    def _compare(self, seen: NDArray[np.int8], blink: Blink) -> Blinking:
        """Compare in which pictures candidates were (K, P) with a code."""
        shines = np.array([lit(blink, stamp_ns) for stamp_ns, _ in self._pictures]).T
        missed = np.array([share for _, share in self._pictures])

        def log_likelihood(found: Floats) -> Floats:
            """Give that of each candidate where it is found with these probabilities (P,)."""
            of_picture = np.where(seen == 1, np.log(found), np.where(seen == 0, np.log1p(-found), 0.0))
            total: Floats = of_picture.sum(1)
            return total

        steady, otherwise = log_likelihood(1.0 - missed), log_likelihood(np.full(len(missed), OTHERWISE))
        another = np.logaddexp(steady, otherwise) - np.log(2.0)
        log_ratio = np.empty((len(seen), 2))
        dark = not shines[0, -1], not shines[1, -1]
        for side in (0, 1):
            own = log_likelihood(np.where(shines[side], 1.0 - missed, FALSE))
            odds = np.clip(own - another, -MOST, MOST)
            # The lamp is one of these candidates, if it is lit and was found: their ratios average one.
            log_ratio[:, side] = odds if dark[side] or not len(odds) else odds - np.log(np.exp(odds).mean())
        return Blinking(log_ratio, dark)


def _common_move(away: Floats, width_px: int) -> Floats:
    """Give by how much most lamps are off their foreseen places (2,), px: a camera that begins to turn moves all alike.

    away (N, K, 2): each candidate's offset from each lamp's foreseen place.
    """
    moves = away[np.abs(away).max(-1) < TURNED * width_px]
    if len(moves) < 2:
        return np.zeros(2)
    near = np.square(moves[:, None] - moves).sum(-1) < (ALIKE * width_px) ** 2
    # Of moves that as many share, the smallest.
    best = int(np.lexsort((np.square(moves).sum(-1), -near.sum(1)))[0])
    common: Floats = moves[near[best]].mean(0)
    return common if near[best].sum() > 1 else np.zeros(2)
