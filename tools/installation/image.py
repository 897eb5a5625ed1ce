"""`buddyline image`: what makes a fresh card with Raspberry Pi OS into a node at its first start.

The operating system is not touched: Raspberry Pi Imager, or rpi-image-gen, writes it. cloud-init, which Raspberry Pi OS
has from its Trixie images on, reads user-data, network-config and meta-data from the boot partition. All three are
written as JSON, which is YAML, too.
"""

from __future__ import annotations

import argparse
import json
import re
import tomllib
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from buddyline.protocol.clock import S_NS
from buddyline.protocol.config import ConfigError
from buddyline.protocol.errors import BuddylineError
from buddyline.tools.installation import pi

if TYPE_CHECKING:
    from buddyline.node.config import NodeConfig

GROUPS: Final = ("sudo", "video", "i2c", "gpio")
USER: Final = re.compile(r"[a-z_][a-z0-9_-]{0,31}\Z")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument("boot", metavar="BOOT", help="the card's boot partition, where it is mounted; or any folder")
    pi.add_arguments(parser)
    parser.add_argument("--source", required=True, metavar="URL", help="your copy of this repository, for git clone")
    parser.add_argument("--ssh-key", required=True, metavar="FILE.pub", help="the public key with which you log in")
    parser.add_argument(
        "--address", metavar="IP/BITS", help="the node's, on the tether; default: 192.168.2.2/24 for a, .3 for b"
    )
    parser.add_argument("--gateway", metavar="IP", help="a machine on the tether that shares its Internet connection")
    parser.add_argument("--wifi", metavar="NAME", help="a wireless network, for the first start's downloads")
    parser.add_argument("--wifi-password", metavar="FILE", help="a file that holds its password")
    parser.add_argument(
        "--country",
        default="NO",
        metavar="CC",
        help="whose radio rules apply to the wireless network; default: %(default)s",
    )
    parser.add_argument("--user", default="diver", help="who runs the node; default: %(default)s")


def run(args: argparse.Namespace) -> int:
    """Write the files; say what is there and what comes next."""
    boot = Path(args.boot)
    if not boot.is_dir():
        raise BuddylineError(f"{boot}: no such folder: mount the card's boot partition, and name that")
    if not USER.match(args.user):
        raise BuddylineError(f"--user {args.user}: not a user's name")
    config = pi.load(args.config)
    files = {
        "user-data": f"#cloud-config\n{_json(user_data(args, config))}",
        "network-config": _json(network(args, config)),
        "meta-data": _json({"instance-id": f"buddyline-{config.node}-{config_id(args)}"}),
    }
    for name, text in files.items():
        pi.replace_file(boot / name, text)
    settings = boot / "config.txt"
    lines = pi.config_lines(config, args.clock_chip)
    pi.replace_file(settings, pi.with_block(pi.read_text(settings) if settings.exists() else "", lines))
    print(
        f"{boot}: user-data, network-config, meta-data, config.txt for node {config.node}\n"
        "next: unmount, start the Pi, and wait 10 to 20 minutes; then\n"
        f"  ssh {args.user}@{pi.address_of(config, args.address).ip} cloud-init status --long"
    )
    return 0


def user_data(args: argparse.Namespace, config: NodeConfig) -> dict[str, Any]:
    """Return cloud-init's user-data: the user, the packages, the node's files, and commands with `setup pi`."""
    home = f"/home/{args.user}"
    folder = f"{home}/buddyline"
    mine = ["sudo", "-u", args.user, "-H"]
    files = [_file(f"{home}/{name}", text, args.user) for name, text in _own_files(Path(args.config)).items()]
    setup = ["--config", f"{home}/{Path(args.config).name}", "--run-as", args.user, "--address", "keep"]
    setup += ["--clock-chip", args.clock_chip]
    setup += ["--clock-from", str(pi.ip("--clock-from", args.clock_from))] if args.clock_from else []
    commands = [
        [*mine, "git", "clone", args.source, folder],
        [*mine, "make", "-C", folder, "install", f"EXTRAS={pi.extras(config)}"],
        [f"{folder}/.venv/bin/buddyline", "setup", "pi", *setup, "--apply"],
        # What a restart would do for the files that it has written.
        ["modprobe", "i2c-dev"],
        ["systemctl", "restart", "chrony"],
        ["systemctl", "start", "buddyline-node"],
    ]
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
        "packages": list(pi.PACKAGES),
        "write_files": files,
        "runcmd": commands,
    }


def network(args: argparse.Namespace, config: NodeConfig) -> dict[str, Any]:
    """Return netplan's configuration: a fixed address on the tether, and the wireless network of the first start."""
    tether: dict[str, Any] = {"addresses": [str(pi.address_of(config, args.address))], "dhcp4": False, "optional": True}
    if args.gateway:
        gateway = str(pi.ip("--gateway", args.gateway))
        tether |= {"routes": [{"to": "default", "via": gateway}], "nameservers": {"addresses": [gateway]}}
    found: dict[str, Any] = {"version": 2, "ethernets": {"eth0": tether}}
    if bool(args.wifi) != bool(args.wifi_password):
        raise BuddylineError("--wifi and --wifi-password go together")
    if args.wifi:
        password = pi.read_text(Path(args.wifi_password)).strip()
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


def config_id(args: argparse.Namespace) -> str:
    """Return what changes with the configuration: cloud-init runs again where it has changed."""
    return str(Path(args.config).stat().st_mtime_ns // S_NS)


def _own_files(config: Path) -> dict[str, str]:
    """Return the configuration, and the files of its [tls], which must be beside it."""
    text = pi.read_text(config)
    files = {config.name: text}
    for name in tomllib.loads(text).get("tls", {}).values():
        if Path(name).name != name:
            raise ConfigError(f"{config}: [tls] {name}: for a card, give the name of a file beside the configuration")
        files[name] = pi.read_text(config.parent / name)
    return files


def _public_key(path: Path) -> str:
    key = pi.read_text(path).strip()
    if "PRIVATE KEY" in key or len(key.split()) < 2 or "\n" in key:
        raise BuddylineError(f"{path}: is no public key: one line, as in ~/.ssh/id_ed25519.pub")
    return key


def _file(path: str, content: str, owner: str) -> dict[str, Any]:
    # Deferred: after the user exists.
    return {"path": path, "content": content, "owner": f"{owner}:{owner}", "permissions": "0600", "defer": True}


def _json(value: dict[str, Any]) -> str:
    return json.dumps(value, indent=2) + "\n"
