"""`bridge --http`: what programs read."""

from __future__ import annotations

import math
import re
import shutil
import socket
import struct
import subprocess
import urllib.error
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import pytest
from buddyline.protocol.clock import S_NS
from buddyline.protocol.codec import encode
from buddyline.protocol.envelope import open_envelope
from buddyline.tools.bridge.http_api import Answers, HttpApi
from buddyline.tools.bridge.place import on_earth
from buddyline.tools.bridge.placed import Placing

from tests.processes import REPOSITORY
from tests.tools.bridged import P_NED, PLACE, estimate, get, oriented, placed_of, take
from tests.tools.evaluated import INFOS
from tests.tools.watched import at, attitude, status


class TestHttp:
    @pytest.fixture
    def served(self) -> Iterator[tuple[Answers, str]]:
        self.now_ns = at(5)
        state = Answers(lambda: self.now_ns)
        api = HttpApi("127.0.0.1", 0, state)
        yield state, f"http://127.0.0.1:{api.port}"
        api.close()

    def test_the_position_is_as_the_ugps_documents_it_and_goes_invalid(self, served: tuple[Answers, str]) -> None:
        state, address = served
        path = f"{address}/api/v1/position"
        assert get(f"{path}/acoustic/filtered")["position_valid"] is False
        assert get(f"{path}/global")["fix_quality"] == 0
        placed = placed_of(declination_rad=0.0)
        state.place(placed, on_earth(placed, PLACE), PLACE)
        acoustic = get(f"{path}/acoustic/filtered")
        assert (acoustic["x"], acoustic["y"], acoustic["z"]) == pytest.approx((*P_NED[:2], 12.5))
        assert acoustic["position_valid"] is True
        assert acoustic["std"] == pytest.approx(placed.sigma_m)
        where = get(f"{path}/global")
        assert where["lat"] == on_earth(placed, PLACE).latitude_deg
        assert where["fix_quality"] == 1
        assert where["orientation"] == pytest.approx(math.degrees(placed.yaw_rad))
        assert get(f"{path}/master")["lat"] == PLACE.latitude_deg
        assert get(f"{address}/api/")["version"] == "v1"
        self.now_ns += S_NS
        assert get(f"{path}/acoustic/filtered")["position_valid"] is False
        assert get(f"{path}/global")["fix_quality"] == 0

    def test_a_place_from_before_this_machine_s_clock_was_set_back_is_not_valid(
        self, served: tuple[Answers, str]
    ) -> None:
        state, address = served
        state.place(placed_of(declination_rad=0.0), None, None)
        self.now_ns -= 3600 * S_NS
        assert get(f"{address}/api/v1/position/acoustic/filtered")["position_valid"] is False

    def test_a_client_that_goes_in_mid_answer_is_no_fault(
        self, served: tuple[Answers, str], capfd: pytest.CaptureFixture[str]
    ) -> None:
        _, address = served
        host, _, port = address.removeprefix("http://").rpartition(":")
        for _ in range(20):
            with socket.create_connection((host, int(port))) as client:
                client.sendall(b"GET /api/v1/about HTTP/1.1\r\n")
                # Closed with a reset.
                client.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        assert get(f"{address}/api/v1/about")["product"] == "Buddyline"
        assert "Traceback" not in capfd.readouterr().err

    def test_it_serves_over_ipv6(self) -> None:
        try:
            with socket.socket(socket.AF_INET6) as probe:
                probe.bind(("::1", 0))
        except OSError as error:
            pytest.skip(f"this machine has no IPv6: {error}")
        api = HttpApi("::1", 0, Answers(lambda: at(5)))
        try:
            assert get(f"http://[::1]:{api.port}/api/v1/about")["product"] == "Buddyline"
        finally:
            api.close()

    def test_a_place_that_is_behind_the_nodes_is_not_valid(self, served: tuple[Answers, str]) -> None:
        state, address = served
        for newest_k, valid in ((5, True), (30, False)):
            placed = take(Placing("b"), *INFOS.values(), oriented(), attitude("b", at(newest_k)), estimate())
            assert placed is not None
            state.place(placed, None, None)
            answer = get(f"{address}/api/v1/position/acoustic/filtered")
            assert answer["position_valid"] is valid

    def test_every_key_s_last_message_is_there_and_unknown_paths_are_not(self, served: tuple[Answers, str]) -> None:
        state, address = served
        state.take(open_envelope("buddyline/node/a/status", encode(status("a", at(1))), at(1)))
        assert get(f"{address}/buddyline") == ["buddyline/node/a/status"]
        assert get(f"{address}/buddyline/node/a/status")["stamp_ns"] == at(1)
        with pytest.raises(urllib.error.HTTPError, match="404"):
            get(f"{address}/etc/passwd")

    def test_the_readme_s_javascript_reads_it(self, served: tuple[Answers, str], tmp_path: Path) -> None:
        node = shutil.which("node")
        if node is None:
            pytest.skip("node is not installed")
        state, address = served
        state.take(open_envelope("buddyline/node/a/status", encode(status("a", at(1))), at(1)))
        placed = placed_of()
        state.place(placed, None, None)
        found = re.search(r"```js\n(.*?)```", (REPOSITORY / "protocol" / "README.md").read_text(), re.DOTALL)
        assert found is not None
        program = tmp_path / "program.mjs"
        program.write_text(found[1].replace("http://127.0.0.1:8082", address))
        done = subprocess.run([node, program], capture_output=True, text=True, timeout=120, check=True)
        x, y, _ = placed.p_ned_m.tolist()
        first, second = done.stdout.splitlines()
        assert first == f"buddyline/node/a/status {at(1)}"
        valid, *numbers = second.split()
        assert valid == "true"
        assert [float(n) for n in numbers] == pytest.approx([x, y, 12.5, placed.sigma_m])

    def test_the_readme_s_c_reads_it(self, served: tuple[Answers, str], tmp_path: Path) -> None:
        compiler = shutil.which("cc") or shutil.which("gcc")
        if compiler is None:
            pytest.skip("no C compiler is installed")
        state, address = served
        placed = placed_of()
        state.place(placed, None, None)
        found = re.search(r"```c\n(.*?)```", (REPOSITORY / "protocol" / "README.md").read_text(), re.DOTALL)
        assert found is not None
        source, program = tmp_path / "program.c", tmp_path / "program"
        source.write_text(found[1].replace("8082", address.rpartition(":")[2]))
        flags = ["-std=gnu11", "-Wall", "-Wextra", "-Wno-unused-result"]
        subprocess.run([compiler, *flags, "-o", program, source], timeout=120, check=True)
        done = subprocess.run([program], capture_output=True, text=True, timeout=120, check=True)
        told = dict(line.replace('"', "").replace(":", "").split() for line in done.stdout.splitlines())
        x, y, _ = placed.p_ned_m.tolist()
        assert [float(told[name]) for name in ("x", "y", "z", "std")] == pytest.approx(
            [x, y, 12.5, placed.sigma_m], abs=1e-6
        )

    def test_a_page_of_another_site_does_not_read_it(self, served: tuple[Answers, str]) -> None:
        with pytest.raises(urllib.error.HTTPError, match="403"):
            get(f"{served[1]}/buddyline", Host="evil.example:80")
