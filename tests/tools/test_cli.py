"""The command line: help, exit status, and one-line errors that say what to do."""

import argparse
import json
import math
import os
import re
import subprocess
import sys
from typing import get_args

import pytest
from buddyline.protocol.divelog import DiveLogWriter
from buddyline.protocol.errors import BuddylineError
from buddyline.protocol.messages import Candidates, NodeInfo
from buddyline.solver_service.choices import METHODS
from buddyline.solver_service.geometry.observation import Method
from buddyline.tools.cli import COMMANDS, main
from buddyline.tools.solve import Tracked, _clock_words
from msgspec.structs import replace

from tests.processes import PATIENCE_S, buddyline
from tests.solver_service.conftest import dive_messages
from tests.tools.evaluated import track


@pytest.fixture(scope="module")
def dive_log(tmp_path_factory):
    path = tmp_path_factory.mktemp("dive") / "dive.mcap"
    messages, world = dive_messages(seconds=3.0)
    with DiveLogWriter(path) as writer:
        for message in messages:
            writer.write_message(message)
        for stamp_ns in sorted({m.stamp_ns for m in messages if hasattr(m, "trigger")}):
            truth = world.truth(stamp_ns, stamp_ns // 100_000_000)
            writer.write_message(truth, key="buddyline/pair/a/b/truth")
    return path


def run(capsys, *words):
    status = main([str(word) for word in words])
    out, err = capsys.readouterr()
    return status, out, err


def test_help_names_every_command(capsys):
    status, out, _ = run(capsys, "--help")
    assert status == 0
    for command in COMMANDS:
        assert command.name in out


@pytest.mark.parametrize("name", [command.name for command in COMMANDS])
def test_each_command_helps_with_examples(capsys, name):
    with pytest.raises(SystemExit) as ended:
        main([name, "--help"])
    assert ended.value.code == 0
    assert "examples:" in capsys.readouterr().out


@pytest.mark.parametrize("command", COMMANDS, ids=lambda command: command.name)
def test_each_subcommand_has_an_example(command):
    chosen = [action.choices for action in command.parser()._actions if isinstance(action, argparse._SubParsersAction)]
    for name, parser in (item for choices in chosen for item in choices.items()):
        assert f"example: buddyline {command.name} {name}" in parser.format_help().replace("\n", " ")


def test_an_unknown_command_gets_a_suggestion(capsys):
    status, _, err = run(capsys, "slove")
    assert status == 2
    assert "solve" in err


def test_solve_and_its_summary(capsys, dive_log, tmp_path):
    status, out, _ = run(capsys, "solve", dive_log, "-o", tmp_path / "out.mcap", "--json")
    assert status == 0
    summary = json.loads(out)
    assert summary["triggers"] == summary["solved"] + sum(summary["rejected"].values()) == 28
    assert summary["solved"] > 14
    figures = summary["track"]
    assert figures["rows"] > 100
    assert figures["span_s"] == pytest.approx((figures["rows"] - 1) / 50.0)
    assert (figures["longest_gap_s"] < 1.0, figures["problems"]) == (True, [])
    status, out, _ = run(capsys, "evaluate", tmp_path / "out.mcap", "--json")
    assert status == 0
    json.loads(out)


def test_solve_says_what_its_track_covers(capsys, dive_log, tmp_path):
    _, out, _ = run(capsys, "solve", dive_log, "-o", tmp_path / "out.mcap")
    assert re.search(r"track \(smooth\): \d+ rows over \d\.\d s, longest time without a light", out)
    _, out, _ = run(capsys, "solve", dive_log, "-o", tmp_path / "none.mcap", "--track", "none")
    assert "track (" not in out


def test_solve_says_why_there_is_no_track_of_poses(capsys, tmp_path):
    with DiveLogWriter(tmp_path / "dive.mcap") as writer:
        for message in dive_messages(seconds=3.0)[0]:
            if isinstance(message, Candidates | NodeInfo):
                writer.write_message(message)
    _, out, _ = run(capsys, "solve", tmp_path / "dive.mcap", "-o", tmp_path / "out.mcap")
    assert int(re.search(r"(\d+) poses of", out)[1]) > 10
    assert "  no track (smooth): node a told neither attitudes nor inertial samples, so a pose starts none\n" in out


def test_solve_names_a_node_whose_pictures_have_another_size_than_its_calibration(capsys, caplog, tmp_path):
    with DiveLogWriter(tmp_path / "dive.mcap") as writer:
        for message in dive_messages(seconds=3.0)[0]:
            other = isinstance(message, NodeInfo) and message.node == "b"
            writer.write_message(replace(message, width_px=640, height_px=480) if other else message)
    _, out, _ = run(capsys, "solve", tmp_path / "dive.mcap", "-o", tmp_path / "out.mcap")
    assert "pictures of node b are 820x616 px, its calibration 640x480: they are not used" in caplog.text
    assert "28 no_info" in out
    assert "  no track (smooth): " in out


@pytest.mark.parametrize("two_rates", [True, False])
def test_solve_asks_whether_logs_are_of_one_dive_where_nothing_else_explains_it(capsys, caplog, tmp_path, two_rates):
    with DiveLogWriter(tmp_path / "dive.mcap") as writer:
        for message in dive_messages(seconds=3.0)[0]:
            changes = {}
            of_b = getattr(message, "node", "") == "b"
            if of_b and isinstance(message, NodeInfo) and two_rates:
                changes = {"trigger_period_ns": 2 * message.trigger_period_ns}
            elif of_b and isinstance(message, Candidates):
                changes = {"trigger": message.trigger // 2} if two_rates else {"trigger": message.trigger + 9000}
            writer.write_message(replace(message, **changes))
    status, _, _ = run(capsys, "solve", tmp_path / "dive.mcap", "-o", tmp_path / "out.mcap")
    assert status == 1
    assert "nodes a and b have no trigger in common" in caplog.text
    assert ("pictures a second: give both one `rate_hz`" in caplog.text) == two_rates
    assert ("are the logs of the same dive?" in caplog.text) != two_rates


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["solve"], "buddyline solve: the following arguments are required: DIVE.mcap, -o/--output; see `bu"),
        (["demo", "--nodes"], "buddyline demo: argument --nodes: expected one argument; see `buddyline demo --help`"),
        (["demo", "more"], "buddyline demo: unrecognized arguments: more; see `buddyline demo --help`"),
        (["demo", "--rate", "x"], "buddyline demo: argument --rate: x: give a number"),
        (["export", "a.mcap", "--format", "foo"], "buddyline export: argument --format: invalid choice: 'foo'"),
        (
            ["survey", "tags", "x", "1", "-o", "t.pdf"],
            "buddyline survey tags: argument first: invalid int value: 'x'; s",
        ),
    ],
)
def test_errors_of_usage_are_one_line(capsys, words, said):
    with pytest.raises(SystemExit) as ended:
        main(words)
    assert ended.value.code == 2
    err = capsys.readouterr().err
    assert err.startswith(said)
    assert err.endswith(" --help`\n")
    assert err.count("\n") == 1


