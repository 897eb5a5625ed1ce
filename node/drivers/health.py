"""How a device is: said once when it changes, and asked for at any time."""

from __future__ import annotations

import logging

log = logging.getLogger(__name__)


class DeviceHealth:
    """What is wrong with one device. problem: "" where all is well."""

    def __init__(self, name: str) -> None:
        self.problem = ""
        self._name = name

    def update(self, problem: str) -> None:
        """Take note of how it is now."""
        if problem and not self.problem:
            log.warning("%s: %s", self._name, problem)
        elif self.problem and not problem:
            log.info("%s: back to normal", self._name)
        self.problem = problem
