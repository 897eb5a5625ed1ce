"""Keys for tests: an authority with every identity, made once, invalid identities, and clients that use them."""

from __future__ import annotations

import shutil
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

from buddyline.protocol.security import Tls
from buddyline.protocol.zenoh_bus import ZenohBus, connect
from buddyline.tools.cli import main
from buddyline.tools.installation.authority import Authority

from tests.processes import free_endpoint


def make_keys(directory: Path, *nodes: str) -> Path:
    """Make an authority and everyone's certificates, as a person does."""
    roles = (["solver"], ["viewer"], ["surveyor"], ["player"], ["ros2"])
    for words in (["init"], *(["node", node] for node in nodes), *roles):
        assert main(["keys", "--directory", str(directory), *words]) == 0
    return directory


def expired(keys: Path, name: str, host: str | None = None) -> None:
    """Put an expired certificate in the place of a sound one."""
    for ending in ("crt", "key"):
        (keys / f"{name}.{ending}").unlink()
    Authority.open(keys).issue(name, -1, server_host=host)


def tls(keys: Path, name: str) -> Tls:
    return Tls(ca=str(keys / "ca.crt"), certificate=str(keys / f"{name}.crt"), key=str(keys / f"{name}.key"))


def copy_of(keys: Path, to: Path) -> Path:
    shutil.copytree(keys, to)
    return to


def at(keys: Path, endpoint: str) -> str:
    """Put a free endpoint in the place of the one that all configurations have; return it."""
    for path in keys.glob("*.toml"):
        text = path.read_text().replace("tls/0.0.0.0:7447", endpoint).replace("tls/127.0.0.1:7447", endpoint)
        path.write_text(text)
    return endpoint


def tls_endpoint() -> str:
    return free_endpoint().replace("tcp/", "tls/")


def join(endpoint: str, identity: Tls | None) -> ZenohBus:
    bus = connect(endpoint, stop=threading.Event(), on_wait=lambda _: None, tls=identity)
    assert bus is not None
    return bus


@contextmanager
def joined(endpoint: str, keys: Path, *names: str) -> Iterator[list[ZenohBus]]:
    """One client for each of these certificates."""
    with ExitStack() as clients:
        yield [clients.enter_context(join(endpoint, tls(keys, name))) for name in names]
