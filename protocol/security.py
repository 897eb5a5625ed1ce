"""Check the TLS identities of the bus before use, so that errors name the wrong file and what is wrong with it.

Zenoh reports every refusal as a failure to connect. Here Python's ssl makes two test handshakes: one within this
process, which finds faults of the identity, and one with the hub, which finds the hub's reason to refuse.
"""

from __future__ import annotations

import socket
import ssl
import stat
from pathlib import Path
from typing import Final

from buddyline.protocol.config import Config
from buddyline.protocol.endpoint import host_and_port
from buddyline.protocol.errors import BuddylineError
from msgspec.structs import replace

HUB: Final = "hub"
SOLVER: Final = "solver"
VIEWER: Final = "viewer"
SURVEYOR: Final = "surveyor"
PLAYER: Final = "player"
ROS: Final = "ros2"

PROBE_S: Final = 1.0

_VERIFY_WORDS: Final = {
    "certificate has expired": "has expired",
    "certificate is not yet valid": "is not valid yet (is this machine's clock right?)",
    "unsuitable certificate purpose": "is not for this end of the connection (a hub's and a client's differ)",
}
_ALERT_WORDS: Final = {
    "EXPIRED": "has expired",
    "UNKNOWN_CA": "is of another authority than the hub's",
    "DECRYPT_ERROR": "is of another authority than the hub's",
    "BAD_CERTIFICATE": "is of another authority than the hub's",
    "UNSUPPORTED_CERTIFICATE": "is not for a client",
    "CERTIFICATE_REQUIRED": "was not sent",
}


class SecurityError(BuddylineError):
    """An identity that cannot be used."""


class RefusedError(BuddylineError):
    """The hub refuses this client, or this client refuses the hub; another attempt would fail in the same way."""


class Tls(Config, frozen=True, kw_only=True):
    """[tls]: PEM files of the authority, this process's certificate, and its private key (mode 0600)."""

    ca: str
    certificate: str
    key: str

    def beside(self, path: Path | str) -> Tls:
        """Return a copy with relative file names resolved against the directory of the configuration at path."""
        directory = Path(path).parent
        return replace(
            self,
            ca=str(directory / self.ca),
            certificate=str(directory / self.certificate),
            key=str(directory / self.key),
        )


def node_name(node: str) -> str:
    """Return the common name in a node's certificate. Node ids have no hyphen, so it equals no other role's name."""
    return f"node-{node}"


def check_identity(tls: Tls, expected: str) -> None:
    """Raise SecurityError, naming the file and its fault, unless `tls` is a valid identity of the role `expected`."""
    for path in (tls.ca, tls.certificate, tls.key):
        try:
            Path(path).read_bytes()
        except OSError as error:
            raise SecurityError(f"{path}: cannot be read: {error.strerror}") from error
    if stat.S_IMODE(Path(tls.key).stat().st_mode) & 0o077:
        raise SecurityError(f"{tls.key}: a private key that others can read; `chmod 600 {tls.key}`")
    server, client = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER), ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    client.check_hostname = False
    client.verify_mode = ssl.CERT_NONE
    judge = client if expected == HUB else server
    _trust(judge, tls)
    for side in (server, client):
        _show(side, tls)
    try:
        subject = _name_shown(server, client, judged_by_client=judge is client)
    except ssl.SSLCertVerificationError as error:
        words = _VERIFY_WORDS.get(error.verify_message, f"was not made by the authority in {tls.ca}")
        raise SecurityError(f"{tls.certificate}: {words}") from error
    except ssl.SSLError as error:
        raise SecurityError(f"{tls.certificate}: cannot be used: {error.reason}") from error
    if subject != expected:
        raise SecurityError(f"{tls.certificate}: is the certificate of {subject!r}, and {expected!r} is needed here")


def refusal(endpoint: str, tls: Tls | None) -> str | None:
    """Return why the hub at endpoint refuses this client, or this client the hub; None if neither does.

    A reason is a rejected certificate, or a hub that requires TLS. Everything else may pass, and the client waits: no
    answer, a connection that closes during the handshake, a hub without TLS.
    """
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.check_hostname = False
    context.verify_mode = ssl.CERT_NONE
    if tls is not None:
        _trust(context, tls)
        _show(context, tls)
    try:
        with socket.create_connection(host_and_port(endpoint), PROBE_S) as raw, context.wrap_socket(raw) as link:
            if tls is None:
                return f"the hub at {endpoint} wants TLS: connect to tls/..., with a [tls] table (`buddyline keys`)"
            # A hub that refuses sends its alert only after its own side of the handshake is complete.
            link.recv(1)
    except ssl.SSLCertVerificationError as error:
        words = _VERIFY_WORDS.get(error.verify_message, "was not made by our authority, or is another server's")
        return f"the certificate of the hub at {endpoint} {words}"
    except ssl.SSLError as error:
        if tls is None:
            return None
        reason = error.reason or ""
        said = next((words for alert, words in _ALERT_WORDS.items() if alert in reason), None)
        # Only these alerts are a verdict on the certificate. OpenSSL's other texts differ from version to version.
        if said is None:
            return None
        return f"the hub at {endpoint} refuses {tls.certificate}: it {said}"
    except OSError:
        return None
    return None


def _trust(context: ssl.SSLContext, tls: Tls) -> None:
    try:
        context.load_verify_locations(tls.ca)
    except ssl.SSLError as error:
        raise SecurityError(f"{tls.ca}: is not a certificate in PEM") from error
    context.verify_mode = ssl.CERT_REQUIRED


def _show(context: ssl.SSLContext, tls: Tls) -> None:
    try:
        ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT).load_verify_locations(tls.certificate)
    except ssl.SSLError as error:
        raise SecurityError(f"{tls.certificate}: is not a certificate in PEM") from error
    try:
        # With an empty password, a protected key is an error; without one, ssl would ask for it at the terminal.
        context.load_cert_chain(tls.certificate, tls.key, password="")
    except ssl.SSLError as error:
        if error.reason == "KEY_VALUES_MISMATCH":
            raise SecurityError(f"{tls.key}: is not the key of {tls.certificate}") from error
        raise SecurityError(f"{tls.key}: is not a private key in PEM without a password") from error


def _name_shown(server: ssl.SSLContext, client: ssl.SSLContext, *, judged_by_client: bool) -> str:
    """Make a TLS handshake within this process; return the common name that one side sent to the other."""
    to_server, to_client = ssl.MemoryBIO(), ssl.MemoryBIO()
    called = server.wrap_bio(to_server, to_client, server_side=True)
    caller = client.wrap_bio(to_client, to_server)
    waiting = [caller, called]
    while waiting:
        side = waiting.pop(0)
        try:
            side.do_handshake()
        except ssl.SSLWantReadError:
            waiting.append(side)
    shown = (caller if judged_by_client else called).getpeercert() or {}
    names: list[str] = []
    for part in shown.get("subject", ()):
        for field in part:
            if isinstance(field, tuple) and field[0] == "commonName":
                names.append(str(field[1]))
    return names[0] if names else ""
