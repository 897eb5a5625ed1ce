"""What makes Raspberry Pi OS a node: packages, lines of config.txt, files; `setup pi` and `image` have it from here."""

from __future__ import annotations

import argparse
import ipaddress
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Final

from buddyline.protocol.config import ConfigError
from buddyline.protocol.errors import BuddylineError

if TYPE_CHECKING:
    from buddyline.node.config import NodeConfig

# node/README.md, Install, lists the same; a test compares them.
PACKAGES: Final = (
    "git", "make", "chrony", "python3-venv", "python3-dev", "build-essential", "python3-picamera2", "python3-lgpio",
    "i2c-tools",
)  # fmt: skip
FIRST_ADDRESS: Final = "192.168.2.2"
BEGIN: Final = "# buddyline: begin"
END: Final = "# buddyline: end"
CLOCK_CHIPS: Final = {
    "none": (),
    "pi5": ("dtparam=rtc_bbat_vchg=3000000",),
    "ds3231": ("dtoverlay=i2c-rtc,ds3231",),
}
POWER_OFF: Final = """\
polkit.addRule(function(action, subject) {{
    if (action.id.startsWith("org.freedesktop.login1.power-off") && subject.user == "{user}") return "yes";
}});
"""
# Of NetworkManager, which Raspberry Pi OS has from Bookworm on.
TETHER: Final = """\
[connection]
id=buddyline
type=ethernet
interface-name=eth0
autoconnect-priority=100

[ipv4]
method=manual
address1={address}

[ipv6]
method=link-local
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare what the card and the running Pi are told alike."""
    parser.add_argument(
        "--config",
        required=True,
        metavar="FILE.toml",
        help="the node's configuration; `image` needs the files of its [tls] beside it",
    )
    parser.add_argument(
        "--clock-from", metavar="IP", help="the node whose clock this one follows; default: 192.168.2.2, a's"
    )
    parser.add_argument(
        "--clock-chip", choices=tuple(CLOCK_CHIPS), default="none", help="a clock with a battery; default: %(default)s"
    )


def load(path: str) -> NodeConfig:
    """Return a node's configuration; raise ConfigError for a simulated node."""
    from buddyline.node.config import load_node_config

    config = load_node_config(path)
    if config.camera.name == "simulated":
        raise ConfigError(f"{path}: camera.name = 'simulated': a node on a Pi has a real one")
    return config


def extras(config: NodeConfig) -> str:
    """Return the extras that a node's program needs: a node with a certificate signs its log by the extra `keys`."""
    return "pi" if config.tls is None else "keys,pi"


def config_lines(config: NodeConfig, clock_chip: str) -> list[str]:
    """Return the lines of config.txt: buses, camera, watchdog, clock chip, and a lamp that is on from power-on."""
    lines = ["dtparam=i2c_arm=on", "dtparam=watchdog=on", "camera_auto_detect=1", *CLOCK_CHIPS[clock_chip]]
    if config.panel.lamp_pin is not None:
        lines.append(f"gpio={config.panel.lamp_pin}=op,dh")
    return lines


def with_block(text: str, lines: list[str]) -> str:
    """Return config.txt with our lines at its end, for every model, in place of those written before."""
    before, found, rest = text.partition(f"{BEGIN}\n")
    if found:
        before += rest.partition(f"{END}\n")[2]
    before = before if not before or before.endswith("\n") else before + "\n"
    return before + "\n".join([BEGIN, "[all]", *lines, END]) + "\n"


def system_files(config: NodeConfig, user: str, clock_from: str | None) -> dict[str, str]:
    """Return the text of each file in /etc: chrony's, the module of the I2C bus, and the right to shut down."""
    files = {
        "/etc/chrony/chrony.conf": _chrony_conf(config, clock_from),
        "/etc/modules-load.d/i2c.conf": "i2c-dev\n",
    }
    if config.panel.shutdown_command:
        files["/etc/polkit-1/rules.d/50-buddyline.rules"] = POWER_OFF.format(user=user)
    return files


def address_of(config: NodeConfig, text: str | None) -> ipaddress.IPv4Interface:
    """Return the node's address on the tether: as given, else the usual one of a and b."""
    text = text or {"a": "192.168.2.2/24", "b": "192.168.2.3/24"}.get(config.node)
    if text is None:
        raise BuddylineError(f"--address IP/BITS: node {config.node} has no usual one")
    try:
        return ipaddress.IPv4Interface(text)
    except ValueError as error:
        raise BuddylineError(f"--address {text}: {error}") from error


def ip(option: str, text: str) -> ipaddress.IPv4Address:
    """Return the address that an option gives; raise BuddylineError for what is none."""
    try:
        return ipaddress.IPv4Address(text)
    except ValueError as error:
        raise BuddylineError(f"{option} {text}: {error}") from error


def read_text(path: Path) -> str:
    """Return a file's text; raise BuddylineError where it cannot be read."""
    try:
        return path.read_text()
    except (OSError, UnicodeDecodeError) as error:
        raise BuddylineError(f"{path}: cannot be read: {error}") from error


def replace_file(path: Path, text: str, mode: int | None = None) -> None:
    """Write a file of the system; one with other contents is kept as NAME.before, NAME.before2 and so on."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.exists() and path.read_bytes() != text.encode():
            path.rename(_free(path.with_name(f"{path.name}.before")))
        path.write_text(text)
        if mode is not None:
            path.chmod(mode)
    except OSError as error:
        raise BuddylineError(f"{path}: cannot be written: {error.strerror}") from error


def _free(path: Path) -> Path:
    """Return the path, or the first of PATH2, PATH3 ... that does not exist."""
    names = (path, *(path.with_name(f"{path.name}{number}") for number in range(2, 1000)))
    return next(one for one in names if not one.exists())


def _chrony_conf(config: NodeConfig, clock_from: str | None) -> str:
    """Return chrony's configuration: a serves its clock, all others follow."""
    examples = resources.files("buddyline.node") / "examples"
    if clock_from is None and config.node == "a":
        return (examples / "chrony-a.conf").read_text()
    text = (examples / "chrony-b.conf").read_text()
    return text.replace(FIRST_ADDRESS, str(ip("--clock-from", clock_from or FIRST_ADDRESS)))
