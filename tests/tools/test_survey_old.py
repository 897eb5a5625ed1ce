"""Old surveys: adjusted with new legs, and written again, against the programs that made them."""

import argparse
import csv
import io
import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from buddyline.protocol.errors import BuddylineError
from buddyline.tools.survey import command, survex
from buddyline.tools.survey.network import adjust
from buddyline.tools.survey.old.joining import joined, named, same_place
from buddyline.tools.survey.old.model import OldSurvey
from buddyline.tools.survey.old.readers import read_old
from buddyline.tools.survey.old.systems import map_system
from buddyline.tools.survey.old.writing import svx_of, svx_system, th_of, therion_system
from buddyline.tools.survey.project import Equate, FixedPoint, Place, Project, load_project
from buddyline.tools.survey.sheet import Sheet
from msgspec import UNSET
from msgspec.structs import replace

from tests.processes import PATIENCE_S, REPOSITORY
from tests.tools import survey_world as world
from tests.tools.old_cave import CAVE, DAT, TH, read

CAVERN = pytest.mark.skipif(shutil.which("cavern") is None, reason="survex is not installed")
THERION = pytest.mark.skipif(shutil.which("therion") is None, reason="therion is not installed")
SAMPLES = Path("/usr/share/doc/therion/examples/samples")
# Both programs write centimetres: rounding of two coordinates.
SAME_M = 0.0101


def places(file):
    """Return a .3d file's stations by full name with points, whichever program wrote it."""
    done = subprocess.run(["dump3d", str(file)], capture_output=True, timeout=PATIENCE_S, check=True)
    found = {}
    for row in done.stdout.decode("utf-8", "replace").splitlines():
        name = row.partition("[")[2].partition("]")[0]
        if row.startswith("NODE") and name:
            station, _, path = name.partition("@")
            full = ".".join([*reversed(path.split(".")), station]) if path else station
            found[full.lower()] = np.array([float(word) for word in row.split()[1:4]])
    return found


def by_cavern(folder, text, name):
    (folder / f"{name}.svx").write_text(text)
    done = subprocess.run(
        ["cavern", "-q", f"{name}.svx"], cwd=folder, capture_output=True, text=True, timeout=PATIENCE_S, check=False
    )
    assert done.returncode == 0, done.stdout
    return places(folder / f"{name}.3d")


def by_therion(folder, source, name, system=""):
    stated = f"cs {therion_system(system)}\n" if system else ""
    (folder / "thconfig").write_text(f"{stated}source {source}\nexport model -o {name}.3d -fmt survex\n")
    done = subprocess.run(
        ["therion", "-q"], cwd=folder, capture_output=True, text=True, errors="replace", timeout=PATIENCE_S, check=False
    )
    assert done.returncode == 0, done.stdout[-500:]
    return places(folder / f"{name}.3d")


def in_survex(folder, old: OldSurvey):
    return by_cavern(folder, "\n".join([*svx_system(old), *svx_of(old).lines, ""]), "again")


def in_therion(folder, old: OldSurvey):
    (folder / "again.th").write_text("\n".join(["encoding utf-8", *th_of(old).lines, ""]))
    return by_therion(folder, "again.th", "again_th", map_system(old))


def assert_same(found, expected, *, fixed):
    assert set(expected) <= set(found)
    start = next(iter(expected))
    # Without a fixed point each program begins where it likes.
    shift = 0.0 if fixed else found[start] - expected[start]
    assert max(np.abs(found[name] - shift - at).max() for name, at in expected.items()) <= SAME_M


@CAVERN
def test_a_svx_file_goes_in_and_out_of_survex(tmp_path):
    expected = by_cavern(tmp_path, CAVE, "cave")
    old = read_old(tmp_path / "cave.svx")
    found = in_survex(tmp_path, old)
    assert_same(found, expected, fixed=True)
    again = read_old(tmp_path / "again.svx")
    kept = [(s.start, s.end, s.flags, s.when, s.north.value_deg, s.style) for s in old.shots]
    assert sorted(map(str, kept)) == sorted(
        str((s.start, s.end, s.flags, s.when, s.north.value_deg, s.style)) for s in again.shots
    )
    assert again.passages == old.passages
    assert again.surveys == old.surveys


@CAVERN
@THERION
def test_a_svx_file_goes_out_to_therion(tmp_path):
    expected = by_cavern(tmp_path, CAVE, "cave")
    assert_same(in_therion(tmp_path, read_old(tmp_path / "cave.svx")), expected, fixed=True)