def test_solve_names_a_detector_that_it_does_not_use(capsys, caplog, dive_log, tmp_path):
    run(capsys, "solve", dive_log, "-o", tmp_path / "out.mcap", "--detector", "paper")
    assert "its candidates are taken as they are: --detector" in caplog.text
    status, _, err = run(capsys, "solve", dive_log, "-o", tmp_path / "none.mcap", "--detector", "none")
    assert status == 2
    assert "detector method 'none': choose one of source, paper" in err
    assert not (tmp_path / "none.mcap").exists()


def test_a_track_in_parts_says_for_how_long_it_tells():
    told = Tracked()
    for k in (0, 1, 2, 1000, 1001):
        told.take(track(k, (0.0, 0.0, 3.0)))
    assert (told.rows, told.parts) == (5, 2)
    assert re.match(r"5 rows over 0\.3 of 100\.1 s, in 2 parts, longest time without a light 99\.8 s", str(told))


@pytest.mark.parametrize(
    ("sigma_s", "said"),
    [
        (0.0004, "clock of b -1.5 ms from a's (1 sd 0.4)"),
        (0.2805, "clock offset not known"),
        (math.inf, "clock offset not known"),
        (math.nan, "clock offset not known"),
    ],
)
def test_a_clock_offset_is_said_only_where_it_is_known(sigma_s, said):
    assert _clock_words(("a", "b"), -0.0015, sigma_s) == said


