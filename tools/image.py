"""`buddyline image`: what makes a fresh card with Raspberry Pi OS into a node at its first start.

The operating system is not touched: Raspberry Pi Imager, or rpi-image-gen, writes it. cloud-init, which Raspberry Pi OS
has from its Trixie images on, reads user-data, network-config and meta-data from the boot partition. All three are
written as JSON, which is YAML, too.
"""

from __future__ import annotations

import argparse
import ipaddress
import json
import re
import tomllib
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from buddyline.protocol.clock import S_NS
from buddyline.protocol.config import ConfigError
from buddyline.protocol.errors import BuddylineError

if TYPE_CHECKING:
    from buddyline.node.config import NodeConfig

# As in node/README.md, Install.
PACKAGES: Final = (
    "git", "make", "chrony", "python3-venv", "python3-dev", "build-essential", "python3-picamera2", "python3-lgpio",
    "i2c-tools",
)  # fmt: skip
GROUPS: Final = ("sudo", "video", "i2c", "gpio")
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
USER: Final = re.compile(r"[a-z_][a-z0-9_-]{0,31}\Z")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument("boot", metavar="BOOT", help="the card's boot partition, where it is mounted; or any folder")
    parser.add_argument("--config", required=True, metavar="FILE.toml", help="the node's, with its certificate beside")
    parser.add_argument("--source", required=True, metavar="URL", help="your copy of this repository, for git clone")
    parser.add_argument("--ssh-key", required=True, metavar="FILE.pub", help="the public key with which you log in")
    parser.add_argument("--address", metavar="IP/BITS", help="on the tether; default: 192.168.2.2/24 for a, .3 for b")
    parser.add_argument("--gateway", metavar="IP", help="on the tether: a machine that shares its Internet connection")
    parser.add_argument("--wifi", metavar="NAME", help="a wireless network, for the first start's downloads")
    parser.add_argument("--wifi-password", metavar="FILE", help="a file that holds its password")
    parser.add_argument("--country", default="NO", metavar="CC", help="of the wireless network; default: %(default)s")
    parser.add_argument("--clock-from", metavar="IP", help="the node whose clock this one follows; default: a's")
    parser.add_argument("--clock-chip", choices=tuple(CLOCK_CHIPS), default="none", help="default: %(default)s")
    parser.add_argument("--user", default="diver", help="who runs the node; default: %(default)s")


def run(args: argparse.Namespace) -> int:
    """Write the files; say what is there and what comes next."""
    from buddyline.node.config import load_node_config

    boot = Path(args.boot)
    if not boot.is_dir():
        raise BuddylineError(f"{boot}: no such folder: mount the card's boot partition, and name that")
    if not USER.match(args.user):
        raise BuddylineError(f"--user {args.user}: not a user's name")
    config = load_node_config(args.config)
    if config.camera.name == "simulated":
        raise ConfigError(f"{args.config}: camera.name = 'simulated': a node on a Pi has a real one")
    files = {
        "user-data": f"#cloud-config\n{_json(user_data(args, config))}",
        "network-config": _json(network(args, config)),
        "meta-data": _json({"instance-id": f"buddyline-{config.node}-{config_id(args)}"}),
    }
    for name, text in files.items():
        _write(boot / name, text)
    settings = boot / "config.txt"
    _write(settings, with_block(_text(settings) if settings.exists() else "", config_lines(args, config)))
    print(
        f"{boot}: user-data, network-config, meta-data, config.txt for node {config.node}\n"
        "next: unmount, start the Pi, and wait 10 to 20 minutes; then\n"
        f"  ssh {args.user}@{_address(args, config).ip} cloud-init status --long"
    )
    return 0


def user_data(args: argparse.Namespace, config: NodeConfig) -> dict[str, Any]:
    """Return cloud-init's user-data: the user, the packages, the node's files, and the commands of the README."""
    home = f"/home/{args.user}"
    folder = f"{home}/buddyline"
    mine = ["sudo", "-u", args.user, "-H"]
    files = [_file(f"{home}/{name}", text, args.user, "0600") for name, text in _own_files(Path(args.config)).items()]
    files += [
        _file("/etc/chrony/chrony.conf", chrony_conf(args, config)),
        _file("/etc/modules-load.d/i2c.conf", "i2c-dev\n"),
    ]
    if config.panel.shutdown_command:
        files.append(_file("/etc/polkit-1/rules.d/50-buddyline.rules", POWER_OFF.format(user=args.user)))
    name = Path(args.config).name
    commands = [
        [*mine, "git", "clone", args.source, folder],
        [*mine, "make", "-C", folder, "install", "EXTRAS=pi"],
        ["install", "-d", "-o", args.user, config.record.directory],
        [f"{folder}/.venv/bin/buddyline", "install-service", "node", "--config", f"{home}/{name}",
         "--run-as", args.user],
        ["systemctl", "daemon-reload"],
        ["systemctl", "restart", "chrony"],
        ["systemctl", "enable", "--now", "buddyline-node"],
    ]  # fmt: skip
    return {
        "hostname": f"buddyline-{config.node}".replace("_", "-"),
        "users": [
            {
                "name": args.user,
                "groups": list(GROUPS),
                "shell": "/bin/bash",
                "sudo": "ALL=(ALL) NOPASSWD:ALL",
                "lock_passwd": True,
                "ssh_authorized_keys": [_public_key(Path(args.ssh_key))],
            }
        ],
        "ssh_pwauth": False,
        "package_update": True,
        "packages": list(PACKAGES),
        "write_files": files,
        "runcmd": commands,
    }


