"""From nothing, on another Debian or processor: the time to the first pose, the tests, and `setup pi`.

    .venv/bin/python -m tests.chroots trixie                 # packages, clone, `make demo` to its first pose
    .venv/bin/python -m tests.chroots trixie --tests         # and `make test`
    .venv/bin/python -m tests.chroots trixie --setup-pi      # and `setup pi`, twice, with a stand-in for picamera2
    .venv/bin/python -m tests.chroots trixie --arch arm64    # emulated by qemu-user

Each system is made by debootstrap in a folder for temporary files and kept; the clone in it is made anew, of what is
committed. Each line says the seconds since the beginning, and the processor's seconds: those do not depend on what else
the machine does. Needs root, debootstrap and Debian's packages; for arm64 also qemu-user-static, with which the kernel
is told to run programs of that processor until this ends, where it was not before.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from tests.processes import REPOSITORY

BINFMT = Path("/proc/sys/fs/binfmt_misc")
# How Debian's qemu-user-static has programs of the other processor run; systemd reads it where there is one.
EMULATION = Path("/usr/lib/binfmt.d/qemu-aarch64.conf")
CHROOTS = Path(tempfile.gettempdir()) / "buddyline-chroots"
CERTIFICATES = "etc/ssl/certs/ca-certificates.crt"
# README.md's line, and node/README.md's.
PACKAGES = ("git", "make", "python3", "python3-venv")
MOUNTED = """
mount -t proc proc "$1/proc"; mount --rbind /dev "$1/dev"; mount --rbind /sys "$1/sys"; exec chroot "$@"
"""
# As Raspberry Pi OS has it: a package of the system, which pip sees as one.
CAMERA = "usr/lib/python3/dist-packages/picamera2"
CAMERA_VERSION = "0.3.31"
# What the node's driver imports of it, on a Pi whose camera is not plugged in.
STAND_IN = """class MappedArray: ...
class Picamera2:
    global_camera_info = staticmethod(list)
"""


class FailedError(Exception):
    """A command in the system failed; the text has its last lines."""


class Debian:
    """A Debian system in a folder."""

    def __init__(self, suite: str, arch: str) -> None:
        self.root = CHROOTS / f"{suite}-{arch}"
        if not (self.root / "made").exists():
            shutil.rmtree(self.root, ignore_errors=True)
            self._make(suite, arch)
        shutil.copy("/etc/resolv.conf", self.root / "etc" / "resolv.conf")
        self._began_s, self._cpu_s = time.monotonic(), _cpu_s()

    def _make(self, suite: str, arch: str) -> None:
        print(f"debootstrap {suite} {arch} in {self.root}", flush=True)
        self.root.mkdir(parents=True)
        words = ["debootstrap", f"--arch={arch}", "--variant=minbase", "--include=ca-certificates"]
        subprocess.run([*words, suite, str(self.root)], check=True, stdout=subprocess.DEVNULL)
        (self.root / "made").touch()

    def run(self, script: str, user: str = "root", wanted: tuple[int, ...] = (0,), awaited: str = "") -> str:
        """Run a shell's script; return what it printed. awaited: print when a line first has this text."""
        home = "/root" if user == "root" else f"/home/{user}"
        variables = {
            "PATH": "/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin", "HOME": home, "LANG": "C.UTF-8",
            "DEBIAN_FRONTEND": "noninteractive", "PIP_CERT": f"/{CERTIFICATES}", "CI": "true",
        }  # fmt: skip
        as_user = [] if user == "root" else ["runuser", "-u", user, "--"]
        words = ["/usr/bin/env", "-i", *(f"{name}={value}" for name, value in variables.items()), *as_user]
        words += ["/bin/sh", "-ec", script]
        entered = ["unshare", "--mount", "sh", "-ec", MOUNTED, "sh", str(self.root), *words]
        child = subprocess.Popen(entered, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT)
        assert child.stdout is not None
        lines = []
        for line in child.stdout:
            lines.append(line.decode(errors="replace"))
            if awaited and awaited in lines[-1]:
                print(
                    f"{time.monotonic() - self._began_s:6.0f} s{'':13} the first pose: {lines[-1].strip()}", flush=True
                )
                awaited = ""
        if child.wait() not in wanted:
            raise FailedError(f"{script}\nended with {child.returncode}:\n{''.join(lines[-30:])}")
        return "".join(lines)

    def say(self, what: str) -> None:
        """Print a line with both times."""
        passed_s, cpu_s = time.monotonic() - self._began_s, _cpu_s() - self._cpu_s
        print(f"{passed_s:6.0f} s {cpu_s:6.0f} s CPU  {what}", flush=True)


def _cpu_s() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


@contextmanager
def emulated(arch: str) -> Iterator[None]:
    """Have the kernel run programs of another processor by qemu, as long as this lasts."""
    entry = BINFMT / "qemu-aarch64"
    if arch != "arm64" or entry.exists():
        yield
        return
    if not (BINFMT / "register").exists():
        subprocess.run(["mount", "-t", "binfmt_misc", "binfmt_misc", str(BINFMT)], check=True)
    if not entry.exists():
        (BINFMT / "register").write_text(EMULATION.read_text().strip())
    try:
        yield
    finally:
        entry.write_text("-1")