def test_solve_is_deterministic(capsys, dive_log, tmp_path):
    for name in ("one.mcap", "two.mcap"):
        assert run(capsys, "solve", dive_log, "-o", tmp_path / name)[0] == 0
    assert (tmp_path / "one.mcap").read_bytes() == (tmp_path / "two.mcap").read_bytes()


def test_output_that_exists_is_kept(capsys, dive_log, tmp_path):
    (tmp_path / "out.mcap").write_text("precious")
    status, _, err = run(capsys, "solve", dive_log, "-o", tmp_path / "out.mcap")
    assert status == 2
    assert "exists" in err
    assert (tmp_path / "out.mcap").read_text() == "precious"


@pytest.mark.parametrize(
    ("content", "says"),
    [(None, "cannot be read"), (b"", "empty"), (b"dear diary", "not a dive log")],
    ids=["missing", "empty", "text"],
)
@pytest.mark.parametrize("command", ["solve", "play", "detect", "evaluate", "export"])
def test_bad_logs_give_a_one_line_error_and_exit_2(capsys, tmp_path, command, content, says):
    path = tmp_path / "bad.mcap"
    if content is not None:
        path.write_bytes(content)
    words = {"solve": ["-o", tmp_path / "out.mcap"], "export": ["--format", "csv"]}.get(command, [])
    status, out, err = run(capsys, command, path, *words)
    assert status == 2
    assert out == ""
    assert says in err
    assert "bad.mcap" in err
    assert len(err.strip().splitlines()) == 1
    assert not (tmp_path / "out.mcap").exists()


def test_a_dive_without_calibration_is_refused(capsys, tmp_path):
    messages, _ = dive_messages(seconds=1.0)
    with DiveLogWriter(tmp_path / "dive.mcap") as writer:
        for message in messages:
            if not hasattr(message, "camera"):
                writer.write_message(message)
    status, _, err = run(capsys, "solve", tmp_path / "dive.mcap", "-o", tmp_path / "out.mcap")
    assert status == 2
    assert "--info a=FILE" in err
    info = next(m for m in messages if hasattr(m, "camera"))
    from buddyline.protocol.codec import encode

    for node in ("a", "b"):
        import msgspec

        (tmp_path / f"{node}.json").write_bytes(encode(msgspec.structs.replace(info, node=node)))
    given = [word for node in ("a", "b") for word in ("--info", f"{node}={tmp_path / node}.json")]
    status, _, _ = run(capsys, "solve", tmp_path / "dive.mcap", "-o", tmp_path / "out2.mcap", *given)
    assert status == 0


def test_logs_of_different_rigs_are_refused(capsys, tmp_path):
    for name, seed in (("one", 3), ("two", 4)):
        messages, _ = dive_messages(seconds=1.0, seed=seed)
        with DiveLogWriter(tmp_path / f"{name}.mcap") as writer:
            for message in messages:
                writer.write_message(message)
    status, _, err = run(capsys, "solve", tmp_path / "one.mcap", tmp_path / "two.mcap", "-o", tmp_path / "out.mcap")
    assert status == 2
    for word in ("one.mcap", "two.mcap", "node a"):
        assert word in err


def test_one_node_alone_is_an_error(capsys, tmp_path):
    messages, _ = dive_messages(seconds=1.0)
    with DiveLogWriter(tmp_path / "a.mcap") as writer:
        for message in messages:
            if message.node == "a":
                writer.write_message(message)
    status, _, err = run(capsys, "solve", tmp_path / "a.mcap", "-o", tmp_path / "out.mcap")
    assert status == 2
    assert "both nodes" in err


