"""How much a slow link can carry, and what is left out on it. No bus and no clock: both are passed in."""

from __future__ import annotations

import threading
from collections import Counter, deque
from typing import Final

from buddyline.protocol.connection import TcpState
from buddyline.protocol.topics import Topic

# A link is full if so many bytes, more than a packet, wait in each observation of this time.
FULL_BYTES: Final = 2048
FULL_S: Final = 0.3
# Longer than a lost packet holds up a connection, as a rule.
BEHIND_S: Final = 1.0
# It is then given less than was sent, not again before the link can have reacted, and more again while nothing waits.
AGAIN_S: Final = 1.0
LESS: Final = 0.8
MORE_PER_S: Final = 0.03
# Before anything waits here, what is queued in a modem delays the acknowledgements. By so much, a link is given no
# more; by twice as much, it is full. The shortest of this time counts; if there is none, `_queued_s` tells.
QUEUED_S: Final = 0.1
LEAST_OVER_S: Final = 1.0
# Behind a longer queue candidates come too late: the link is then given half.
LONG_QUEUE_S: Final = 0.5
MUCH_LESS: Final = 0.5
# The connection is looked at after this time, as a rule.
LOOK_S: Final = 0.1
# A limit does not grow above so many times what is sent.
MOST_PER_OFFERED: Final = 1.25
# A link with a long round trip may be slow. It begins with little. The limit grows faster until something is queued for
# the first time, and while more is sent than the limit: candidates always go.
FIRST_BYTES_PER_S: Final = 8000.0
FIRST_MORE_PER_S: Final = 0.15
# JSON is compressed on the way, how much so is not known: so many bytes of messages are in one that was acknowledged.
MOST_PER_ACKED: Final = 1.5
LEAST_PER_ACKED: Final = 0.8
LEAST_BYTES_PER_S: Final = 1000.0
# A limit is lifted if for so long nothing was left out and nothing had to wait for it, and so much of it is used.
LIFT_S: Final = 20.0
LIFT_SHARE: Final = 0.5
OBSERVED_S: Final = 2.0
# Of a message besides its payload: headers of Zenoh, TLS, TCP and IP, and the acknowledgement.
OVERHEAD_BYTES: Final = 100
# By Topic.shed: a message is left out where the budget of a second is used up to this share of it.
_RESERVES: Final = (-1.0, 0.9, 0.6, 0.3, 0.1)
WORDS_S: Final = 10.0
# What can wait for hours goes only where so much of a second's budget is left.
SPARE_SHARE: Final = 0.8
# What was missed has this share of the budget for itself: candidates and their copies may always use up the rest.
ANSWER_SHARE: Final = 0.25


class AckDelay:
    """How long after it was sent the other end acknowledges what a connection sends.

    least_s: the shortest of late; None if unknown. Where packets were lost meanwhile, the time shows the loss and
    nothing else: it does not count. Nor does what a busy machine takes longer than LOOK_S to the next look.
    """

    def __init__(self) -> None:
        self.least_s: float | None = None
        self._last: tuple[float, int] | None = None
        self._sent: deque[tuple[float, TcpState]] = deque()
        self._delays_s: deque[tuple[float, float]] = deque()

    def observe(self, state: TcpState, now_s: float) -> None:
        """Take the state of the connection."""
        last_s, last_sent = self._last or (now_s, state.sent)
        self._last = now_s, state.sent
        while self._sent and self._sent[0][1].sent <= state.acked:
            sent_s, then = self._sent.popleft()
            if then.sent_again == state.sent_again:
                self._delays_s.append((now_s, min(now_s, last_s + LOOK_S) - sent_s))
        if state.sent > last_sent:
            self._sent.append((now_s, state))
        while self._delays_s and now_s - self._delays_s[0][0] > LEAST_OVER_S:
            self._delays_s.popleft()
        self.least_s = min((delay_s for _, delay_s in self._delays_s), default=None)