def network(args: argparse.Namespace, config: NodeConfig) -> dict[str, Any]:
    """Return netplan's configuration: a fixed address on the tether, and the wireless network of the first start."""
    tether: dict[str, Any] = {"addresses": [str(_address(args, config))], "dhcp4": False, "optional": True}
    if args.gateway:
        gateway = str(_ip("--gateway", args.gateway))
        tether |= {"routes": [{"to": "default", "via": gateway}], "nameservers": {"addresses": [gateway]}}
    found: dict[str, Any] = {"version": 2, "ethernets": {"eth0": tether}}
    if bool(args.wifi) != bool(args.wifi_password):
        raise BuddylineError("--wifi and --wifi-password go together")
    if args.wifi:
        password = _text(Path(args.wifi_password)).strip()
        found["wifis"] = {
            "wlan0": {
                "dhcp4": True,
                "optional": True,
                "regulatory-domain": args.country,
                "access-points": {args.wifi: {"password": password}},
            }
        }
    elif not args.gateway:
        raise BuddylineError("--wifi or --gateway: the first start downloads packages and the repository")
    return {"network": found}


def config_lines(args: argparse.Namespace, config: NodeConfig) -> list[str]:
    """Return the lines of config.txt: buses, camera, watchdog, clock chip, and a lamp that is on from power-on."""
    lines = ["dtparam=i2c_arm=on", "dtparam=watchdog=on", "camera_auto_detect=1", *CLOCK_CHIPS[args.clock_chip]]
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


def chrony_conf(args: argparse.Namespace, config: NodeConfig) -> str:
    """Return chrony's configuration: a serves its clock, all others follow."""
    examples = resources.files("buddyline.node") / "examples"
    if args.clock_from is None and config.node == "a":
        return (examples / "chrony-a.conf").read_text()
    text = (examples / "chrony-b.conf").read_text()
    return text.replace(FIRST_ADDRESS, str(_ip("--clock-from", args.clock_from or FIRST_ADDRESS)))


def config_id(args: argparse.Namespace) -> str:
    """Return what changes with the configuration: cloud-init runs again where it has changed."""
    return str(Path(args.config).stat().st_mtime_ns // S_NS)


def _own_files(config: Path) -> dict[str, str]:
    """Return the configuration, and the files of its [tls], which must be beside it."""
    text = _text(config)
    files = {config.name: text}
    for name in tomllib.loads(text).get("tls", {}).values():
        if Path(name).name != name:
            raise ConfigError(f"{config}: [tls] {name}: for a card, give the name of a file beside the configuration")
        files[name] = _text(config.parent / name)
    return files


def _public_key(path: Path) -> str:
    key = _text(path).strip()
    if "PRIVATE KEY" in key or len(key.split()) < 2 or "\n" in key:
        raise BuddylineError(f"{path}: is no public key: one line, as in ~/.ssh/id_ed25519.pub")
    return key


def _address(args: argparse.Namespace, config: NodeConfig) -> ipaddress.IPv4Interface:
    text = args.address or {"a": "192.168.2.2/24", "b": "192.168.2.3/24"}.get(config.node)
    if text is None:
        raise BuddylineError(f"--address IP/BITS: node {config.node} has no usual one")
    try:
        return ipaddress.IPv4Interface(text)
    except ValueError as error:
        raise BuddylineError(f"--address {text}: {error}") from error


def _ip(option: str, text: str) -> ipaddress.IPv4Address:
    try:
        return ipaddress.IPv4Address(text)
    except ValueError as error:
        raise BuddylineError(f"{option} {text}: {error}") from error


def _file(path: str, content: str, owner: str = "root", mode: str = "0644") -> dict[str, Any]:
    # Deferred: after the packages whose configuration it replaces, and after the user exists.
    return {"path": path, "content": content, "owner": f"{owner}:{owner}", "permissions": mode, "defer": True}


def _json(value: dict[str, Any]) -> str:
    return json.dumps(value, indent=2) + "\n"


def _text(path: Path) -> str:
    try:
        return path.read_text()
    except (OSError, UnicodeDecodeError) as error:
        raise BuddylineError(f"{path}: cannot be read: {error}") from error


def _write(path: Path, text: str) -> None:
    """Write a file of the card; one with other contents is kept as NAME.before, the first of them."""
    try:
        if path.exists() and path.read_bytes() != text.encode():
            kept = path.with_name(f"{path.name}.before")
            if not kept.exists():
                kept.write_bytes(path.read_bytes())
        path.write_text(text)
    except OSError as error:
        raise BuddylineError(f"{path}: cannot be written: {error.strerror}") from error
