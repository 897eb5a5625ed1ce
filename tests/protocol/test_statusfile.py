"""The status file: where it is, what is in it, and a disk that refuses it, which stops nothing."""

import json
import logging

import numpy as np
import pytest
from buddyline.protocol.codec import decode
from buddyline.protocol.messages import NodeStatus
from buddyline.protocol.statusfile import StatusFile
from msgspec.structs import replace

STATUS = NodeStatus(
    node="a", stamp_ns=5, boot="b", software="s", uptime_s=1.0, rates_hz={}, drops={}, ages_s={}, problem="disk: full"
)


@pytest.mark.parametrize(
    ("configured", "variables", "path"),
    [
        ("/etc/x.json", {"RUNTIME_DIRECTORY": "/run/b", "XDG_RUNTIME_DIR": "/run/user/1"}, "/etc/x.json"),
        ("", {"RUNTIME_DIRECTORY": "/run/b:/run/c", "XDG_RUNTIME_DIR": "/run/user/1"}, "/run/b/node-a.json"),
        ("", {"XDG_RUNTIME_DIR": "/run/user/1"}, "/run/user/1/buddyline/node-a.json"),
        ("", {}, None),
    ],
)
def test_the_path_of_the_status_file(monkeypatch, configured, variables, path):
    for name in ("RUNTIME_DIRECTORY", "XDG_RUNTIME_DIR"):
        monkeypatch.delenv(name, raising=False)
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    found = StatusFile.of("node-a", configured)
    assert (None if found is None else str(found.path)) == path


def test_the_status_file_is_always_complete_and_removed_at_the_end(tmp_path):
    file = StatusFile(tmp_path / "run" / "node-a.json")
    for problems in ([], ["disk: full"]):
        file.write("node a", problems, STATUS)
        content = json.loads(file.path.read_bytes())
        assert content["service"] == "node a"
        assert content["problems"] == problems
        assert content["stamp_ns"] > 0
        assert decode(json.dumps(content["status"]).encode(), NodeStatus) == STATUS
    assert [path.name for path in file.path.parent.iterdir()] == ["node-a.json"]
    file.remove()
    assert not file.path.exists()
    file.remove()


def test_numbers_of_numpy_end_no_service(tmp_path):
    """On the bus they are sent as Python's; the file must not be stricter."""
    file = StatusFile(tmp_path / "solver.json")
    file.write("solver", [], replace(STATUS, uptime_s=np.float64(1.5)))
    assert json.loads(file.path.read_bytes())["status"]["uptime_s"] == 1.5


def test_a_path_that_cannot_be_written_is_reported_once(tmp_path, caplog):
    (tmp_path / "file").write_text("")
    file = StatusFile(tmp_path / "file" / "node-a.json")
    with caplog.at_level(logging.WARNING):
        file.write("node a", [], None)
        file.write("node a", [], None)
        file.remove()
    assert caplog.text.count("cannot be written") == 1
