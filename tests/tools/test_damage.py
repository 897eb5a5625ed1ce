"""Every command that reads dives: what can be read is used, what cannot is named, and the exit status says so."""

import json
from pathlib import Path

import pytest
from buddyline.protocol.divelog import DiveLogReader, DiveLogWriter
from buddyline.protocol.local_bus import LocalNetwork
from buddyline.protocol.messages import ClockBeacon
from buddyline.tools import live
from buddyline.tools.cli import main

SECONDS = 6


@pytest.fixture(scope="module")
def dives(tmp_path_factory):
    """A solved dive, and one of small pictures with tags, each in chunks of a second."""
    folder = tmp_path_factory.mktemp("dives")
    words = ["--seconds", str(SECONDS), "--imu", "--seed", "3", "--undisturbed"]
    assert main(["simulate", str(folder / "dive.mcap"), *words]) == 0
    assert main(["solve", str(folder / "dive.mcap"), "-o", str(folder / "without_clocks.mcap")]) == 0
    with DiveLogReader(folder / "without_clocks.mcap") as reader, DiveLogWriter(folder / "solved.mcap") as writer:
        for record in reader.records():
            writer.write(record.key, record.payload, record.log_time_ns)
            if record.key.endswith("/candidates"):
                writer.write_message(ClockBeacon(node="a", stamp_ns=record.log_time_ns, boot="x", heard=[]))
    words = ["--seconds", "4", "--rate", "2", "--images", "--tags", "--width", "410", "--imu", "--range-max", "3"]
    assert main(["simulate", str(folder / "pictures.mcap"), *words]) == 0
    return folder


def corrupted(whole: bytes) -> bytes:
    middle = len(whole) // 2
    return whole[:middle] + bytes(byte ^ 0xFF for byte in whole[middle : middle + 200]) + whole[middle + 200 :]


