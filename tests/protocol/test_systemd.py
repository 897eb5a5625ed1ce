"""Notifications to systemd: datagrams on a real socket, and none if nobody listens."""

import secrets
import socket

import pytest
from buddyline.protocol.service import Service
from buddyline.protocol.systemd import MAX_TEXT, Notifier

from tests.processes import PATIENCE_S


@pytest.fixture(params=["path", "abstract"])
def manager(request, tmp_path, monkeypatch):
    """The manager's end, as systemd makes it: in the file system, or abstract."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listening:
        name = str(tmp_path / "notify") if request.param == "path" else f"@buddyline-{secrets.token_hex(8)}"
        listening.bind("\0" + name[1:] if name[0] == "@" else name)
        listening.settimeout(PATIENCE_S)
        monkeypatch.setenv("NOTIFY_SOCKET", name)
        yield listening


def test_each_notification_is_a_datagram(manager):
    notifier = Notifier()
    notifier.ready()
    notifier.tell("all is\nwell", feed_watchdog=True)
    notifier.tell("x" * 1000, feed_watchdog=False)
    notifier.stopping()
    said = [manager.recv(4096).decode() for _ in range(4)]
    assert said == ["READY=1", "WATCHDOG=1\nSTATUS=all is well", f"STATUS={'x' * MAX_TEXT}", "STOPPING=1"]


def test_a_service_reports_ready_alive_and_stopping(manager):
    service = Service("hub")
    service.wait(0.0)
    assert service.join() == 0
    assert manager.recv(4096) == b"READY=1"
    assert manager.recv(4096).startswith(b"WATCHDOG=1\n")
    assert manager.recv(4096) == b"STOPPING=1"


def test_a_service_that_does_not_progress_leaves_the_watchdog_alone(manager):
    class Hanging(Service):
        def progressing(self):
            return False

    service = Hanging("node a")
    service.problems = ["camera: nothing for 7 s"]
    service.wait(0.0)
    service.join()
    assert manager.recv(4096) == b"READY=1"
    assert manager.recv(4096) == b"STATUS=camera: nothing for 7 s"
    assert manager.recv(4096) == b"STOPPING=1"


@pytest.mark.parametrize("address", [None, "", "vsock:2:1234", "/nowhere/at/all"])
def test_without_a_manager_nothing_is_sent(monkeypatch, address):
    if address is None:
        monkeypatch.delenv("NOTIFY_SOCKET", raising=False)
    else:
        monkeypatch.setenv("NOTIFY_SOCKET", address)
    notifier = Notifier()
    notifier.ready()
    notifier.tell("", feed_watchdog=True)
    notifier.stopping()
    assert notifier._socket is None


def test_a_vanished_service_manager_does_not_stop_the_service(manager):
    notifier = Notifier()
    manager.close()
    notifier.ready()
    notifier.tell("well", feed_watchdog=True)
    notifier.stopping()
