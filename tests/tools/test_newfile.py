"""New files: nothing is overwritten, nothing is found half written, and nothing is left behind."""

import errno
import os

import pytest
from buddyline.protocol.divelog import DiveLogReader
from buddyline.protocol.errors import BuddylineError
from buddyline.protocol.messages import Depth
from buddyline.tools.newfile import new_dive_log, new_file, new_folder, replace_text, write_new

from tests.disks import small_disk

DEPTH = Depth(node="a", stamp_ns=5, depth_m=3.0, sigma_m=0.1)


def test_a_file_gets_its_name_only_when_it_is_complete(tmp_path):
    with new_file(tmp_path / "a.txt") as part:
        part.write_text("half")
        assert not (tmp_path / "a.txt").exists()
    assert [(path.name, path.read_text()) for path in tmp_path.iterdir()] == [("a.txt", "half")]


def test_a_file_that_appears_meanwhile_is_kept(tmp_path):
    def write():
        with new_file(tmp_path / "a.txt") as part:
            part.write_text("ours")
            (tmp_path / "a.txt").write_text("theirs")

    with pytest.raises(BuddylineError, match="exists"):
        write()
    assert [(path.name, path.read_text()) for path in tmp_path.iterdir()] == [("a.txt", "theirs")]


def test_a_part_that_another_command_writes_is_kept(tmp_path):
    (tmp_path / "a.txt.part").write_text("theirs")
    with pytest.raises(BuddylineError, match=r"a\.txt\.part: exists; a command still writes it"):
        write_new(tmp_path / "a.txt", "ours")
    assert (tmp_path / "a.txt.part").read_text() == "theirs"


@pytest.mark.parametrize("taken", [False, True])
def test_a_file_system_without_hard_links_works(tmp_path, monkeypatch, taken):
    def refuse(*_):
        if taken:
            (tmp_path / "a.txt").write_text("theirs")
        raise OSError(errno.EPERM, "not permitted")

    monkeypatch.setattr(os, "link", refuse)
    if taken:
        with pytest.raises(BuddylineError, match="exists"):
            write_new(tmp_path / "a.txt", "ours")
    else:
        write_new(tmp_path / "a.txt", "ours")
    kept = "theirs" if taken else "ours"
    assert [(path.name, path.read_text()) for path in tmp_path.iterdir()] == [("a.txt", kept)]


def test_a_dangling_link_is_not_written_through(tmp_path):
    (tmp_path / "a.txt").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(BuddylineError, match="exists"):
        write_new(tmp_path / "a.txt", "ours")
    assert not (tmp_path / "elsewhere").exists()


def test_places_that_cannot_be_written_are_named(tmp_path):
    with pytest.raises(BuddylineError, match=r"none/a\.mcap: cannot be written: there is no folder .*none"):
        new_dive_log(tmp_path / "none" / "a.mcap").__enter__()
    (tmp_path / "file").touch()
    with pytest.raises(BuddylineError, match="file: exists and is no folder"):
        new_folder(tmp_path / "file")
    with pytest.raises(BuddylineError, match="cannot be made: Not a directory"):
        new_folder(tmp_path / "file" / "below")


def test_a_full_disk_leaves_no_log_of_half_a_dive(tmp_path):
    def write(path):
        with new_dive_log(path) as writer:
            for i in range(2000):
                writer.write("elsewhere", os.urandom(1000), i * 100_000_000)

    with small_disk(tmp_path / "disk", 64) as disk:
        with pytest.raises(BuddylineError, match=r"a\.mcap: cannot be written: No space left"):
            write(disk / "a.mcap")
        assert list(disk.iterdir()) == []


def test_a_disk_that_cannot_be_written_is_named(tmp_path):
    """As a memory card is that its system has mounted read-only after errors."""
    with (
        small_disk(tmp_path / "disk", 64, "ro") as disk,
        pytest.raises(BuddylineError, match=r"a\.txt: cannot be written: Read-only"),
    ):
        write_new(disk / "a.txt", "text")


def test_a_log_gets_its_name_only_when_it_is_complete(tmp_path):
    with new_dive_log(tmp_path / "a.mcap", {"command": "test"}) as writer:
        writer.write_message(DEPTH)
    with DiveLogReader(tmp_path / "a.mcap") as reader:
        assert [record.open().message for record in reader.records()] == [DEPTH]
        assert (reader.damage, reader.metadata()) == ([], {"command": "test"})


def test_a_name_that_is_not_utf_8_may_be_in_a_text_and_in_a_log_s_notes(tmp_path):
    name = os.fsdecode(b"caf\xe9.mcap")
    write_new(tmp_path / "text", f"of {name}")
    assert (tmp_path / "text").read_text() == "of caf?.mcap"
    with new_dive_log(tmp_path / name, {"repaired_from": name}) as writer:
        writer.write_message(DEPTH)
    with DiveLogReader(tmp_path / name) as reader:
        assert reader.metadata() == {"repaired_from": "caf?.mcap"}


def test_a_text_is_replaced_whole_or_not_at_all(tmp_path):
    with small_disk(tmp_path / "disk", 16) as disk:
        kept = disk / "hub.toml"
        kept.write_text("mine")
        (disk / "full").write_bytes(bytes(8 << 10))
        with pytest.raises(BuddylineError, match=r"hub\.toml: cannot be written: No space left"):
            replace_text(kept, "x" * 9000)
        assert kept.read_text() == "mine"
        assert {path.name for path in disk.iterdir()} == {"hub.toml", "full"}


@pytest.mark.parametrize("write", [new_folder, lambda path: write_new(path, "text")])
def test_a_dash_is_no_name(tmp_path, monkeypatch, write):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(BuddylineError, match="-: this does not go to standard output; name a file"):
        write("-")
    assert list(tmp_path.iterdir()) == []