def test_a_truncated_log_is_solved_as_far_as_it_goes(capsys, dive_log, tmp_path):
    data = dive_log.read_bytes()
    with DiveLogWriter(tmp_path / "chunked.mcap") as writer:
        for i, message in enumerate(dive_messages(seconds=3.0)[0]):
            writer.write_message(message)
            if i % 50 == 0:
                writer.flush()
    data = (tmp_path / "chunked.mcap").read_bytes()
    (tmp_path / "cut.mcap").write_bytes(data[: len(data) * 4 // 10])
    status, out, err = run(capsys, "solve", tmp_path / "cut.mcap", "-o", tmp_path / "out.mcap", "--json")
    assert status == 1
    assert "cut.mcap: breaks off at byte" in err
    assert 5 < json.loads(out)["solved"] < 28


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["--checks", "range,magic"], "magic"),
        (["--info", "a"], "NODE=FILE"),
        (["--info", "a=nothing.json"], "nothing.json"),
        (["--info", "c=DIVE"], "holds no NodeInfo of node c; it has a, b"),
        (["--attitude-again"], "no inertial samples of any node"),
        (["--nodes", "a", "c"], "node c"),
    ],
)
def test_bad_arguments_name_the_value(capsys, dive_log, tmp_path, words, says):
    given = [word.replace("DIVE", str(dive_log)) for word in words]
    status, _, err = run(capsys, "solve", dive_log, "-o", tmp_path / "out.mcap", *given)
    assert status == 2
    assert says in err


def test_a_log_of_several_nodes_describes_each(capsys, dive_log, tmp_path):
    status, _, _ = run(capsys, "solve", dive_log, "-o", tmp_path / "out.mcap", "--info", f"b={dive_log}")
    assert status == 0


def test_a_configuration_typo_is_named(capsys, tmp_path):
    (tmp_path / "a.toml").write_text('node = "a"\n[camera]\nnmae = "stored"\n')
    status, _, err = run(capsys, "node", "--config", tmp_path / "a.toml")
    assert status == 2
    for word in ("a.toml", "nmae", "name"):
        assert word in err


@pytest.mark.parametrize("words", [["--help"], ["completion", "bash"]])
@pytest.mark.parametrize("unbuffered", ["", "1"])
def test_a_full_disk_or_a_closed_pipe_at_the_output_is_no_traceback(words, unbuffered):
    environment = os.environ | {"PYTHONUNBUFFERED": unbuffered}
    program = [sys.executable, "-P", "-m", "buddyline", *words]
    with open("/dev/full", "w") as full:
        ended = subprocess.run(
            program, stdout=full, stderr=subprocess.PIPE, text=True, env=environment, check=False, timeout=PATIENCE_S
        )
    assert (ended.returncode, ended.stderr.count("\n")) == (2, 1)
    assert "output cannot be written: No space left on device" in ended.stderr
    read, write = os.pipe()
    os.close(read)
    ended = subprocess.run(
        program, stdout=write, stderr=subprocess.PIPE, text=True, env=environment, check=False, timeout=PATIENCE_S
    )
    os.close(write)
    assert (ended.returncode, ended.stderr) == (0, "")
    closed = subprocess.run(["sh", "-c", '"$@" >&- 2>&-', "sh", *program], check=False, timeout=PATIENCE_S)
    assert closed.returncode == 0


EVERY_HELP = """
import contextlib, io, sys
from buddyline.tools.cli import COMMANDS, main
with contextlib.redirect_stdout(io.StringIO()):
    main(["--help"])
    assert not {"msgspec", "mcap"} & set(sys.modules)
    for command in COMMANDS:
        with contextlib.suppress(SystemExit):
            main([command.name, "--help"])
print(*sorted(sys.modules))
"""