@CAVERN
@THERION
def test_what_therion_refuses_a_file_for_is_not_written(tmp_path):
    text = """
*fix b 0 0 0
*fix b2 0 0 0
*fix other 1 2 3
*equate b b2
*equate a c1
*equate c1 c
a b 5 10 0
a c 1 0 0
c d 4 20 10
*entrance c1
*entrance other
"""
    expected = by_cavern(tmp_path, text, "cave")
    old = read_old(tmp_path / "cave.svx")
    lines = th_of(old).lines
    assert [line for line in lines if line.startswith("#")] == [
        "# no shot, as both its ends are one station: cave.svx:9"
    ]
    assert sum("fix b" in line for line in lines) == 1
    found = in_therion(tmp_path, old)
    # Therion gives no equal names and no lone points.
    assert_same(found, {name: expected[name] for name in ("a", "b", "d")}, fixed=True)


@CAVERN
@THERION
@pytest.mark.parametrize("system", ["", "UTM33"])
def test_a_th_file_goes_in_and_out_of_both(tmp_path, system):
    text = TH.replace('station 1 "mouth"', f'cs {system}\n    fix 1 420000 5260000 50\n    station 1 "mouth"')
    (tmp_path / "cave.th").write_text(text if system else TH)
    expected = by_therion(tmp_path, "cave.th", "cave", system)
    old = read_old(tmp_path / "cave.th")
    assert_same(in_therion(tmp_path, old), expected, fixed=bool(system))
    assert_same(in_survex(tmp_path, old), expected, fixed=bool(system))


@pytest.mark.slow
@THERION
@pytest.mark.skipif(not SAMPLES.is_dir(), reason="therion's samples are not installed")
def test_therion_s_samples_go_in_and_out_of_both(tmp_path):
    seen = 0
    for sample in [*sorted(SAMPLES.rglob("*.th")), *sorted(SAMPLES.rglob("*.svx"))]:
        folder = tmp_path / f"{sample.parent.name}_{sample.name}"
        shutil.copytree(sample.parent, folder)
        if not re.search(r"^\s*\*?data |^\s*\d+\s+\d+\s", sample.read_text(encoding="latin-1"), re.MULTILINE):
            # Some have drawings alone.
            continue
        old = read_old(folder / sample.name)
        seen += 1
        if sample.suffix == ".th":
            expected = by_therion(folder, sample.name, "first")
        else:
            expected = by_cavern(folder, sample.read_text(), "first")
        assert_same(in_survex(folder, old), expected, fixed=bool(old.fixes))
        assert_same(in_therion(folder, old), expected, fixed=bool(old.fixes))
    assert seen > 5


@CAVERN
def test_the_adjustment_of_an_old_survey_is_cavern_s(tmp_path):
    expected = by_cavern(
        tmp_path,
        CAVE.replace("diving", "normal").replace("fromdepth todepth", "clino", 1).replace("310 3.0 5.5", "310 -11"),
        "cave",
    )
    old = read_old(tmp_path / "cave.svx")
    project = joined(Project(), [old])
    adjusted = adjust(project)
    same_as = same_place(project, [old])
    ours = {name: adjusted.positions[same_as(name)].position_m for name in old.stations}
    assert_same({name.lower(): at for name, at in ours.items()}, expected, fixed=True)
    # Two loops: three legs in feet, and there and back.
    assert len(adjusted.loops) == 2


@CAVERN
@THERION
def test_a_tape_shorter_than_its_rise_is_weighed_with_it_as_survex_does(tmp_path):
    text = "*fix 1 0 0 0\n*sd tape 0.2 metres\n*data diving from to tape compass fromdepth todepth\n"
    expected = by_cavern(tmp_path, text + "1 2 9.0 90 0.0 -4.0\n2 3 1.0 90 -4.0 -5.2\n3 4 0.5 0 -5.2 -4.5\n", "short")
    old = read_old(tmp_path / "short.svx")
    project = joined(Project(), [old])
    adjusted, same_as = adjust(project), same_place(project, [old])
    ours = {name: adjusted.positions[same_as(name)].position_m for name in old.stations}
    assert_same(ours, expected, fixed=True)
    assert_same(in_survex(tmp_path, old), expected, fixed=True)
    assert_same(in_therion(tmp_path, old), expected, fixed=True)


