"""The project file and the commands: hand-written text stays, the derived part is written again."""

import argparse
import csv
import json
import os
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from buddyline.protocol.codec import decode
from buddyline.protocol.config import ConfigError
from buddyline.protocol.divelog import DiveLogWriter
from buddyline.protocol.envelope import Refusals
from buddyline.protocol.errors import BuddylineError
from buddyline.protocol.local_bus import LocalNetwork
from buddyline.protocol.messages import Depth, Imu, Mark, NodeInfo, Rejected, RelativePose
from buddyline.protocol.topics import INFO, MARK, key_of, parse_key
from buddyline.tools.survey import command, mark
from buddyline.tools.survey.live import Watch
from buddyline.tools.survey.marks import of_table, section_of
from buddyline.tools.survey.old.model import CrossSection
from buddyline.tools.survey.project import MARKER, Station, load_project
from msgspec.structs import replace

from tests.processes import PATIENCE_S
from tests.tools import survey_world as world

COURSE = world.line(np.random.default_rng(2), 3)


@pytest.fixture(scope="module")
def messages():
    return world.dive(COURSE, np.random.default_rng(7), rest_s=9.0, swim_s=1.0)


@pytest.fixture
def logs(tmp_path, messages):
    """Return a solved log and a node's own, as names; the IMU and a mark are in the node's alone."""
    with DiveLogWriter(tmp_path / "solved.mcap") as writer:
        for message in messages:
            if not isinstance(message, Imu):
                writer.write_message(message)
    with DiveLogWriter(tmp_path / "a.mcap") as writer:
        for message in messages:
            if isinstance(message, Imu):
                writer.write_message(message)
        writer.write_message(Mark(node="a", stamp_ns=world.START_NS + 6 * 10**9, name="entry", note="chain"))
    return [str(tmp_path / name) for name in ("a.mcap", "solved.mcap")]


def run(*words):
    parser = argparse.ArgumentParser()
    command.add_arguments(parser)
    return command.run(parser.parse_args([str(word) for word in words]))


def test_a_project_from_dive_to_exports(tmp_path, logs, capsys):
    path = tmp_path / "cave.toml"
    assert run("legs", path, "--dive", *logs) == 0
    project = load_project(path)
    assert project.leg[0].from_ == "entry"
    assert [leg.to for leg in project.leg][:-1] == [leg.from_ for leg in project.leg][1:]
    assert project.station[0].notes == ["chain"]
    assert all(leg.field_from_ut for leg in project.leg)
    assert run("adjust", path) == 0
    assert "3 legs" in capsys.readouterr().out
    assert run("adjust", path, "--json") == 0
    answer = json.loads(capsys.readouterr().out)
    assert len(answer["stations"]) == 4
    path.write_text(path.read_text().replace("# latitude_deg = 45.5\n# longitude", "latitude_deg = 45.5\nlongitude", 1))
    path.write_text(path.read_text().replace("[place]", "[place]\ndeclination_deg = 3.5", 1))
    for kind in command.FORMATS:
        assert run("export", path, "--format", kind, "-o", tmp_path / f"out.{kind}") == 0
        assert (tmp_path / f"out.{kind}").stat().st_size > 80
    assert run("report", path) == 0
    assert "<svg" in (tmp_path / "cave.html").read_text()


@pytest.mark.parametrize("words", [["report"], ["export", "--format", "svx"]])
@pytest.mark.parametrize("project", ["/dev/stdin", "/dev/fd/0", "/proc/self/fd/0"])
def test_beside_standard_input_nothing_is_written(words, project):
    with pytest.raises(BuddylineError, match="name it with -o"):
        run(words[0], project, *words[1:])


@pytest.mark.parametrize("words", [["report"], ["export", "--format", "svx"], ["export", "--format", "pdf"]])
def test_exports_and_reports_refuse_to_overwrite(tmp_path, logs, words):
    path = tmp_path / "cave.toml"
    run("legs", path, "--dive", *logs)
    for precious in (tmp_path / "solved.mcap", path):
        before = precious.read_bytes()
        with pytest.raises(BuddylineError, match=f"{precious.name}: exists"):
            run(words[0], path, *words[1:], "-o", precious)
        assert precious.read_bytes() == before


