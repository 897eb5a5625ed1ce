"""A TCP connection of this process that a library holds: what the kernel knows of it, and how to shut it down."""

from __future__ import annotations

import contextlib
import fcntl
import os
import socket
import struct
import termios
from collections.abc import Iterator
from typing import Final, NamedTuple, Self

_DESCRIPTORS: Final = "/proc/self/fd"
# Linux's struct tcp_info: the offset and format of what is read of it.
_INFO_BYTES: Final = 232
_STATE: Final = (0, "B")
_RTT_US: Final = (68, "I")
_MIN_RTT_US: Final = (148, "I")
_ACKED: Final = (120, "Q")
_RECEIVED: Final = (128, "Q")
_NOT_SENT: Final = (144, "I")
_SENT: Final = (200, "Q")
_SENT_AGAIN: Final = (208, "Q")
_ESTABLISHED: Final = 1
# A link with a longer round trip is treated as a long one: a tether over radio or a modem, not a cable.
LONG_RTT_S: Final = 0.05
# Of Linux; Python's socket module does not have it.
_TCP_NOTSENT_LOWAT: Final = 25


class TcpState(NamedTuple):
    """Counts of one connection. acked: bytes that the other end has acknowledged. waiting: bytes not yet sent.

    received: bytes that have arrived. unread: of these, bytes that the library has not taken. min_rtt_s: shortest
    round trip of late; rtt_s: smoothed over some packets that were not lost. sent: bytes that were sent, each counted
    once; sent_again: those of later attempts.
    """

    acked: int
    waiting: int
    received: int
    unread: int
    min_rtt_s: float
    rtt_s: float
    sent: int
    sent_again: int

    @property
    def is_long(self) -> bool:
        """Whether the round trip is long."""
        return self.min_rtt_s > LONG_RTT_S


class Connection:
    """A second descriptor of a connection; a context manager that closes it, not the library's."""

    def __init__(self, connection: socket.socket) -> None:
        self._socket = connection

    @classmethod
    def find(cls, host: str, port: int) -> Self | None:
        """Return this process's connection with the local address host:port; None if there is none, or no /proc."""
        for connection in _connections():
            with contextlib.suppress(OSError):  # its kind of socket has no address
                if connection.getsockname()[:2] == (host, port):
                    return cls(socket.socket(fileno=os.dup(connection.fileno())))
        return None

    def hold_back(self, waiting_bytes: int) -> None:
        """Let the kernel take no more than this ahead of what it sends, so that urgent messages can overtake others."""
        with contextlib.suppress(OSError):
            self._socket.setsockopt(socket.IPPROTO_TCP, _TCP_NOTSENT_LOWAT, waiting_bytes)

    def bear_losses(self) -> None:
        """Send at the rate that gets through (BBR), if the kernel has it: others take each loss for congestion."""
        with contextlib.suppress(OSError, AttributeError):
            self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_CONGESTION, b"bbr")

    def cork(self) -> None:
        """Send what waits; let later small messages wait for others, for 0.2 s at most, or until a packet is full."""
        with contextlib.suppress(OSError, AttributeError):
            self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_CORK, 0)
            self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_CORK, 1)

    def state(self) -> TcpState | None:
        """Return what the kernel counts; None if the connection has ended, or the kernel does not tell."""
        try:
            info = self._socket.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, _INFO_BYTES)
            unread = struct.unpack("i", fcntl.ioctl(self._socket, termios.FIONREAD, bytes(4)))[0]
        except (OSError, AttributeError):
            return None
        if len(info) < _SENT_AGAIN[0] + 8 or _field(info, _STATE) != _ESTABLISHED:
            return None
        sent_again = _field(info, _SENT_AGAIN)
        return TcpState(
            acked=_field(info, _ACKED),
            waiting=_field(info, _NOT_SENT),
            received=_field(info, _RECEIVED),
            unread=unread,
            min_rtt_s=_field(info, _MIN_RTT_US) * 1e-6,
            rtt_s=_field(info, _RTT_US) * 1e-6,
            sent=_field(info, _SENT) - sent_again,
            sent_again=sent_again,
        )

    def cut(self) -> bool:
        """Shut the connection down: the library finds it broken at its next read or write. False: it had ended."""
        try:
            self._socket.shutdown(socket.SHUT_RDWR)
        except OSError:
            return False
        return True

    def close(self) -> None:
        """Close this descriptor."""
        self._socket.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def close_without_wait() -> None:
    """Let no later close of a connection of this process wait for what is not sent; the kernel goes on to send it.

    Zenoh (1.10) closes with SO_LINGER of ten seconds, in the few threads that receive for all connections: one link
    that is cut would hold up all others for that time.
    """
    for connection in _connections():
        with contextlib.suppress(OSError):
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 0, 0))


def _connections() -> Iterator[socket.socket]:
    """Yield a copy of each TCP socket of this process, and close it afterwards; none if there is no /proc."""
    try:
        descriptors = os.listdir(_DESCRIPTORS)
    except OSError:
        return
    for descriptor in descriptors:
        try:
            if not os.readlink(f"{_DESCRIPTORS}/{descriptor}").startswith("socket:"):
                continue
            # A copy, because closing it must not close the owner's descriptor.
            connection = socket.socket(fileno=os.dup(int(descriptor)))
        except OSError:
            # The descriptor was closed meanwhile.
            continue
        with connection:
            if connection.type == socket.SOCK_STREAM and connection.family in (socket.AF_INET, socket.AF_INET6):
                yield connection


def _field(info: bytes, place: tuple[int, str]) -> int:
    return int(struct.unpack_from(place[1], info, place[0])[0])
