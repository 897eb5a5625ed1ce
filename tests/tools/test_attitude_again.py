"""`solve --attitude-again`: attitudes from the inertial samples in place of the recorded ones."""

import msgspec
import pytest
from buddyline.node.config import NodeConfig, SensorsConfig
from buddyline.node.sim.dive import messages
from buddyline.node.sim.scenario import DivePlan, Scenario
from buddyline.node.sim.world import World
from buddyline.protocol.clock import S_NS
from buddyline.protocol.divelog import DiveLogWriter
from buddyline.protocol.messages import Attitude
from buddyline.tools.cli import main
from buddyline.tools.dives import Dive

pytest.importorskip("vqf", reason="vqf is not installed: make install EXTRAS=pi")

LATER = """\
node = "b"
[camera]
name = "picamera2"
[sensors]
name = "i2c"
magnetometer_offset_t = [1e-6, 0.0, 0.0]
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Both nodes' logs of a dive, the second without its attitudes; a's log has its configuration."""
    folder = tmp_path_factory.mktemp("dive")
    scenario = Scenario(seed=4, start_ns=1_764_000_000 * S_NS)
    dive = [message for _, _, message in messages(World(scenario), DivePlan(seconds=22.0, imu=True, rate_hz=2.0))]
    for node in "ab":
        noted = {"node": node}
        if node == "a":
            noted["config"] = msgspec.json.encode(NodeConfig(node="a", sensors=SensorsConfig(name="i2c"))).decode()
        with DiveLogWriter(folder / f"{node}.mcap", metadata=noted) as writer:
            for message in dive:
                if getattr(message, "node", "") == node and not (node == "b" and isinstance(message, Attitude)):
                    writer.write_message(message)
    (folder / "b.toml").write_text(LATER)
    return folder


def solve(folder, out, *words):
    logs = [str(folder / f"{node}.mcap") for node in "ab"]
    return main(["solve", *logs, "-o", str(out), "--track", "none", *words])


def attitudes_of(path):
    with Dive([path]) as dive:
        return [one.message for one in dive.messages("attitude")]


def test_recorded_attitudes_are_replaced_and_missing_ones_made(folder, tmp_path):
    assert solve(folder, tmp_path / "as_it_is.mcap") == 0
    assert solve(folder, tmp_path / "again.mcap", "--attitude-again", f"b={folder / 'b.toml'}") == 0
    before, after = attitudes_of(tmp_path / "as_it_is.mcap"), attitudes_of(tmp_path / "again.mcap")
    assert {one.node for one in before} == {"a"}
    assert {one.node for one in after} == {"a", "b"}
    assert len({(one.node, one.stamp_ns) for one in after}) == len(after) > 4000
    assert [one.stamp_ns for one in after] == sorted(one.stamp_ns for one in after)
    assert {one.q_ned_body_xyzw for one in before}.isdisjoint(one.q_ned_body_xyzw for one in after)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ((), "no configuration of node b: --attitude-again b=FILE.toml"),
        (("b.toml",), "give NODE=FILE"),
        (("a=b.toml",), "the file is of node b"),
    ],
)
def test_what_is_missing_is_named(folder, tmp_path, capsys, monkeypatch, words, said):
    monkeypatch.chdir(folder)
    assert solve(folder, tmp_path / "out.mcap", "--attitude-again", *words) == 2
    assert said in capsys.readouterr().err
    assert not (tmp_path / "out.mcap").exists()