def test_a_project_in_a_linked_folder_finds_its_logs(tmp_path, logs, monkeypatch):
    (tmp_path / "disk" / "below").mkdir(parents=True)
    (tmp_path / "surveys").symlink_to(tmp_path / "disk" / "below")
    monkeypatch.chdir(tmp_path)
    path = Path("surveys") / "cave.toml"
    assert run("legs", path, "--dive", "a.mcap", "solved.mcap") == 0
    assert run("legs", path) == 0
    assert load_project(path).dive[0].logs == ["../../a.mcap", "../../solved.mcap"]
    (tmp_path / "old.csv").write_text("from,to,length,azimuth,clino,date\n1,2,5,90,0,2020-01-01\n")
    assert run("import", path, "old.csv") == 0
    assert run("adjust", path) in (0, 1)


def test_logs_that_cannot_be_read_begin_no_project(tmp_path, logs):
    path = tmp_path / "cave.toml"
    for wrong in ("none.mcap", logs[0]):
        with pytest.raises(BuddylineError, match=r"cannot be read|holds no poses"):
            run("legs", path, "--dive", wrong)
        assert not path.exists()
    assert run("legs", path, "--dive", *logs) == 0


def test_line_ends_links_and_permissions_of_a_project_stay(tmp_path, logs):
    path, link = tmp_path / "cave.toml", tmp_path / "linked.toml"
    run("legs", path, "--dive", *logs)
    # An editor of Windows: its line ends, and a byte order mark.
    text = "\ufeff" + path.read_text().replace("[place]", '[place]\ndeclination_source = "ça"')
    path.write_bytes(text.replace("\n", "\r\n").encode())
    path.chmod(0o640)
    link.symlink_to(path.name)
    before = path.read_bytes().split(MARKER.encode())[0]
    path.write_bytes(before)
    assert run("legs", link) == 0
    assert link.is_symlink()
    assert path.stat().st_mode & 0o777 == 0o640
    after = path.read_bytes()
    assert after.startswith(before)
    assert after.count(b"\n") == after.count(b"\r\n")
    assert len(load_project(path).leg) == 3
    assert sorted(file.name for file in tmp_path.glob("*.toml*")) == ["cave.toml", "linked.toml"]


def test_hand_written_text_stays_and_the_old_file_is_kept(tmp_path, logs):
    path = tmp_path / "cave.toml"
    run("legs", path, "--dive", *logs)
    first = path.read_text()
    run("legs", path)
    assert path.read_text() == first
    assert not list(tmp_path.glob("cave.toml.*"))
    edited = first.replace('title = ""', 'title = "Ours"  # with a comment', 1)
    edited = edited.replace(
        MARKER, f'[settings]\nrange_share = 0.02\n\n[[edit]]\nleg = "entry-1"\nuse = false\n\n{MARKER}'
    )
    edited = edited.replace("entry-1", load_project(path).leg[0].name)
    path.write_text(edited)
    run("legs", path)
    assert (tmp_path / "cave.toml.1").read_text() == edited
    again = path.read_text()
    assert again.split(MARKER)[0].rstrip() == edited.split(MARKER)[0].rstrip()
    before = {leg.name: leg for leg in load_project(tmp_path / "cave.toml.1").leg}
    for leg in load_project(path).leg:
        assert leg.distance_m == before[leg.name].distance_m
        assert leg.distance_sigma_m > before[leg.name].distance_sigma_m
    # The others go on without the leg that was taken out.
    assert run("adjust", path) == 0


@pytest.mark.parametrize(
    "change", ['[[equate]]\nstations = ["entry", "2"]\n', '[[mark]]\nnode = "b"\nseconds = 30.0\nname = "TIP"\n']
)
def test_what_legs_has_not_taken_in_yet_is_said(tmp_path, logs, capsys, change):
    path = tmp_path / "cave.toml"
    run("legs", path, "--dive", *logs)
    assert run("adjust", path) == 0
    path.write_text(path.read_text().replace(MARKER, f"{change}\n{MARKER}"))
    said = "dives, marks or equates have changed since `buddyline survey legs` made its legs: run it again"
    for words in (["adjust", path], ["export", path, "--format", "csv"]):
        capsys.readouterr()
        assert run(*words) == 1
        assert said in capsys.readouterr().err
    run("legs", path)
    capsys.readouterr()
    run("adjust", path)
    assert not capsys.readouterr().err


def test_depth_by_option_leaves_the_other_settings_of_the_adjustment(tmp_path, logs, capsys):
    path = tmp_path / "cave.toml"
    run("legs", path, "--dive", *logs)
    path.write_text(path.read_text().replace(MARKER, f'[adjust]\ndatum = "free"\n\n{MARKER}'))
    for words in ([], ["--depth", "readings"], ["--depth", "absolute"]):
        capsys.readouterr()
        assert run("adjust", path, "--json", *words) == 0
        stations = json.loads(capsys.readouterr().out)["stations"]
        assert stations["entry"]["ellipse"][0] > 0.02