DAMAGES = {
    "corrupted": corrupted,
    "cut": lambda whole: whole[: len(whole) * 6 // 10],
    "empty": lambda whole: b"",
    "foreign": lambda whole: b"\x89PNG\r\n\x1a\n" + whole[8:],
}

# What each command makes of IN (a dive of candidates that is solved) or PICTURES; OUT is a new file.
COMMANDS = {
    "solve": ["solve", "IN", "-o", "OUT.mcap"],
    "solve, pictures": ["solve", "PICTURES", "-o", "OUT.mcap"],
    "after": ["after", "IN", "-o", "OUT"],
    "align": ["align", "IN"],
    "evaluate": ["evaluate", "IN", "--json"],
    "evaluate, truth": ["evaluate", "WHOLE", "--truth", "IN", "--json"],
    "report": ["report", "IN", "-o", "OUT.html"],
    "view": ["view", "IN", "--seconds", "0.3", "--port", "0"],
    "export tum": ["export", "IN", "--format", "tum"],
    "export csv": ["export", "IN", "--format", "csv", "-o", "OUT.csv"],
    "export foxglove": ["export", "IN", "--format", "foxglove", "-o", "OUT.mcap"],
    "detect": ["detect", "PICTURES", "-o", "OUT.mcap"],
    "detect, lines": ["detect", "PICTURES"],
    "tune": ["tune", "PICTURES", "--pictures", "3", "--draw", "OUT"],
    "artag": ["artag", "PICTURES", "-o", "OUT.mcap"],
    "play": ["play", "IN", "--speed", "0"],
    "repair": ["repair", "IN", "-o", "OUT.mcap"],
    "backfill": ["backfill", "IN", "COPY", "-o", "OUT.mcap"],
    "survey legs": ["survey", "legs", "OUT.toml", "--dive", "IN"],
    "calibrate lights": ["calibrate", "lights", "IN", "--tape", "0", "60", "3"],
    "calibrate magnetometer": ["calibrate", "magnetometer", "IN", "--node", "a"],
    "calibrate clock": ["calibrate", "clock", "IN"],
    "calibrate camera": ["calibrate", "camera", "PICTURES", "--node", "a"],
}
# A few seconds without a rest are too short for these commands: they name what is missing, and the losses.
NOT_ENOUGH = (
    "align",
    "survey legs",
    "calibrate lights",
    "calibrate magnetometer",
    "calibrate clock",
    "calibrate camera",
)
NEEDS = {"view": "websockets", "export foxglove": "foxglove", "artag": "pupil_apriltags"}


@pytest.fixture
def run(dives, tmp_path, capsys, monkeypatch):
    """Run a command with its dives damaged; return its status, what it said on stderr, and its output."""
    network = LocalNetwork()
    monkeypatch.setattr(live, "open_bus", lambda *_: network.connect())

    def call(name, damage):
        pytest.importorskip(NEEDS.get(name, "buddyline"))
        words = []
        for word in COMMANDS[name]:
            if word in ("IN", "COPY", "PICTURES"):
                source = dives / ("pictures.mcap" if word == "PICTURES" else "solved.mcap")
                target = tmp_path / f"{word.lower()}.mcap"
                target.write_bytes(DAMAGES[damage](source.read_bytes()) if damage else source.read_bytes())
                words.append(str(target))
            elif word == "WHOLE":
                words.append(str(dives / "solved.mcap"))
            else:
                words.append(str(tmp_path / word) if word.startswith("OUT") else word)
        capsys.readouterr()
        status = main(words)
        out, err = capsys.readouterr()
        return status, err, out

    return call


# With a gap in it the same dive takes some commands many times as long.
LONG = ("after", "corrupted"), ("solve", "corrupted")


@pytest.mark.parametrize(
    ("name", "damage"),
    [
        pytest.param(name, damage, marks=pytest.mark.slow if (name, damage) in LONG else ())
        for name in COMMANDS
        for damage in DAMAGES
    ],
)
def test_damage_is_named_and_what_is_left_is_used(run, name, damage, tmp_path):
    status, err, _ = run(name, damage)
    assert "Traceback" not in err
    path = tmp_path / ("pictures.mcap" if "PICTURES" in COMMANDS[name] else "in.mcap")
    if name == "repair" and damage in ("corrupted", "foreign"):
        # The head of a log, or 200 bytes of it, are what its parity restores.
        assert status == 0
        assert "restored from the parity" in err
        assert "nothing of it is lost" in err
        return
    if damage in ("empty", "foreign"):
        assert status == 2
        assert f"{path}: is " in err
        assert not list(tmp_path.glob("OUT.[!t]*"))
        return
    assert status in ((1, 2) if name in NOT_ENOUGH else (1,))
    lines = [line for line in err.splitlines() if line.startswith(f"buddyline {COMMANDS[name][0]}: {path}: ")]
    assert any("byte" in line for line in lines)
    if damage == "corrupted":
        assert any("lost" in line for line in lines)


@pytest.mark.parametrize("name", [name for name in COMMANDS if name not in NOT_ENOUGH])
def test_undamaged_dives_report_no_losses(run, name):
    status, err, _ = run(name, None)
    assert (status, [line for line in err.splitlines() if line.startswith("buddyline ")]) == (0, [])


def test_200_bytes_inverted_cost_an_export_a_second(run):
    whole, damaged = (len(run("export tum", damage)[2].splitlines()) for damage in (None, "corrupted"))
    assert whole > 200
    assert 0 < whole - damaged <= 101  # 50 rows a second; the bytes may lie across two chunks


def split_by_node(source: Path, folder: Path) -> list[str]:
    with DiveLogReader(source) as reader:
        for node in "ab":
            with DiveLogWriter(folder / f"{node}.mcap") as writer:
                for record in reader.records(lambda key, own=f"buddyline/node/{node}/": key.startswith(own)):
                    writer.write(record.key, record.payload, record.log_time_ns)
    return [str(folder / "a.mcap"), str(folder / "b.mcap")]


def test_an_empty_log_among_others_is_left_out_and_named(dives, tmp_path, capsys):
    logs = split_by_node(dives / "dive.mcap", tmp_path)
    empty = tmp_path / "a-2.mcap"
    empty.touch()
    assert main(["solve", logs[0], str(empty), logs[1], "-o", str(tmp_path / "solved.mcap"), "--json"]) == 1
    out, err = capsys.readouterr()
    assert json.loads(out)["solved"] > 30
    assert f"{empty}: is empty (0 bytes)" in err
    for words in (
        ["backfill", *logs, str(empty)],
        ["backfill", str(empty), *logs],
        ["export", "--format", "tum", str(empty), str(tmp_path / "solved.mcap")],
        ["evaluate", str(tmp_path / "solved.mcap"), str(empty), "--truth", str(dives / "dive.mcap")],
        ["report", str(tmp_path / "solved.mcap"), str(empty)],
    ):
        target = [] if words[0] == "evaluate" else ["-o", str(tmp_path / f"out.{len(list(tmp_path.iterdir()))}")]
        assert main([*words, *target]) == 1, words
        assert f"{empty}: is empty (0 bytes)" in capsys.readouterr().err


@pytest.mark.parametrize(
    "name", ["solve", "solve, pictures", "detect", "artag", "repair", "backfill", "simulate", "export foxglove"]
)
def test_an_interrupted_command_leaves_nothing_under_the_wanted_name(run, name, tmp_path, monkeypatch):
    monkeypatch.setitem(COMMANDS, "simulate", ["simulate", "OUT.mcap", "--seconds", "2"])
    written = []

    def interrupted(self, *args, **kwargs):
        written.append(args)
        if len(written) > 20:
            raise KeyboardInterrupt
        return write(self, *args, **kwargs)

    from mcap.writer import Writer

    write = Writer.add_message
    monkeypatch.setattr(Writer, "add_message", interrupted)
    status, _, _ = run(name, None)
    assert (status, len(written)) == (130, 21)
    assert not list(tmp_path.glob("OUT*"))


@pytest.mark.parametrize("command", ["detect", "tune"])
def test_marked_pictures_replace_no_file(dives, tmp_path, capsys, command):
    originals = tmp_path / "photos"
    assert main(["detect", str(dives / "pictures.mcap"), "--draw", str(originals)]) == 0
    before = {path: path.read_bytes() for path in originals.iterdir()}
    assert main([command, str(originals), "--draw", str(originals)]) == 2
    assert f"{originals}: is not empty" in capsys.readouterr().err
    assert {path: path.read_bytes() for path in originals.iterdir()} == before


def test_two_pictures_of_the_same_name_are_both_marked(dives, tmp_path, capsys):
    for name in ("one", "two"):
        assert main(["detect", str(dives / "pictures.mcap"), "--draw", str(tmp_path / name)]) == 0
    assert main(["detect", str(tmp_path / "one"), str(tmp_path / "two"), "--draw", str(tmp_path / "marked")]) == 0
    count = len(list((tmp_path / "one").iterdir()))
    assert len(list((tmp_path / "marked").iterdir())) == 2 * count


@pytest.mark.parametrize("name", [name for name, words in COMMANDS.items() if "-o" in words])
def test_no_output_replaces_an_existing_file(run, name, tmp_path):
    target = tmp_path / next(word for word in COMMANDS[name] if word.startswith("OUT"))
    target.write_bytes(b"precious")
    status, err, _ = run(name, None)
    assert (status, target.read_bytes()) == (2, b"precious")
    assert f"{target}: exists" in err
    assert not list(tmp_path.glob("*.part"))