@CAVERN
@THERION
def test_each_leg_keeps_its_own_kind_of_north_in_therion(tmp_path):
    text = """*cs utm33
*cs out utm33
*fix 1 410600 5282000 1234
*declination auto 410600 5282000 1234
1 2 10.00 320 -06
*date 2012.06.25
*declination 5 degrees
2 3 10 000 0
*declination auto 410600 5282000 1234
3 4 10 090 0
"""
    # Without a day Survex takes no declination, but the grid's convergence.
    expected = by_cavern(tmp_path, text, "norths")
    assert_same(in_therion(tmp_path, read_old(tmp_path / "norths.svx")), expected, fixed=True)


@CAVERN
@pytest.mark.parametrize("first", ["old", "new"])
def test_new_legs_hang_on_an_old_survey_in_one_adjustment(tmp_path, first):
    course = world.loop(np.random.default_rng(6), 12)
    rows = world.readings_of(course, np.random.default_rng(2))
    rows = [replace(leg, turn_deg=0.0) for leg in rows]
    old = named(read(tmp_path, CAVE), "cave")
    pair = ["cave.stream.3", "4"] if first == "old" else ["4", "cave.stream.3"]
    project = joined(replace(world.project_of(rows), equate=[Equate(stations=pair)]), [old])
    adjusted = adjust(project)
    assert not adjusted.left_out
    assert len(adjusted.loops) == 3
    sheet = Sheet(project, adjusted, [old])
    found = by_cavern(tmp_path, survex.svx(sheet), "both")
    for name, position in adjusted.positions.items():
        key = name if "." in name else f"demo.{name}"
        assert np.abs(found[key] - position.position_m).max() <= 0.02, name
    # The new end has the old survey's uncertainty as well.
    assert adjusted.positions["10"].ellipse[0] > adjusted.positions[pair[0]].ellipse[0] > 0.0
    assert "again" not in found
    text = survex.th(sheet)
    assert "survey cave" in text
    assert ("equate 4@demo 3@stream.cave" in text) == (first == "new")


@CAVERN
@THERION
@pytest.mark.parametrize("own_legs", [False, True])
@pytest.mark.parametrize("dated", [False, True])
@pytest.mark.parametrize("place", ["grid", "degrees", "stated", "nowhere"])
def test_magnetic_bearings_of_a_table_are_turned_alike_here_and_in_both_programs(tmp_path, place, dated, own_legs):
    where = {"latitude_deg": 45.5, "longitude_deg": 10.9}
    known = {
        "grid": Place(**where, utm_zone="32N"),
        "degrees": Place(**where),
        "stated": Place(declination_deg=3.5),
        "nowhere": Place(),
    }[place]
    day = "2019-07-27" if dated else ""
    rows = [f"A,B,80,90,0,{day}", f"B,C,50,0,5,{day}"]
    (tmp_path / "old.csv").write_text("\n".join(["from,to,length,azimuth,clino,date", *rows, ""]))
    old = named(read_old(tmp_path / "old.csv"), "old")
    legs = world.readings_of(world.line(np.random.default_rng(6), 4), np.random.default_rng(2)) if own_legs else []
    first = "0" if own_legs else "old.A"
    fix = [FixedPoint(station=first, altitude_m=5.0, **where)] if place in ("grid", "degrees") else []
    equate = [Equate(stations=["0", "old.A"])] if own_legs else []
    project = joined(world.project_of(legs, place=known, fix=fix, equate=equate), [old])
    adjusted = adjust(project)
    sheet = Sheet(project, adjusted, [old])
    (tmp_path / "out.th").write_text(survex.th(sheet))
    grid = "EPSG:32632" if place == "grid" else ""
    for found in (by_cavern(tmp_path, survex.svx(sheet), "out"), by_therion(tmp_path, "out.th", "out", grid)):
        for name, position in adjusted.positions.items():
            key = name.lower() if "." in name else f"demo.{name}"
            assert np.abs(found[key] - position.position_m).max() <= 0.02, name


def without_bearings(leg):
    return replace(leg, azimuth_deg=UNSET, back_azimuth_deg=UNSET, inclination_deg=UNSET, back_inclination_deg=UNSET)