def test_a_station_that_is_fixed_twice_is_refused(tmp_path, logs):
    path = tmp_path / "cave.toml"
    run("legs", path, "--dive", *logs)
    fixes = "".join(f'[[fix]]\nstation = "entry"\neast_m = {east}\nnorth_m = 0\n' for east in (0, 100))
    path.write_text(path.read_text().replace(MARKER, f"{fixes}\n{MARKER}"))
    with pytest.raises(ConfigError, match="fix of 'entry': is stated twice"):
        run("adjust", path)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ('[[fix]]\nstation = "gone"\neast_m = 0\nnorth_m = 0', "fix of 'gone': no leg has this station"),
        ('[[known]]\nfrom = "entry"\nto = "gone"\ndistance_m = 1', "known line entry-gone: no leg has station gone"),
        ('[[known]]\nfrom = "entry"\nto = "entry"\ndistance_m = 1', "known line entry-entry: both ends"),
        ('[adjust]\ncompass = "ignore"', "adjust.compass"),
        ('[[equate]]\nstations = ["entry", "gone"]', "equate of 'gone': no leg has this station"),
    ],
)
def test_errors_in_fixed_points_and_known_lines_name_the_file(tmp_path, logs, text, said):
    path = tmp_path / "cave.toml"
    run("legs", path, "--dive", *logs)
    path.write_text(path.read_text().replace(MARKER, f"{text}\n{MARKER}"))
    with pytest.raises(ConfigError) as raised:
        run("legs" if "equate" in text else "adjust", path)
    assert str(raised.value).startswith(f"{path}: {said}")


def test_a_better_calibration_updates_the_survey(tmp_path, logs, messages):
    path = tmp_path / "cave.toml"
    run("legs", path, "--dive", *logs)
    before = load_project(path)
    with DiveLogWriter(tmp_path / "again.mcap") as writer:
        for message in messages:
            if isinstance(message, RelativePose):
                x, y, z = message.t_a_b_m
                writer.write_message(replace(message, t_a_b_m=(1.01 * x, 1.01 * y, 1.01 * z)))
            elif isinstance(message, NodeInfo):
                writer.write_message(replace(message, sigma_px=0.5))
            elif not isinstance(message, Imu):
                writer.write_message(message)
    path.write_text(path.read_text().replace("solved.mcap", "again.mcap"))
    run("legs", path)
    for old, new in zip(before.leg, load_project(path).leg, strict=True):
        assert new.name == old.name
        assert new.distance_m == pytest.approx(1.01 * old.distance_m, rel=1e-3)


def test_marks_from_a_table_and_from_the_project(tmp_path, logs):
    path = tmp_path / "cave.toml"
    run("legs", path, "--dive", *logs)
    last = load_project(path).leg[-1]
    start = load_project(path).leg[0]
    table = tmp_path / "times.csv"
    with open(table, "w", newline="") as file:
        rows = csv.writer(file)
        rows.writerow(["time", "node", "name", "note"])
        rows.writerow([last.moment.isoformat(), last.to_node, "END", "blue arrow"])
    run("legs", path, "--marks", table)
    assert load_project(path).leg[-1].to == "END"
    seconds = (last.start_ns - start.start_ns) / 1e9 + 4
    by_hand = f'[[mark]]\nnode = "{last.to_node}"\nseconds = {seconds}\nname = "TIP"\n\n{MARKER}'
    path.write_text(path.read_text().replace(MARKER, by_hand))
    run("legs", path)
    assert load_project(path).leg[-1].to == "TIP"
    # A spreadsheet where a comma is the decimal point: semicolons, and a mark at its beginning.
    table.write_text(f"\ufefftime;node;name;note\n{seconds:.1f};{last.to_node};TAIL;".replace(".", ","))
    run("legs", path, "--marks", table)
    path.write_text(path.read_text().replace(by_hand, by_hand.replace(f'"{last.to_node}"', '"q"')))
    assert run("legs", path, "--marks", table) == 1
    assert load_project(path).leg[-1].to == "TAIL"
    assert any("node q is in no pair" in problem.text for problem in load_project(path).problem)
    table.write_text("time,node,name\nyesterday,a,X\n")
    with pytest.raises(ConfigError, match="line 2"):
        run("legs", path, "--marks", table)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("time,node\nnan,a\n", "line 2: time 'nan': not a finite number"),
        ("time,node\n1e30,a\n", "line 2: .*seconds"),
        ("time,node\n9999-12-31T23:59:59-10:00,a\n", "line 2: time 9999.*1970 to 2261"),
        ("time,node\nnoon,a\n", "line 2: time 'noon': neither as"),
        ("time,node,dive\n1,a,2\n", "line 2: dive = 2: the project has 1"),
        ("when,who\n1,a\n", "line 1: no column time and node; columns: time, node, name, kind, note, dive"),
        ("", "line 1: no column time and node"),
    ],
)
def test_a_bad_table_of_marks_is_refused_and_named(tmp_path, text, said):
    path = tmp_path / "times.csv"
    path.write_text(text)
    with pytest.raises(ConfigError, match=said):
        of_table(path, 1)


