"""One node as `buddyline node` runs it, with the devices of the soak: `python -m tests.soak.node --config a.toml`."""

import sys

from buddyline.node import devices
from buddyline.node.__main__ import main

if __name__ == "__main__":
    for registry, opens in ((devices.CAMERAS, "open_camera"), (devices.SENSORS, "open_sensors")):
        registry["repeating"] = f"tests.soak.devices:{opens}"
    sys.exit(main())