class LinkBudget:
    """Decides which messages a link carries. Without congestion that is all of them. Safe to use from several threads.

    What may be left out, and in which order, is in the table of topics (`shed`, `keep_hz`). shed: number of messages
    left out, by topic.
    """

    def __init__(self) -> None:
        self.shed: Counter[str] = Counter()
        self._lock = threading.Lock()
        self._limit: float | None = None
        self._is_slow = self._was_lifted = False
        self._tokens = 0.0
        self._answer_tokens = 0.0
        self._tokens_s = 0.0
        self._offered = 0.0
        self._kept_s: dict[str, float] = {}
        self._seen: deque[tuple[float, float, TcpState]] = deque()
        self._delay = AckDelay()
        self._clear_s = self._full_s = self._reduced_s = self._shed_s = float("-inf")
        # When the other end last acknowledged something while the link was full.
        self._moved_s = float("-inf")
        self._counted_s = 0.0
        self._sent: Counter[str] = Counter()
        self._left_out: Counter[str] = Counter()
        self._words = ""

    @property
    def bytes_per_s(self) -> float | None:
        """What the link is given, payloads and headers; None: no limit is known."""
        return self._limit

    @property
    def is_slow(self) -> bool:
        """Whether the link has a limit, and something was queued on it since the last limit was lifted."""
        return self._is_slow and self._limit is not None

    def admits(self, topic: Topic, size_bytes: int, now_s: float) -> bool:
        """Return whether to send a message of a topic; if so, count it as sent. now_s: monotonic."""
        cost = float(size_bytes + OVERHEAD_BYTES)
        with self._lock:
            if self._limit is not None:
                self._refill(now_s, self._limit)
                if topic.shed and not self._keeps(topic, now_s) and self._tokens - cost < self._reserve(topic):
                    self.shed[topic.name] += 1
                    self._left_out[topic.name] += 1
                    self._shed_s = now_s
                    return False
            self._spend(cost)
            self._sent[topic.name] += 1
            return True

    def admits_copy(self, size_bytes: int, now_s: float) -> bool:
        """Return whether to send a copy of a message as a datagram; if so, count it as sent.

        A copy only counts as the next message: behind a full connection it would take that one's room for nothing. But
        where a lost packet has stopped the connection, for seconds, copies are all that arrives.
        """
        with self._lock:
            if self._limit is None or (self._is_behind(now_s) and not self._is_stopped()):
                return False
            self._refill(now_s, self._limit)
            self._spend(float(size_bytes + OVERHEAD_BYTES))
            return True

    def admits_answer(self, size_bytes: int, now_s: float) -> bool:
        """Return whether the link has room for a part of what was missed; if so, count it as sent.

        Behind a full connection there is none. Otherwise a part goes while the answers' share is not overdrawn.
        """
        with self._lock:
            if self._limit is not None:
                self._refill(now_s, self._limit)
                if self._answer_tokens < 0.0 or self._is_behind(now_s):
                    self._shed_s = now_s
                    return False
                self._answer_tokens -= size_bytes + OVERHEAD_BYTES
            self._spend(float(size_bytes + OVERHEAD_BYTES))
            return True

    def admits_spare(self, size_bytes: int, now_s: float) -> bool:
        """Return whether the link has room for what can wait; if so, count it as sent."""
        with self._lock:
            if self._limit is not None:
                self._refill(now_s, self._limit)
                if self._tokens < SPARE_SHARE * self._limit:
                    self._shed_s = now_s
                    return False
            self._spend(float(size_bytes + OVERHEAD_BYTES))
            return True

    def observe(self, state: TcpState, now_s: float, beside: int = 0) -> None:
        """Take the state of the connection, each LOOK_S; a new connection begins with `forget`.

        beside: bytes that were acknowledged on others which share the link. A link on which nothing is acknowledged is
        cut, or waits for a lost packet: nothing is learned from that.
        """
        with self._lock:
            self._delay.observe(state, now_s)
            state = state._replace(acked=state.acked + beside)
            patience_s = FULL_S + 2.0 * state.min_rtt_s
            moved = bool(self._seen) and state.acked > self._seen[-1][2].acked
            if moved and now_s - max(self._moved_s, self._clear_s) > patience_s:
                self._seen.clear()
                self._full_s = now_s
            self._seen.append((now_s, self._offered, state))
            while now_s - self._seen[0][0] > OBSERVED_S:
                self._seen.popleft()
            if state.waiting < FULL_BYTES:
                self._clear_s = self._full_s = now_s
                self._moved_s = float("-inf")
            elif moved:
                self._moved_s = now_s
            if now_s - self._full_s > FULL_S:
                if now_s - self._moved_s <= patience_s:
                    self._reduce(now_s)
            else:
                self._adapt(now_s)

    def begin_low(self, now_s: float) -> None:
        """Begin with little, on a link with a long round trip of which nothing is known."""
        with self._lock:
            if self._limit is None and not self._was_lifted:
                self._set_limit(FIRST_BYTES_PER_S, now_s)

    def forget(self, now_s: float) -> None:
        """Begin anew with another connection; the limit stays."""
        with self._lock:
            self._seen.clear()
            self._delay = AckDelay()
            self._clear_s = self._full_s = now_s
            self._moved_s = float("-inf")

    def words(self, now_s: float) -> str:
        """Return what the link leaves out, and how late the rest is, for people; "" if nothing."""
        with self._lock:
            if now_s - self._counted_s > WORDS_S:
                parts = [
                    f"{name} {100 * self._sent[name] // (self._sent[name] + left_out)} %"
                    for name, left_out in sorted(self._left_out.items())
                ]
                rate = "" if self._limit is None else f" of about {self._limit / 1000:.0f} kB/s"
                told = [f"sent of {', '.join(parts)}"] if parts else []
                behind_s = now_s - self._clear_s
                if self._seen and behind_s > BEHIND_S:
                    told.append(f"messages come {BEHIND_S:g} s late or more, since {behind_s:.0f} s ago")
                self._words = f"slow link{rate}: {'; '.join(told)}; the log has all" if told else ""
                self._sent.clear()
                self._left_out.clear()
                self._counted_s = now_s
            return self._words

    def _refill(self, now_s: float, limit: float) -> None:
        earned = (now_s - self._tokens_s) * limit
        self._tokens = min(self._tokens + earned, limit)
        self._answer_tokens = min(self._answer_tokens + ANSWER_SHARE * earned, limit)
        self._tokens_s = now_s

    def _is_behind(self, now_s: float) -> bool:
        return now_s - self._clear_s > BEHIND_S

    def _is_stopped(self) -> bool:
        """Return whether hardly anything was acknowledged of late: not more than a packet."""
        return not self._seen or self._seen[-1][2].acked - self._seen[0][2].acked < FULL_BYTES

    def _spend(self, cost: float) -> None:
        """Count bytes as sent. At most a second's budget is owed."""
        if self._limit is not None:
            self._tokens = max(self._tokens - cost, -self._limit)
        self._offered += cost

    def _keeps(self, topic: Topic, now_s: float) -> bool:
        """Return whether a message is among those of its topic that are always sent."""
        if not topic.keep_hz or now_s - self._kept_s.get(topic.name, float("-inf")) < 1.0 / topic.keep_hz:
            return False
        self._kept_s[topic.name] = now_s
        return True

    def _reserve(self, topic: Topic) -> float:
        return _RESERVES[topic.shed] * (self._limit or 0.0)

    def _adapt(self, now_s: float) -> None:
        """Change the limit of a link on which nothing waits here."""
        limit, (begin_s, offered, _), (_, _, state) = self._limit, self._seen[0], self._seen[-1]
        if now_s - begin_s < OBSERVED_S / 2.0 or (limit is None and not state.is_long):
            return
        offered_rate = (self._offered - offered) / (now_s - begin_s)
        since_s = now_s - self._reduced_s
        queued_s = self._queued_s()
        self._is_slow |= queued_s > QUEUED_S
        if queued_s > 2.0 * QUEUED_S:
            used, least = (offered_rate, FIRST_BYTES_PER_S) if limit is None else (limit, LEAST_BYTES_PER_S)
            if offered_rate >= LESS * used and since_s > AGAIN_S + 2.0 * state.min_rtt_s + queued_s:
                less = LESS if queued_s < LONG_QUEUE_S else MUCH_LESS
                self._set_limit(max(less * used, least), now_s)
        elif limit is not None and queued_s < QUEUED_S:
            if since_s > AGAIN_S:
                more_per_s = MORE_PER_S if self._is_slow and offered_rate <= limit else FIRST_MORE_PER_S
                most = max(MOST_PER_OFFERED * offered_rate, limit)
                self._limit = min(limit * (1.0 + more_per_s * (now_s - self._seen[-2][0])), most)
            if now_s - max(self._shed_s, self._reduced_s) > LIFT_S and offered_rate > LIFT_SHARE * limit:
                self._limit, self._is_slow, self._was_lifted = None, False, True

    def _queued_s(self) -> float:
        """Return how long what is sent waits in a modem; QUEUED_S or more where that is not known."""
        begin, state = self._seen[0][2], self._seen[-1][2]
        if self._delay.least_s is not None:
            return self._delay.least_s - state.min_rtt_s
        if state.acked == begin.acked:
            return QUEUED_S
        # Behind a long queue every delay is one over a loss. The smoothed round trip still shows the queue, if late.
        return max(state.rtt_s - state.min_rtt_s, QUEUED_S)

    def _reduce(self, now_s: float) -> None:
        begin_s, offered, state = self._seen[0]
        span_s = now_s - begin_s
        if now_s - self._reduced_s < AGAIN_S + 2.0 * state.min_rtt_s or span_s <= FULL_S:
            return
        offered_rate = (self._offered - offered) / span_s
        acked_rate = (self._seen[-1][2].acked - state.acked) / span_s
        limit = max(min(LESS * offered_rate, MOST_PER_ACKED * acked_rate), LEAST_PER_ACKED * acked_rate)
        self._is_slow = True
        self._set_limit(max(min(limit, self._limit or limit), LEAST_BYTES_PER_S), now_s)

    def _set_limit(self, limit: float, now_s: float) -> None:
        if self._limit is None:
            self._tokens, self._answer_tokens, self._tokens_s = 0.0, 0.0, now_s
        self._limit = limit
        self._reduced_s = now_s
