"""A device's health: each change is logged once, and the present state can be read at any time."""

from __future__ import annotations

import logging

log = logging.getLogger(__name__)


class DeviceHealth:
    """The health of one device. problem: what is wrong; "" if nothing."""

    def __init__(self, name: str) -> None:
        self.problem = ""
        self._name = name

    def update(self, problem: str) -> None:
        """Take the present problem ("" for none); log it if it has changed."""
        if problem and not self.problem:
            log.warning("%s: %s", self._name, problem)
        elif self.problem and not problem:
            log.info("%s: back to normal", self._name)
        self.problem = problem
