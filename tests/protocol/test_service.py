"""A service's threads: a stuck one ends its process, with its name; a frozen process is not stuck."""

import subprocess
import sys
import textwrap
import threading

import pytest
from buddyline.protocol import service as module
from buddyline.protocol.service import STUCK_S, Service, StuckError

from tests.processes import PATIENCE_S, REPOSITORY


def test_a_stuck_thread_ends_its_process_with_its_name_and_a_status():
    program = textwrap.dedent(
        """
        import sys, threading
        from buddyline.protocol import service as module
        module.STUCK_S, module.WATCH_S, module.JOIN_TIMEOUT_S = 0.2, 0.05, 0.1
        module.start_logging()
        service = module.Service("node a")

        def detect():
            service.heartbeat()
            threading.Event().wait()

        def status():
            while not service.stop.wait(0.05):
                service.heartbeat()

        service.spawn("detect", detect)
        service.spawn("status", status)
        service.wait()
        sys.exit(service.join())
        """
    )
    ended = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, timeout=PATIENCE_S, check=False, cwd=REPOSITORY
    )
    assert ended.returncode == 1
    assert "node a: thread detect is stuck" in ended.stderr
    assert "in detect" in ended.stderr


def test_a_stuck_process_that_does_not_end_is_ended_by_force():
    program = textwrap.dedent(
        """
        import threading
        from buddyline.protocol import service as module
        module.STUCK_S, module.WATCH_S, module.END_ANYWAY_S = 0.2, 0.05, 0.2
        service = module.Service("node a")
        service.spawn("camera", lambda: (service.heartbeat(), threading.Event().wait()))
        service.wait()
        threading.Event().wait()  # as a device does that cannot be closed
        """
    )
    ended = subprocess.run(
        [sys.executable, "-c", program], timeout=PATIENCE_S, check=False, cwd=REPOSITORY, capture_output=True
    )
    assert ended.returncode == 1


@pytest.fixture
def watched(monkeypatch):
    """A service with one thread that went on once, at 100 s, and never again."""
    now = [100.0]
    monkeypatch.setattr(module.time, "monotonic", lambda: now[0])
    service = Service("test")
    monkeypatch.setattr(service, "_end_anyway", lambda: None)
    monkeypatch.setattr(module.faulthandler, "dump_traceback", lambda _: None)
    said, stop = threading.Event(), threading.Event()
    service.spawn("w", lambda: (service.heartbeat(), said.set(), stop.wait()))
    assert said.wait(PATIENCE_S)
    yield service
    stop.set()


def test_a_silent_thread_is_stuck_after_its_time(watched):
    watched._look_for_stuck(100.0 + STUCK_S - 0.1, 0.0)
    assert watched.failure is None
    watched._look_for_stuck(100.0 + STUCK_S + 0.1, 0.0)
    name, error = watched.failure
    assert (name, type(error)) == ("w", StuckError)


def test_a_process_that_was_frozen_is_not_stuck(watched):
    watched._look_for_stuck(101.0, 0.0)
    watched._look_for_stuck(1001.0, 900.0)
    watched._look_for_stuck(1001.2, 0.0)
    assert watched.failure is None
    watched._look_for_stuck(1002.0 + STUCK_S, 0.0)
    assert watched.failure is not None


def test_a_thread_whose_process_waits_for_a_processor_is_not_stuck(watched, monkeypatch):
    """One of its threads was ready to run for 0.9 of each second, and had no processor."""
    waited_s = {"1": 0.0, "2": 0.0}
    monkeypatch.setattr(module, "waited_for_processor_s", lambda: dict(waited_s))
    for second in range(1, 61):
        waited_s["1"] += 0.9
        watched._look_for_stuck(100.0 + second, 0.1)
    assert watched.failure is None
    for second in range(61, 61 + round(STUCK_S) + 1):
        watched._look_for_stuck(100.0 + second, 0.1)
    assert isinstance(watched.failure[1], StuckError)


@pytest.mark.skipif(sys.platform != "linux", reason="the kernel says how long a thread has waited")
def test_a_thread_at_work_on_a_busy_machine_is_not_stuck():
    """Its process has a tenth of a processor at most, and so needs 1.5 s for what takes it 0.15 s."""
    program = textwrap.dedent(
        """
        import os, subprocess, sys, time
        from buddyline.protocol import service as module
        module.STUCK_S = 1.0
        service = module.Service("solver")

        def work():
            service.heartbeat()
            ends_s = time.thread_time() + 0.15
            while time.thread_time() < ends_s:
                pass
            service.heartbeat()
            service.stop.set()

        os.sched_setaffinity(0, list(os.sched_getaffinity(0))[:1])
        with subprocess.Popen([sys.executable, "-c", "while True: pass"]) as other:
            os.nice(10)
            service.spawn("work", work)
            service.wait()
            other.kill()
        sys.exit(service.join())
        """
    )
    ended = subprocess.run(
        [sys.executable, "-c", program], timeout=PATIENCE_S, check=False, cwd=REPOSITORY, capture_output=True
    )
    assert ended.returncode == 0, ended.stderr


def test_a_signal_ends_a_service_that_waits():
    """The signal comes while the main thread holds the lock of the event that the handler is to set."""
    program = """
import os, signal
from buddyline.protocol.service import Service
service = Service("test")
service.handle_signals()
with service.stop._cond:
    os.kill(os.getpid(), signal.SIGTERM)
    for _ in range(1000):
        pass
service.wait()
"""
    ended = subprocess.run([sys.executable, "-c", program], timeout=PATIENCE_S, check=False)
    assert ended.returncode == 0
