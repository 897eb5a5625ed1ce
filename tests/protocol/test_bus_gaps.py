"""Gaps of many publishers at once: a few are fetched at a time, and none is given up for want of a thread."""

import threading
from collections import deque

from buddyline.protocol.delivery import FailureLatch
from buddyline.protocol.sequence import PublisherId, SampleSequence
from buddyline.protocol.zenoh_bus.subscription import MAX_OWNER_GAPS, ZenohSubscription

from tests.processes import until


def test_gaps_of_many_pairs_wait_for_a_thread():
    delivered, fetching, most, go_on = [], [], [], threading.Event()
    one = ZenohSubscription.__new__(ZenohSubscription)
    one._sequence = SampleSequence(delivered.append)
    one._lock, one._stop, one._failures = threading.Lock(), threading.Event(), FailureLatch()
    one._fetching, one._unfilled = {}, deque()

    def fetch(gap):
        fetching.append(gap)
        most.append(len(one._fetching))
        go_on.wait()
        return [(number, (gap.source.key, number)) for number in gap.missing]

    one._fetch = fetch
    sources = [PublisherId(f"buddyline/pair/a/n{k}/rejected", "1", k) for k in range(3 * MAX_OWNER_GAPS)]
    for source in sources:
        for number in (0, 3):
            with one._lock:
                one._start_filling(one._sequence.accept(source, number, (source.key, number)))
    until(lambda: len(fetching) == MAX_OWNER_GAPS)
    go_on.set()
    until(lambda: len(delivered) == 4 * len(sources))
    assert max(most) == MAX_OWNER_GAPS
    assert one._sequence.missed == 0
    for source in sources:
        assert [number for key, number in delivered if key == source.key] == [0, 1, 2, 3]