@CAVERN
@THERION
@pytest.mark.parametrize("what", ["tapes", "nodes", "both"])
def test_stations_by_distances_alone_stand_in_cave_programs_where_they_are_adjusted(tmp_path, what):
    course = world.line(np.random.default_rng(6), 4)
    # The last station is seen from the first three by distances alone.
    course.legs = [(0, 1, 0), (1, 2, 1), (2, 3, 0), (0, 4, 0), (1, 4, 0), (2, 4, 0)]
    rows = world.readings_of(course, np.random.default_rng(2), tape_m=0.005)
    project, tapes = world.project_of([*rows[:3], *map(without_bearings, rows[3:])]), []
    if what == "tapes":
        project = load_project(REPOSITORY / "examples" / "datums" / "site.toml")
        tapes = [named(read_old(REPOSITORY / "examples" / "datums" / "tapes.csv"), "site")]
    elif what == "both":
        # D5 hangs on one distance alone, and cannot be placed.
        ways = [(f"D{leg.from_}", "D4", leg) for leg in rows[3:]] + [("D4", "D5", rows[3])]
        table = [f"{i},{j},{leg.distance_m},0.005,{leg.depth_from_m},{leg.depth_to_m},0.02" for i, j, leg in ways]
        (tmp_path / "tapes.csv").write_text(
            "\n".join(["from,to,distance_m,sigma_m,depth_from_m,depth_to_m,depth_sigma_m", *table])
        )
        tapes = [named(read_old(tmp_path / "tapes.csv"), "site")]
        equates = [Equate(stations=[str(k), f"site.D{k}"]) for k in range(3)]
        project = replace(world.project_of(rows[:3]), equate=equates)
    project = joined(project, tapes)
    sheet = Sheet(project, adjust(project), tapes)
    text = survex.th(sheet)
    (tmp_path / "own.th").write_text(text)
    for found in (
        by_cavern(tmp_path, survex.svx(sheet), "own"),
        by_cavern(tmp_path, survex.svx_cartesian(sheet), "vectors"),
        by_therion(tmp_path, "own.th", "own_th"),
    ):
        assert len(sheet.adjusted.positions) == (6 if what == "tapes" else 5)
        shift = None
        for name, position in sheet.adjusted.positions.items():
            at = found[(name if "." in name else f"{sheet.name}.{name}").lower()]
            # Without a fixed point and a part that hangs on nothing, each program begins where it likes.
            shift = position.position_m - at if shift is None else shift
            # What distances move legs that have bearings by, these programs cannot know.
            assert np.abs(at + shift - position.position_m).max() <= (SAME_M if what == "tapes" else 0.02), name


@CAVERN
def test_compass_data_go_out_to_survex(tmp_path):
    # Of a .dat file Survex 1.4.4 reads neither corrections nor backsights.
    plain = DAT.replace("1.00 0.50 0.10", "0.00 0.00 0.00").replace("DDDDLRUDLADadBF", "DDDDLRUDLAD")
    plain = plain.replace("226.00 10.50 ", "").replace("-999.00 5.00", "280.00 5.00").replace("100.00 -999.00 ", "")
    (tmp_path / "cave.dat").write_text(plain)
    done = subprocess.run(
        ["cavern", "-q", "cave.dat"], cwd=tmp_path, capture_output=True, timeout=PATIENCE_S, check=False
    )
    assert done.returncode == 0
    expected = {name: at for name, at in places(tmp_path / "cave.3d").items() if name != "x"}
    assert_same(in_survex(tmp_path, read_old(tmp_path / "cave.dat")), expected, fixed=False)


def run(*words):
    parser = argparse.ArgumentParser()
    command.add_arguments(parser)
    return command.run(parser.parse_args([str(word) for word in words]))


@CAVERN
def test_fixed_points_without_legs_go_in_and_out(tmp_path, capsys):
    (tmp_path / "peaks.svx").write_text(
        "*cs UTM33N\n*cs out UTM33N\n*cs out UTM60S\n*fix top 412345 5187654 1820\n*fix hut 412600 5187000 1400\n"
    )
    path = tmp_path / "all.toml"
    assert run("import", path, tmp_path / "peaks.svx") == 0
    capsys.readouterr()
    assert run("export", path, "--format", "stations", "-o", "-") == 0
    rows = list(csv.DictReader(io.StringIO(capsys.readouterr().out)))
    assert [(row["name"], row["east_m"], row["north_m"], row["up_m"]) for row in rows] == [
        ("peaks.top", "412345.000", "5187654.000", "1820.000"),
        ("peaks.hut", "412600.000", "5187000.000", "1400.000"),
    ]
    assert run("export", path, "--format", "svx", "-o", tmp_path / "out.svx") == 0
    found = by_cavern(tmp_path, (tmp_path / "out.svx").read_text(), "again")
    assert found["peaks.top"] == pytest.approx([412345, 5187654, 1820], abs=SAME_M)
    path.write_text(path.read_text() + '\n[[fix]]\nstation = "peaks.tpo"\neast_m = 0\nnorth_m = 0\n')
    with pytest.raises(BuddylineError, match=r"fix of 'peaks\.tpo': no leg and no old survey"):
        run("adjust", path)


