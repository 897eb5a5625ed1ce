"""The extension for BlueOS: what BlueOS reads of its Dockerfile, and the programs that it starts."""

from __future__ import annotations

import json
import os
import re
import shlex
import shutil
import signal
import socket
import subprocess
import sys
from pathlib import Path

import pytest

from tests.processes import REPOSITORY, free_endpoint, until

FOLDER = REPOSITORY / "tools" / "bridge" / "blueos"
PAGE = (REPOSITORY / "docs" / "blueos.md").read_text()
# The labels of the extension's own version in BlueOS's repository of extensions.
REQUIRED = {"version", "permissions", "authors", "company", "type", "tags", "readme", "links", "requirements"}


def instructions() -> list[tuple[str, str]]:
    """Return the Dockerfile's instructions, continued lines joined, without comments."""
    text = re.sub(r"^\s*#.*\n", "", (FOLDER / "Dockerfile").read_text(), flags=re.MULTILINE)
    lines = text.replace("\\\n", " ").splitlines()
    return [(word, rest.strip()) for word, _, rest in (line.partition(" ") for line in lines if line.strip())]


def labels() -> dict[str, str]:
    said = [shlex.split(rest) for word, rest in instructions() if word == "LABEL"]
    return dict(pair.split("=", 1) for pairs in said for pair in pairs)  # type: ignore[misc]


def variables() -> dict[str, str]:
    (said,) = [rest for word, rest in instructions() if word == "ENV"]
    return dict(pair.split("=", 1) for pair in shlex.split(said))  # type: ignore[misc]


def test_blueos_finds_its_labels_and_their_json_parses() -> None:
    found = labels()
    assert set(found) == REQUIRED
    permissions = json.loads(found["permissions"])
    assert permissions["HostConfig"]["NetworkMode"] == "host"
    # Keys outlive the container: the folder in which the programs run is the host's.
    (workdir,) = [rest for word, rest in instructions() if word == "WORKDIR"]
    assert [bind.split(":")[1] for bind in permissions["HostConfig"]["Binds"]] == [workdir]
    assert [author["name"] for author in json.loads(found["authors"])]
    assert json.loads(found["company"])["name"] == "Buddyline"
    assert isinstance(json.loads(found["tags"]), list)
    assert json.loads(found["links"])["source"].startswith("https://")
    assert "{tag}" in found["readme"]


def test_its_settings_are_those_of_the_script_and_of_the_page() -> None:
    defaults = variables()
    script = (FOLDER / "start.sh").read_text()
    assert set(re.findall(r"\$\{?([A-Z_]+)", script)) == set(defaults)
    for name, value in (one.split("=", 1) for one in json.loads(labels()["permissions"])["Env"]):
        assert defaults[name] == value
    rows = dict(re.findall(r"^\| `([A-Z_, `]+)` \| (.*?) \|", PAGE.partition("## Settings")[2], flags=re.MULTILINE))
    told = {name: value for names, values in rows.items() for name, value in
            zip(names.replace("`", "").split(", "), values.replace("`", "").split(", "), strict=False)}  # fmt: skip
    assert told == {name: value or "none" for name, value in defaults.items()}


def test_its_image_is_built_of_files_and_extras_that_are_there() -> None:
    copied = [rest.split()[0] for word, rest in instructions() if word == "COPY"]
    assert copied == ["."]
    (build,) = [rest for word, rest in instructions() if word == "RUN"]
    for path in re.findall(r"/src/(\S+)", build):
        assert (REPOSITORY / path).is_file(), path
    (extras,) = re.findall(r'"/src\[(.*?)\]"', build)
    text = (REPOSITORY / "pyproject.toml").read_text()
    for extra in extras.split(","):
        assert re.search(rf"^{extra} = \[", text, flags=re.MULTILINE), extra


def linted(dockerfile: Path) -> subprocess.CompletedProcess[str]:
    """Run hadolint, of our own environment or of the machine."""
    hadolint = shutil.which("hadolint", path=f"{Path(sys.executable).parent}:{os.environ['PATH']}")
    if hadolint is None:
        pytest.skip("hadolint is not installed")
    return subprocess.run(
        [hadolint, "--no-color", dockerfile], capture_output=True, text=True, timeout=120, check=False
    )


def test_dockers_linter_finds_nothing_in_it(tmp_path: Path) -> None:
    done = linted(FOLDER / "Dockerfile")
    assert (done.returncode, done.stdout) == (0, "")
    careless = tmp_path / "Dockerfile"
    careless.write_text((FOLDER / "Dockerfile").read_text().replace("WORKDIR /data", "WORKDIR data"))
    assert "DL3000" in linted(careless).stdout


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_its_script_makes_keys_and_runs_hub_solver_page_and_bridge(tmp_path: Path) -> None:
    mavlink = pytest.importorskip("pymavlink.dialects.v20.ardupilotmega", reason="pymavlink is not installed")
    pytest.importorskip("websockets", reason="websockets is not installed")
    pytest.importorskip("cryptography", reason="cryptography is not installed")
    program = tmp_path / "bin" / "buddyline"
    program.parent.mkdir()
    program.write_text(f'#!/bin/sh\nexec {sys.executable} -P -m buddyline "$@"\n')
    program.chmod(0o755)
    hub, page = (free_endpoint().rpartition(":")[2] for _ in range(2))
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as autopilot:
        autopilot.bind(("127.0.0.1", 0))
        autopilot.settimeout(300.0)
        settings = variables() | {
            "PATH": f"{program.parent}:{os.environ['PATH']}",
            "HUB_ADDRESS": "127.0.0.1",
            "HUB_LISTEN": "127.0.0.1",
            "HUB_PORT": hub,
            "PAGE_LISTEN": "127.0.0.1",
            "PAGE_PORT": page,
            "MAVLINK": f"127.0.0.1:{autopilot.getsockname()[1]}",
        }
        with open(tmp_path / "log", "wb") as log:
            script = subprocess.Popen(
                ["bash", FOLDER / "start.sh"], cwd=tmp_path, env={**os.environ, **settings}, stdout=log, stderr=log
            )
        try:
            (heartbeat,) = mavlink.MAVLink(None).parse_buffer(autopilot.recv(65535))
            assert (heartbeat.get_type(), heartbeat.get_srcComponent()) == ("HEARTBEAT", 197)
            assert {path.name for path in (tmp_path / "keys").glob("node-*.crt")} == {"node-a.crt", "node-b.crt"}
            until(lambda: "look at http://127.0.0.1:" in (tmp_path / "log").read_text())
            assert script.poll() is None
        finally:
            script.send_signal(signal.SIGTERM)
            assert script.wait(60) == 0
        with pytest.raises(ConnectionRefusedError), socket.create_connection(("127.0.0.1", int(hub)), timeout=10):
            pass
