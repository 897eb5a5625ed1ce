"""The program, with a camera and sensors that stop for as long as a file is there: STALL_IN/camera, STALL_IN/imu.

All time limits are shorter than in the program, so that a test need not wait for seconds.
"""

import os
import sys
from pathlib import Path

from buddyline.node import service
from buddyline.node.devices import CAMERAS, SENSORS
from buddyline.node.sim import devices as simulated
from buddyline.protocol import recorder
from buddyline.protocol import service as threads


def _hold(name, stop):
    while (Path(os.environ["STALL_IN"]) / name).exists() and not stop.wait(0.01):
        pass


def open_camera(config, clock):
    camera = simulated.open_camera(config, clock)
    plain = camera.next_frame

    def next_frame(stop):
        _hold("camera", stop)
        return plain(stop)

    camera.next_frame = next_frame
    return camera


def open_sensors(config, clock):
    sources = simulated.open_sensors(config, clock)
    (imu,) = (source for source in sources if source.name == "imu")
    plain = imu.next_messages

    def next_messages(stop):
        _hold("imu", stop)
        return plain(stop)

    imu.next_messages = next_messages
    return sources


def main():
    CAMERAS["stalling"] = "tests.node.stalling_node:open_camera"
    SENSORS["stalling"] = "tests.node.stalling_node:open_sensors"
    service.HANGS_S, service.REPORT_S, threads.BEAT_S = 0.6, 0.2, 0.2
    service.stale_after_s = lambda topic, period_s=0.0: 0.4
    recorder.SYNC_INTERVAL_S, recorder.RETRY_S = 0.2, 0.1
    from buddyline.tools.cli import main as program

    return program()


if __name__ == "__main__":
    sys.exit(main())