@pytest.mark.parametrize("second", ["*fix a 10 0 0", "*fix b 0 10 0\n*equate a b"])
def test_a_station_that_old_surveys_fix_at_two_places_is_refused(tmp_path, second):
    text = f"*fix a 0 0 0\n{second}\n*data normal from to tape compass clino\na c 5 90 0\n"
    (tmp_path / "twice.svx").write_text(text)
    old = named(read_old(tmp_path / "twice.svx"), "old")
    with pytest.raises(BuddylineError, match=r"is fixed 10\.00 m from where the same station was fixed before"):
        joined(Project(), [old])
    decided = joined(Project(fix=[FixedPoint(station="old.a", east_m=1.0, north_m=2.0)]), [old])
    assert adjust(decided).positions["old.a"].position_m[:2] == pytest.approx([1.0, 2.0])
    (tmp_path / "twice.svx").write_text(text.replace("10", "0"))
    assert len(joined(Project(), [named(read_old(tmp_path / "twice.svx"), "old")]).fix) == 1


def test_the_command_takes_old_surveys_into_a_project(tmp_path, capsys):
    (tmp_path / "cave.svx").write_text(CAVE)
    (tmp_path / "side.th").write_text(TH)
    path = tmp_path / "all.toml"
    assert run("import", path, tmp_path / "cave.svx") == 0
    assert "cave.svx as cave: 10 shots, 1 splays" in capsys.readouterr().out
    with path.open("a") as file:
        file.write('\n[[equate]]\nstations = ["cave.stream.5", "side.cave.1"]\n')
    with pytest.raises(BuddylineError, match=r"side\.cave\.1"):
        run("adjust", path)
    kept = path.read_text()
    assert run("import", path, tmp_path / "side.th") == 0
    assert path.with_name("all.toml.1").read_text() == kept
    assert [one.name for one in load_project(path).old] == ["cave", "side"]
    assert run("adjust", path) == 0
    assert "15 legs" in capsys.readouterr().out
    assert run("export", path, "--format", "stations", "-o", "-") == 0
    rows = capsys.readouterr().out.splitlines()
    assert any(row.startswith("side.cave.side.c,station") for row in rows)
    path.write_text(path.read_text().replace("[place]\n", "[place]\ndeclination_deg = 3.0\n"))
    assert run("export", path, "--format", "dat", "-o", "-") == 1
    assert "left out: old surveys" in capsys.readouterr().err
    with pytest.raises(BuddylineError, match="two old surveys have it"):
        run("import", path, tmp_path / "side.th")
    with pytest.raises(BuddylineError, match="no reader"):
        run("import", path, tmp_path / "other.xyz")


def test_edits_take_an_old_leg_out(tmp_path):
    (tmp_path / "cave.svx").write_text(CAVE)
    path = tmp_path / "all.toml"
    assert run("import", path, tmp_path / "cave.svx") == 0
    with path.open("a") as file:
        file.write('\n[[edit]]\nleg = "cave.stream.3-cave.stream.1"\nuse = false\n')
    assert run("adjust", path) == 0
    path.write_text(path.read_text().replace("stream.3-", "stream.33-"))
    with pytest.raises(BuddylineError, match="nor in the old surveys"):
        run("adjust", path)


@CAVERN
def test_the_magnetic_model_of_an_old_survey_is_that_of_its_year(tmp_path):
    text = (
        "*date 2015.08.01\n*cs UTM33N\n*cs out UTM33N\n*fix 0 328000 5260000 2500\n"
        "*declination auto 328000 5260000 2500\n0 1 1000 356.9275 0\n"
    )
    expected = by_cavern(tmp_path, text, "cave")["1"]
    old = named(read_old(tmp_path / "cave.svx"), "cave")
    found = adjust(joined(Project(), [old])).positions["cave.1"].position_m
    # Survex has the IGRF: 0.02 degrees from the World Magnetic Model there and then.
    assert np.abs(found - expected).max() < 0.5
