"""Shut down a TCP connection of this process that a library holds."""

from __future__ import annotations

import os
import socket
from typing import Final

_DESCRIPTORS: Final = "/proc/self/fd"


def cut_connection(host: str, port: int) -> bool:
    """Shut down this process's connection with the local address host:port.

    The library finds it broken at its next read or write. Returns False if there is no such connection or no /proc.
    """
    try:
        descriptors = os.listdir(_DESCRIPTORS)
    except OSError:
        return False
    for descriptor in descriptors:
        try:
            if not os.readlink(f"{_DESCRIPTORS}/{descriptor}").startswith("socket:"):
                continue
            # A copy, because closing it must not close the owner's descriptor.
            with socket.socket(fileno=os.dup(int(descriptor))) as connection:
                if connection.type == socket.SOCK_STREAM and connection.getsockname()[:2] == (host, port):
                    connection.shutdown(socket.SHUT_RDWR)
                    return True
        except OSError:
            # The descriptor was closed meanwhile, or its kind of socket has no address.
            continue
    return False
