"""A disk that runs full, refuses, or comes back: the oldest pictures go, and no other message is lost."""

import contextlib
import errno
import os
import threading

import pytest
from buddyline.protocol import recorder as module
from buddyline.protocol.divelog import DiveLogReader, DiveLogWriter, read_logs
from buddyline.protocol.errors import BuddylineError
from buddyline.protocol.pictures import PictureLog, with_pictures
from buddyline.protocol.recorder import Recorder, RecordError
from buddyline.protocol.spool import Spool
from buddyline.tools.dives import Dive

from tests.disks import small_disk
from tests.processes import PATIENCE_S, until

MIB = 1024 * 1024
PICTURE = "buddyline/node/a/image"
DEPTH = "buddyline/node/a/depth"


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    monkeypatch.setattr(module, "SYNC_INTERVAL_S", 0.02)
    monkeypatch.setattr(module, "RETRY_S", 0.02)


class NumberedSender:
    """Numbers what it records: stamps are 1, 2, 3 ..."""

    def __init__(self, recorder):
        self.recorder = recorder
        self.count = 0
        self.depths = []

    def depth(self):
        self.count += 1
        self.depths.append(self.count)
        self.recorder.write(DEPTH, b'{"stamp_ns":%d}' % self.count, self.count)

    def picture(self, size=100_000):
        """A picture: bytes that do not compress."""
        self.count += 1
        payload = b'{"stamp_ns":%d,"data":"%s"}' % (self.count, os.urandom(size // 2).hex().encode())
        self.recorder.write(PICTURE, payload, self.count)


def fill(path):
    """Write until the disk is full."""
    with open(path, "wb", buffering=0) as file, contextlib.suppress(OSError):
        while True:
            file.write(bytes(4096))


def stamps(path, key):
    with DiveLogReader(path) as reader:
        return [r.log_time_ns for r in reader.records(lambda found: found == key)]


def recording(path, min_free_bytes=0):
    return Recorder(path, pictures=PictureLog(path, "a-*", min_free_bytes, metadata={"node": "a"}))


def test_pictures_are_in_files_beside_the_log_and_read_with_it(tmp_path):
    path = tmp_path / "a-1.mcap"
    with recording(path, min_free_bytes=MIB) as recorder:  # files of half a MiB
        sender = NumberedSender(recorder)
        for _ in range(12):
            sender.depth()
            sender.picture(150_000)
    files = with_pictures([path])
    assert files[0] == path
    assert len(files) > 2
    assert with_pictures(files[::-1]) == files[::-1]
    assert with_pictures([tmp_path]) == [tmp_path]
    assert stamps(path, PICTURE) == []
    with Dive([path]) as dive:
        found = [(r.key, r.log_time_ns) for r in read_logs(dive.readers)]
        assert dive.metadata()["node"] == "a"
    assert found == [(DEPTH if i % 2 else PICTURE, i) for i in range(1, 25)]


def test_only_this_nodes_pictures_are_deleted_the_oldest_first(tmp_path):
    with small_disk(tmp_path / "disk", 6 * 1024) as disk:
        for name in ("a-0.pictures", "b-0.pictures"):
            (disk / name).mkdir()
            (disk / name / "000000.mcap").write_bytes(os.urandom(MIB))
        path = disk / "a-1.mcap"
        with recording(path, min_free_bytes=MIB) as recorder:
            sender = NumberedSender(recorder)
            problems = []
            while recorder.pictures.deleted < 4:
                for _ in range(4):
                    sender.depth()
                    sender.picture()
                until(lambda: recorder.written == sender.count)
                problems.append(recorder.pictures.problem)
            assert recorder.error is None
            assert recorder.pictures.dropped == 0
            assert problems[0] == ""
            assert "oldest pictures were deleted" in problems[-1]
        assert not (disk / "a-0.pictures").exists()
        assert (disk / "b-0.pictures" / "000000.mcap").exists()
        assert stamps(path, DEPTH) == list(range(1, sender.count, 2))
        with Dive([path]) as dive:
            kept = [r.log_time_ns for r in read_logs(dive.readers, lambda key: key.endswith("/image"))]
            assert dive.losses == []
        assert kept == list(range(kept[0], sender.count + 1, 2))
        assert kept[0] > 2


def test_without_pictures_to_delete_no_more_are_recorded_until_there_is_room(tmp_path):
    with small_disk(tmp_path / "disk", 4 * 1024) as disk:
        ballast = disk / "ballast"
        ballast.write_bytes(bytes(3 * MIB + MIB // 2))
        path = disk / "a-1.mcap"
        with recording(path, min_free_bytes=MIB) as recorder:
            sender = NumberedSender(recorder)
            sender.depth()
            until(lambda: "no pictures are recorded" in recorder.pictures.problem)
            sender.picture()
            sender.depth()
            until(lambda: recorder.written == 3)
            assert recorder.pictures.dropped == 1
            ballast.unlink()
            until(lambda: recorder.pictures.problem == "")
            sender.picture()
        assert stamps(path, DEPTH) == [1, 3]
        with Dive([path]) as dive:
            assert [r.log_time_ns for r in read_logs(dive.readers, lambda key: key.endswith("/image"))] == [4]


def test_a_full_disk_is_named_and_nothing_is_lost_once_there_is_room(tmp_path, caplog):
    with small_disk(tmp_path / "disk", 1024) as disk:
        path = disk / "a-1.mcap"
        with recording(path) as recorder:
            sender = NumberedSender(recorder)
            sender.depth()
            until(lambda: path.stat().st_size > 0)
            ballast = disk / "ballast"
            fill(ballast)
            # Beyond the page that the log has already.
            while recorder.error is None:
                sender.depth()
                sender.picture(2000)
                until(lambda: recorder.error is not None or recorder._queued_bytes == 0)
            assert isinstance(recorder.error, RecordError)
            assert str(recorder.error) == f"{path}: No space left on device"
            for _ in range(1000):
                sender.depth()
            ballast.unlink()
            until(lambda: recorder.error is None)
        with DiveLogReader(path) as reader:
            assert reader.damage == []
            assert [r.log_time_ns for r in reader.records()] == sender.depths
    assert "tried again" in caplog.text


def test_a_disk_that_turns_read_only_is_named_and_its_end_is_an_error(tmp_path, monkeypatch):
    path = tmp_path / "a-1.mcap"
    recorder = recording(path)
    sender = NumberedSender(recorder)
    sender.depth()
    until(lambda: path.stat().st_size > 0 and stamps(path, DEPTH) == [1])
    plain = os.write

    def refuse(fd, data):
        raise OSError(errno.EROFS, "Read-only file system")

    monkeypatch.setattr("buddyline.protocol.spool.os.write", refuse)
    sender.depth()
    sender.picture(1000)
    until(lambda: recorder.error is not None)
    assert "Read-only file system" in str(recorder.error)
    with pytest.raises(RecordError, match=r"a-1\.mcap: its end is lost: Read-only"):
        recorder.close()
    monkeypatch.setattr("buddyline.protocol.spool.os.write", plain)
    assert stamps(path, DEPTH)[:1] == [1]


def test_a_disk_that_is_read_only_from_the_start_is_refused(tmp_path):
    with (
        small_disk(tmp_path / "disk", 64, "ro") as disk,
        pytest.raises(BuddylineError, match="Read-only file system"),
    ):
        recording(disk / "a-1.mcap")


def test_memory_is_bounded_and_pictures_are_dropped_before_messages(tmp_path, monkeypatch):
    monkeypatch.setattr(module, "MAX_QUEUED_BYTES", 20_000)
    monkeypatch.setattr(DiveLogWriter, "write", _refuse)
    recorder = recording(tmp_path / "a-1.mcap")
    sender = NumberedSender(recorder)
    sender.depth()
    until(lambda: recorder.error is not None)
    for _ in range(4):
        sender.picture(4000)
        sender.depth()
    sender.picture(15_000)
    assert recorder.dropped == 3
    until(lambda: [item[2] for item in recorder._messages] == sender.depths)
    with pytest.raises(RecordError):
        recorder.close()


def test_in_a_long_queue_the_oldest_is_dropped_without_a_search(tmp_path, monkeypatch):
    looked_at = []
    plain = module._is_picture

    def look(key):
        looked_at.append(key)
        return plain(key)

    with recording(tmp_path / "a-1.mcap") as recorder, recorder._ready:  # the writing thread waits meanwhile
        sender = NumberedSender(recorder)
        for _ in range(500):
            sender.depth()
        monkeypatch.setattr(module, "MAX_QUEUED_BYTES", recorder._queued_bytes)
        monkeypatch.setattr(module, "_is_picture", look)
        for _ in range(100):
            sender.depth()
        assert recorder.dropped >= 100
        assert len(looked_at) == 100


def test_a_log_that_is_deleted_while_it_is_written_is_an_error(tmp_path):
    path = tmp_path / "a-1.mcap"
    recorder = recording(path)
    sender = NumberedSender(recorder)
    sender.depth()
    until(lambda: path.stat().st_size > 0 and stamps(path, DEPTH) == [1])
    path.unlink()
    until(lambda: recorder.ended)
    with pytest.raises(RecordError, match=r"a-1\.mcap: was removed while it was written, .*; start again"):
        recorder.close()


def test_a_log_that_is_renamed_while_it_is_written_is_whole(tmp_path):
    path, renamed = tmp_path / "a-1.mcap", tmp_path / "kept.mcap"
    with recording(path) as recorder:
        sender = NumberedSender(recorder)
        sender.depth()
        until(lambda: path.stat().st_size > 0 and stamps(path, DEPTH) == [1])
        path.rename(renamed)
        sender.depth()
    assert stamps(renamed, DEPTH) == [1, 2]


def test_what_is_being_written_counts_among_what_waits(tmp_path, monkeypatch):
    monkeypatch.setattr(module, "MAX_QUEUED_BYTES", 20_000)
    begun, go_on = threading.Event(), threading.Event()

    def stand(*_args, **_kwargs):
        begun.set()
        assert go_on.wait(PATIENCE_S)

    monkeypatch.setattr(PictureLog, "write", stand)
    with recording(tmp_path / "a-1.mcap") as recorder:
        sender = NumberedSender(recorder)
        sender.picture(9000)
        assert begun.wait(PATIENCE_S)
        for _ in range(4):
            sender.picture(9000)
        held, dropped = recorder._queued_bytes, recorder.dropped
        go_on.set()
    assert held <= 20_000
    assert dropped >= 3


def _refuse(*_args, **_kwargs):
    raise OSError(errno.EIO, "Input/output error")


def test_a_spool_continues_a_partial_write(tmp_path, monkeypatch):
    plain = os.write
    allowed = [3]

    def short(fd, data):
        if allowed[0] == 0:
            raise OSError(errno.ENOSPC, "No space left on device")
        done = plain(fd, data[: allowed[0]])
        allowed[0] -= done
        return done

    monkeypatch.setattr("buddyline.protocol.spool.os.write", short)
    spool = Spool(tmp_path / "file")
    spool.write(b"hello ")
    for word in (b"wide ", b"world"):
        with pytest.raises(OSError, match="No space"):
            spool.flush()
        assert spool.stuck
        spool.write(word)
    assert (tmp_path / "file").read_bytes() == b"hel"
    allowed[0] = 100
    spool.flush()
    assert not spool.stuck
    assert spool.tell() == 16
    spool.close()
    assert (tmp_path / "file").read_bytes() == b"hello wide world"