def first_pose(system: Debian, rate_hz: int) -> None:
    """Do what README.md's first lines say, at a rate that the machine can render."""
    system.run(f"apt-get update; apt-get install -y {' '.join(PACKAGES)}")
    # Those of this machine: it may reach the package index through a proxy of its own.
    shutil.copy(f"/{CERTIFICATES}", system.root / CERTIFICATES)
    system.say(f"packages on Debian {system.run('cat /etc/debian_version; uname -m').split()}")
    shutil.rmtree(system.root / "src.git", ignore_errors=True)
    subprocess.run(["git", "clone", "--quiet", "--bare", str(REPOSITORY), str(system.root / "src.git")], check=True)
    system.run(
        "rm -rf /root/buddyline; git config --global --add safe.directory /src.git; git clone /src.git /root/buddyline"
    )
    system.run(f'cd /root/buddyline; make demo ARGS="--seconds 30 --rate {rate_hz}" 2>&1', awaited=" range ")
    system.say("`make demo` of 30 s has ended")


def tests(system: Debian) -> None:
    """Run the default suite."""
    said = system.run("cd /root/buddyline; make test 2>&1", wanted=(0, 2))
    print("".join(f"{'':22}{line}\n" for line in said.splitlines()[-12:]), end="")
    system.say("`make test` has ended")


def setup_pi(system: Debian) -> None:
    """Do what node/README.md says, on a system that has what Raspberry Pi OS has beside Debian."""
    _stand_in(system.root / "stand-ins")
    config = "sed -i s,tls/192.168.2.1,tls/127.0.0.1, ~/a.toml"
    system.run(
        "echo 'deb [trusted=yes] file:/stand-ins ./' > /etc/apt/sources.list.d/stand-ins.list; apt-get update;"
        # One of an earlier run would stay, though today's has the same version.
        "apt-get purge -y python3-picamera2 || true;"
        "apt-get install -y --no-install-recommends systemd polkitd; id diver || useradd --create-home diver;"
        "mkdir -p /boot/firmware; echo dtparam=audio=on > /boot/firmware/config.txt;"
        "rm -rf /home/diver/*; git config --system --add safe.directory /src.git"
    )
    system.say("a system with systemd and a user")
    system.run("git clone /src.git ~/buddyline; cd ~/buddyline; make install 2>&1", user="diver")
    told = "cd ~/buddyline; .venv/bin/buddyline setup pi --config ~/a.toml"
    system.run(f"cd ~/buddyline; .venv/bin/buddyline init node --node a -o ~/a.toml; {config}", user="diver")
    said = system.run(told, user="diver")
    assert "nothing was changed" in said, said
    assert "picamera2" in said, said
    system.say("setup pi, to say what is to do")
    done = "cd /home/diver/buddyline; .venv/bin/buddyline setup pi --config /home/diver/a.toml --run-as diver --apply"
    said = system.run(done)
    print(said[-600:])
    system.say("setup pi --apply")
    for script, user in ((told, "diver"), (done, "root")):
        said = system.run(script, user=user, wanted=(0, 1))
        assert "nothing is left to do; doctor says:" in said, said
        assert "Traceback" not in said, said
    print(said)
    verified = system.run("systemd-analyze verify /etc/systemd/system/buddyline-node.service 2>&1", wanted=(0, 1))
    system.say(f"setup pi again, which runs doctor; systemd-analyze verify: {verified.strip() or 'nothing to say'}")


def _stand_in(folder: Path) -> None:
    """Make an apt archive of picamera2, with no camera, and of an empty lgpio, which Debian 12 has not."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    camera, lgpio = folder / "python3-picamera2", folder / "python3-lgpio"
    (camera / CAMERA).mkdir(parents=True)
    (camera / CAMERA / "__init__.py").write_text(STAND_IN)
    about = camera / f"{CAMERA}-{CAMERA_VERSION}.dist-info" / "METADATA"
    about.parent.mkdir()
    about.write_text(f"Metadata-Version: 2.1\nName: picamera2\nVersion: {CAMERA_VERSION}\n")
    # "~": older than any version that Debian has.
    listed = [_package(camera, CAMERA_VERSION), _package(lgpio, "0~stand-in")]
    (folder / "Packages").write_text("\n".join(listed))


def _package(tree: Path, version: str) -> str:
    """Make a package of a folder; return its entry in the archive's list."""
    control = f"Package: {tree.name}\nVersion: {version}\nArchitecture: all\nMaintainer: none <none@none>\n"
    (tree / "DEBIAN").mkdir(parents=True)
    (tree / "DEBIAN" / "control").write_text(f"{control}Description: stand-in\n")
    made = tree.with_suffix(".deb")
    subprocess.run(["dpkg-deb", "--build", "-Zxz", tree, made], check=True, stdout=subprocess.DEVNULL)
    content = made.read_bytes()
    listed = f"Filename: ./{made.name}\nSize: {len(content)}\nSHA256: {hashlib.sha256(content).hexdigest()}\n"
    return f"{control}{listed}Description: stand-in\n"


def main() -> int:
    """Make the system, and do in it what is asked for."""
    parser = argparse.ArgumentParser(prog="python -m tests.chroots", description=__doc__.split("\n")[0])
    parser.add_argument("suite", help="Debian's name, such as bookworm or trixie")
    parser.add_argument("--arch", choices=("amd64", "arm64"), default="amd64")
    parser.add_argument("--tests", action="store_true")
    parser.add_argument("--setup-pi", action="store_true")
    args = parser.parse_args()
    if os.geteuid() != 0:
        parser.error("needs root")
    try:
        with emulated(args.arch):
            system = Debian(args.suite, args.arch)
            # Emulated, a picture takes a second.
            first_pose(system, 1 if args.arch == "arm64" else 10)
            if args.tests:
                tests(system)
            if args.setup_pi:
                setup_pi(system)
    except (FailedError, AssertionError) as error:
        print(error, file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