def test_help_of_every_command_is_quick_because_it_imports_nothing_heavy():
    # The list of imports is a better measure than a time on a shared machine.
    out = subprocess.run([sys.executable, "-c", EVERY_HELP], capture_output=True, text=True, check=True).stdout
    assert {"numpy", "cv2", "zenoh", "mcap", "matplotlib", "websockets"}.isdisjoint(out.split())
    assert "buddyline.tools.arguments" in out


def test_offered_choices_match_the_solvers():
    assert get_args(Method) == METHODS


@pytest.mark.parametrize("words", [["plan"], ["plan", "--help"], ["calibrate", "--help"]])
def test_a_terminal_limited_to_ascii_is_no_error(words):
    environment = {**os.environ, "PYTHONIOENCODING": "ascii", "PYTHONUTF8": "0"}
    done = subprocess.run(
        [sys.executable, "-m", "buddyline", *words], capture_output=True, text=True, env=environment, check=False
    )
    assert (done.returncode, done.stderr) == (0, "")


def test_exit_status_of_the_real_program(tmp_path):
    assert buddyline("--version").returncode == 0
    assert buddyline("solve", "none.mcap", "-o", tmp_path / "x.mcap").returncode == 2


@pytest.mark.parametrize(
    "words", [("demo", "--seconds", "-1"), ("demo", "--rate", "0"), ("record", "x.mcap", "--seconds", "nan")]
)
def test_a_number_that_must_be_above_zero_is_named(words, capsys):
    with pytest.raises(SystemExit) as ended:
        main([*words])
    assert ended.value.code == 2
    assert f"{words[-1]}: give a number above 0" in capsys.readouterr().err


def numeric_options():
    """Yield the words before each number that a command or subcommand takes, and what argparse makes of it."""

    def of(parser, words):
        for action in parser._actions:
            if isinstance(action, argparse._SubParsersAction):
                for name, below in action.choices.items():
                    yield from of(below, [*words, name])
            elif callable(action.type):
                yield " ".join([*words, *action.option_strings[-1:]]), action.type

    for command in COMMANDS:
        yield from of(command.parser(), [command.name])


@pytest.mark.parametrize("text", ["nan", "inf", "-inf", "1e300"])
def test_no_option_takes_a_number_that_is_none(text):
    """Each would end in a traceback, or in a file full of it."""

    def takes(kind):
        try:
            return isinstance(kind(text), float)
        except (ValueError, argparse.ArgumentTypeError, BuddylineError):
            return False

    checked = dict(numeric_options())
    assert {"solve --clock-offset", "play --start", "view --start", "calibrate lights --tape"} <= checked.keys()
    assert [words for words, kind in checked.items() if takes(kind)] == []


@pytest.mark.parametrize(
    "words",
    [
        ("solve", "dive.mcap", "-o", "out.mcap", "--clock-offset", "nan"),
        ("simulate", "dive.mcap", "--clock-drift-ppm", "inf"),
        ("view", "dive.mcap", "--start", "1e300"),
    ],
)
def test_a_number_that_is_none_is_named(words, capsys):
    with pytest.raises(SystemExit) as ended:
        main([*words])
    assert ended.value.code == 2
    assert f"argument {words[-2]}: {words[-1]}: give a number from -4e9 to 4e9" in capsys.readouterr().err


@pytest.mark.parametrize("output", [".", ""])
@pytest.mark.parametrize("form", ["foxglove", "csv"])
def test_a_folder_is_no_name_for_an_export(form, output, dive_log, capsys):
    assert main(["export", str(dive_log), "--format", form, "-o", output]) == 2
    assert capsys.readouterr().err == "buddyline export: .: exists; name another or remove it first\n"


@pytest.mark.parametrize("command", ["solver", "node", "hub"])
@pytest.mark.parametrize("seconds", ["0", "-1", "nan", "soon"])
def test_a_service_that_is_to_run_for_no_time_is_refused(command, seconds, capsys):
    with pytest.raises(SystemExit) as ended:
        main([command, "--seconds", seconds])
    assert ended.value.code == 2
    assert f"{seconds}: give a number above 0" in capsys.readouterr().err