def test_a_table_of_marks_may_be_of_several_dives_and_have_blanks_in_its_head(tmp_path):
    path = tmp_path / "times.csv"
    path.write_text("Time, Node, Name, Dive\n1.5, a, X, 2\n2.5, b, Y,\n")
    assert [(mark.seconds, mark.node, mark.name, mark.dive) for mark in of_table(path, 2)] == [
        (1.5, "a", "X", 2),
        (2.5, "b", "Y", 1),
    ]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[survey]\nnmae = 'x'\n", "did you mean `name`"),
        ("[[fix]]\nstation = '0'\neast_m = 1.0\n", "east_m and north_m"),
        ("[settings]\nrest_s = -1.0\n", "rest_s"),
        ("[[leg]]\n", "leg"),
        ("[place]\nutm_zone = 'abc'\n", "utm_zone"),
        ("[place]\nlatitude_deg = 45.0\n", "give both latitude_deg and longitude_deg"),
        ("[[fix]]\nstation = '0'\neast_m = 1.0\nnorth_m = 1.0\nlatitude_deg = 45.0\n", "east_m and north_m"),
        ("[[fix]]\nstation = '0'\nlatitude_deg = 945.0\nlongitude_deg = 9.0\n", r"fix\[0\].latitude_deg = 945.0"),
        ("[[mark]]\nnode = 'a'\nname = 'X'\n", "bad.toml: mark 'X' of node a: give time or seconds"),
        ("[[mark]]\nnode = 'a'\nname = 'X'\nseconds = 1.0\ntime = 2026-05-01T10:00:00Z\n", "and not both"),
        ("[[mark]]\nnode = 'a'\nname = 'X'\nseconds = 1.0\ndive = 2\n", r"dive = 2: the project has 0 \[\[dive\]\]"),
        ("[[mark]]\nnode = 'a'\nseconds = 1e30\n", r"mark\[0\].seconds = 1e\+30"),
    ],
)
def test_a_bad_project_is_refused_and_named(tmp_path, text, said):
    path = tmp_path / "bad.toml"
    path.write_text(text)
    with pytest.raises(ConfigError, match=said):
        load_project(path)


def test_known_errors_are_reported(tmp_path, logs):
    path = tmp_path / "cave.toml"
    run("legs", path, "--dive", *logs)
    with pytest.raises(BuddylineError, match="exists"):
        run("legs", path, "--dive", *logs)
    path.write_text(path.read_text().replace(MARKER, f'[[edit]]\nleg = "7-8"\nuse = false\n\n{MARKER}'))
    with pytest.raises(ConfigError, match="no such leg"):
        run("adjust", path)
    latin = os.fsdecode(os.fsencode(tmp_path) + b"/caf\xe9.mcap")
    Path(latin).write_bytes(Path(logs[1]).read_bytes())
    with pytest.raises(BuddylineError, match=r"not UTF-8 text, .* rename the file"):
        run("legs", tmp_path / "latin.toml", "--dive", latin)
    assert not (tmp_path / "latin.toml").exists()
    empty = tmp_path / "empty.toml"
    empty.write_text("[survey]\n")
    with pytest.raises(BuddylineError, match="names no dive"):
        run("legs", empty)
    with pytest.raises(BuddylineError, match="no poses"):
        run("legs", tmp_path / "new.toml", "--dive", logs[0])


def test_notes_may_contain_any_character(tmp_path, logs, messages):
    path = tmp_path / "cave.toml"
    note = 'a "quoted" \\ note\nof two lines\t\x07é'
    with DiveLogWriter(tmp_path / "m.mcap") as writer:
        writer.write_message(Mark(node="a", stamp_ns=world.START_NS + 6 * 10**9, name="entry", note=note))
    run("legs", path, "--dive", *logs, tmp_path / "m.mcap")
    assert note in load_project(path).station[0].notes


@pytest.mark.parametrize("form", ["svx", "th"])
def test_texts_of_several_lines_are_no_lines_of_data_in_other_programs_files(tmp_path, logs, form):
    path, note = tmp_path / "cave.toml", "of two\nlines"
    run("legs", path, "--dive", *logs)
    text = path.read_text().replace('title = ""', 'title = "Lake\\n*fix 9 1 2 3"')
    text = text.replace("team = []", 'team = ["A\\rB"]')
    edit = '[[edit]]\nleg = "1-2"\nuse = false\nnote = """moved\n*require 9"""\n'
    path.write_text(text.replace(MARKER, edit + MARKER).replace('name = "1"', f'name = "1"\nnotes = ["{note!r}"]', 1))
    out = tmp_path / f"out.{form}"
    assert run("export", path, "--format", form, "-o", out) == 0
    lines = [line.strip() for line in out.read_text().splitlines()]
    assert not [line for line in lines if line.startswith(("*fix 9", "*require", "lines", "B"))]


def mark_arguments(*words):
    parser = argparse.ArgumentParser()
    mark.add_arguments(parser)
    return parser.parse_args(words)


def test_a_mark_by_command():
    said = mark.mark_of(mark_arguments("T1", "--node", "a", "--note", "x"), 5)
    assert said == Mark(node="a", stamp_ns=5, name="T1", note="x")
    later = mark.mark_of(mark_arguments("T1", "--node", "a", "--at", "2026-05-01T10:00:00Z"), 5)
    assert later.stamp_ns == world.START_NS
    assert parse_key(key_of(said))[0] is MARK
    far = ("T1", "--node", "a", "--at", "1e30"), ("T1", "--node", "a", "--at", "0900-01-01")
    for words in (("T 1", "--node", "a"), ("--node", "a", "--kind", "note"), ("T1", "--node", "A"), *far):
        with pytest.raises(BuddylineError):
            mark.mark_of(mark_arguments(*words), 5)


def test_a_cross_section_goes_with_the_mark_of_its_station():
    said = mark.mark_of(mark_arguments("T1", "--node", "a", "--lrud", "1.2", "-", "2", "0.5", "--note", "silt"), 5)
    assert said.note == "LRUD 1.2 - 2 0.5 silt"
    assert section_of(Station(name="T1", notes=["muddy", said.note])) == CrossSection("T1", 1.2, None, 2.0, 0.5)
    assert section_of(Station(name="T1", notes=["muddy"])) is None
    with pytest.raises(BuddylineError, match="--lrud: right: 'wide' is neither a length in metres nor -"):
        mark.mark_of(mark_arguments("T1", "--node", "a", "--lrud", "1", "wide", "1", "1"), 5)
    with pytest.raises(BuddylineError, match="--lrud is of a station, not of a point"):
        mark.mark_of(mark_arguments("T1", "--node", "a", "--kind", "point", "--lrud", "1", "1", "1", "1"), 5)
    with pytest.raises(BuddylineError, match="station 'T1': note 'LRUD 1 2': LRUD and four lengths"):
        section_of(Station(name="T1", notes=["LRUD 1 2"]))


def test_live_alarms_are_published_on_the_bus(messages):
    network = LocalNetwork()
    heard, came = [], threading.Event()

    def hear(received):
        heard.append(decode(received.payload, Mark))
        if heard[-1].name == "depth":
            came.set()

    with network.connect() as nodes, network.connect() as topside, network.connect() as listener:
        listener.subscribe(MARK.key_any(), hear)
        watch = Watch(topside, Refusals("test"))
        watch.attach()
        publishers = {}
        infos = [message for message in messages if isinstance(message, NodeInfo)]
        for info in infos:
            nodes.publisher(INFO, info.node).put(info)
        # Calibrations come by a subscription of their own: a leg is judged once both are there.
        while len(watch._legs._infos) < len({info.node for info in infos}):
            time.sleep(0.01)
        for message in messages:
            parsed = parse_key(key_of(message)) if not isinstance(message, Rejected) else None
            if parsed is None or parsed[0].name not in ("attitude", "depth", "imu", "pose"):
                continue
            topic, ids = parsed
            if (topic, ids) not in publishers:
                publishers[topic, ids] = nodes.publisher(topic, *ids)
            off = isinstance(message, Depth) and message.node == "b"
            publishers[topic, ids].put(replace(message, depth_m=message.depth_m + 3.0) if off else message)
        assert came.wait(PATIENCE_S), [one.note for one in heard]
    assert "alarm" in {one.kind for one in heard} <= {"alarm", "leg"}
