"""A machine for tests: a real systemd as PID 1 in namespaces of its own, on a copy of this machine's files.

Its files are an overlay on this machine's root, so Debian's packages are those that are installed here. Its changes are
in ``disk``, which stays from one boot to the next, and may lie below other machines. Its network is a loopback of its
own. Needs root, overlayfs, cgroup2 and systemd.
"""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Any, Self

from tests.support import WAIT_S, Child, until

SYSTEMD = Path("/usr/lib/systemd/systemd")
#: What this machine has, and a robot's would not: they are empty there.
HIDDEN = ("/etc/pebble", "/opt/pebble", "/var/lib/pebble", "/var/lib/pebble-update", "/var/log/journal", "/root")
#: Units that wait for hardware, for the internet or for a terminal.
MASKED = (
    *("getty.target", "systemd-timesyncd.service", "systemd-networkd.service", "systemd-resolved.service"),
    *("apt-daily.timer", "apt-daily-upgrade.timer", "man-db.timer", "e2scrub_reap.service", "postgresql.service"),
    *("systemd-udevd.service", "systemd-udevd-kernel.socket", "systemd-udevd-control.socket", "ssh.service"),
    *("systemd-modules-load.service", "systemd-sysctl.service", "NetworkManager.service", "cron.service"),
)
DEVICES = {"null": (1, 3), "zero": (1, 5), "full": (1, 7), "random": (1, 8), "urandom": (1, 9), "tty": (5, 0)}

#: In new namespaces: mounts what a kernel would, and becomes systemd. $1: the machine's folder; $2: the disk of
#: another one to begin with, or nothing; $3: shared folders.
BOOT = f"""
set -eu
mount --make-rprivate /
root=$1/root below=/
if [ -n "$2" ]; then
    below=$1/below
    mount -t overlay -o "lowerdir=/,upperdir=$2/upper,workdir=$2/work" below "$below"
fi
mount -t overlay -o "lowerdir=$below,upperdir=$1/disk/upper,workdir=$1/disk/work" machine "$root"
for folder in $3; do
    mkdir -p "$root/mnt/${{folder##*/}}"
    mount --bind "$folder" "$root/mnt/${{folder##*/}}"
    mount -o remount,bind,ro "$root/mnt/${{folder##*/}}"
done
mount -t proc proc "$root/proc"
mount -t sysfs -o ro sysfs "$root/sys"
mount -t cgroup2 cgroup2 "$root/sys/fs/cgroup"
for folder in run dev tmp; do mount -t tmpfs -o mode=755 "$folder" "$root/$folder"; done
chmod 1777 "$root/tmp"
{"".join(f'mknod -m 666 "$root/dev/{name}" c {major} {minor}{chr(10)}' for name, (major, minor) in DEVICES.items())}
mkdir "$root/dev/pts" "$root/dev/shm"
mount -t devpts -o newinstance,ptmxmode=0666,mode=620,gid=5 devpts "$root/dev/pts"
ln -s pts/ptmx "$root/dev/ptmx"
ln -s /proc/self/fd "$root/dev/fd"
mount -t tmpfs shm "$root/dev/shm"
ip link set lo up
cd "$root"
mkdir -p run/host
pivot_root . run/host
exec chroot . sh -c 'umount -l /run/host && exec env -i container=lxc PATH=/usr/sbin:/usr/bin:/sbin:/bin \\
    {SYSTEMD} --system --unit=multi-user.target --show-status=0 --log-target=journal'
"""


def missing() -> str | None:
    """Return what this machine lacks to run a test machine; None if it lacks nothing."""
    if os.geteuid() != 0:
        return "needs root: namespaces with mounts of their own"
    if not SYSTEMD.exists():
        return "needs systemd (apt install systemd)"
    kinds = Path("/proc/filesystems").read_text().split()
    if not {"overlay", "cgroup2"} <= set(kinds) or _cgroups() is None:
        return "needs overlayfs and a mounted cgroup2"
    probe = ["unshare", "--mount", "--pid", "--net", "--uts", "--ipc", "--cgroup", "--fork", "true"]
    done = subprocess.run(probe, capture_output=True, text=True, check=False)
    return None if done.returncode == 0 else f"needs namespaces: {done.stderr.strip()}"


def _cgroups() -> Path | None:
    mounts = [line.split() for line in Path("/proc/mounts").read_text().splitlines()]
    return next((Path(words[1]) for words in mounts if words[2] == "cgroup2"), None)


class Machine:
    """A machine that can be booted, cut off and booted again.

    ``shared``: folders that it sees, read-only, below /mnt. ``like``: a machine that is off, with whose files it
    begins.
    """

    def __init__(self, folder: Path, shared: Sequence[Path] = (), like: Machine | None = None) -> None:
        self.folder, self._shared = folder, shared
        self.disk = folder / "disk"
        for name in ("root", "below", "disk/upper", "disk/work"):
            (folder / name).mkdir(parents=True)
        (self.disk / "upper").chmod(0o755)
        self._like = str(like.disk) if like else ""
        if like is None:
            self._hide()
        self._boot: subprocess.Popen[Any] | None = None
        self._init = 0

    def _hide(self) -> None:
        upper = self.disk / "upper"
        for hidden in HIDDEN:
            if Path(hidden).exists():
                place = upper / hidden[1:]
                place.mkdir(parents=True)
                os.setxattr(place, "trusted.overlay.opaque", b"y")
        units = upper / "etc/systemd/system"
        units.mkdir(parents=True)
        for unit in MASKED:
            (units / unit).symlink_to("/dev/null")
        (upper / "etc/fstab").write_text("")

    def __enter__(self) -> Self:
        try:
            self.boot()
        except BaseException:
            self.__exit__()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        self.cut()
        shutil.rmtree(self.disk, ignore_errors=True)

    @property
    def _cgroup(self) -> Path:
        cgroups = _cgroups()
        assert cgroups is not None
        return cgroups / f"pebble-{os.getpid()}-{self.folder.name}"

    def boot(self) -> None:
        """Start the machine, and wait until its units have started."""
        self._cgroup.mkdir(exist_ok=True)
        enter = f'echo $$ >"{self._cgroup}/cgroup.procs" && exec "$@"'
        unshare = ["unshare", "--mount", "--pid", "--net", "--uts", "--ipc", "--cgroup", "--fork", "--kill-child"]
        shared = " ".join(map(str, self._shared))
        command = ["sh", "-c", enter, "boot", *unshare, "sh", "-c", BOOT, "boot", str(self.folder), self._like, shared]
        with (self.folder / "boot.log").open("ab") as log:
            self._boot = Child(command, stdin=subprocess.DEVNULL, stdout=log, stderr=log)
        assert until(self._found), f"no machine:\n{(self.folder / 'boot.log').read_text()}"
        assert until(lambda: self.run("systemctl", "is-system-running", check=False).strip() in _UP, 90, step=0.2), (
            self.run("systemctl", "list-jobs", check=False) + self.run("systemctl", "--failed", check=False)
        )

    def _found(self) -> bool:
        """True if the machine's PID 1 is systemd."""
        assert self._boot is not None
        assert self._boot.poll() is None, f"no machine:\n{(self.folder / 'boot.log').read_text()}"
        children = Path(f"/proc/{self._boot.pid}/task/{self._boot.pid}/children")
        for word in children.read_text().split():
            with suppress(OSError):
                if Path(f"/proc/{word}/comm").read_text().strip() == "systemd":
                    self._init = int(word)
                    return True
        return False

    def cut(self) -> None:
        """Cut off the machine's power."""
        if self._boot is not None:
            if self._init:
                with suppress(ProcessLookupError):
                    os.kill(self._init, signal.SIGKILL)
            else:
                self._boot.kill()
            self._boot.wait(WAIT_S)
            self._boot, self._init = None, 0
        for folder, _, _ in os.walk(self._cgroup, topdown=False):
            assert until(partial(_removed, Path(folder))), folder

    @property
    def root(self) -> Path:
        """The machine's files, as they are while it runs."""
        return Path(f"/proc/{self._init}/root")

    @contextmanager
    def processes_watched(self) -> Iterator[set[bytes]]:
        """Yield the command lines and environments that the machine's processes have during the block.

        They are read one after the other without a pause; a process that lives for a few milliseconds may be missed.
        """
        seen: set[bytes] = set()
        ending = threading.Event()

        def watch() -> None:
            while not ending.wait(0.002):
                for process in os.listdir(self.root / "proc"):  # noqa: PTH208  (a Path for each costs as much as reading it)
                    if process.isdecimal():
                        with suppress(OSError):  # it has ended
                            seen.add((self.root / "proc" / process / "cmdline").read_bytes())
                            seen.add((self.root / "proc" / process / "environ").read_bytes())

        thread = threading.Thread(target=watch)
        thread.start()
        try:
            yield seen
        finally:
            ending.set()
            thread.join()

    def command(self, *words: str) -> list[str]:
        """Return the command line that runs a command in the machine, as root."""
        enter = ["nsenter", "-t", str(self._init), "-m", "-p", "-n", "-u", "-i", "-C", "-r", "-w"]
        path = "PATH=/usr/sbin:/usr/bin:/sbin:/bin"
        return [*enter, "env", "-i", path, "HOME=/root", "LANG=C.UTF-8", "TERM=dumb", *words]

    def run(self, *words: str, check: bool = True, timeout: float = 120, given: str = "") -> str:
        """Run a command in the machine with ``given`` as its input; return its output and errors."""
        done = subprocess.run(
            self.command(*words), stdout=subprocess.PIPE, stderr=subprocess.STDOUT, input=given.encode(),
            check=False, timeout=timeout,
        )  # fmt: skip
        text: str = done.stdout.decode(errors="replace")
        assert not check or done.returncode == 0, f"{words}: {done.returncode}\n{text}"
        return text

    def sh(self, script: str, **options: Any) -> str:
        return self.run("sh", "-euc", script, **options)

    def succeeds(self, *words: str) -> bool:
        return subprocess.run(self.command(*words), capture_output=True, check=False, timeout=120).returncode == 0

    def journal(self, unit: str) -> str:
        return self.run("journalctl", "--no-pager", "--output=cat", "--unit", unit)

    def write(self, path: str, text: str) -> None:
        """Write a file of the machine, and its missing folders."""
        self.run("sh", "-euc", 'mkdir -p "$(dirname "$1")"; cat >"$1"', "write", path, given=text)

    def exposure(self, unit: str) -> float:
        """Return the exposure level that systemd-analyze reports for a loaded unit."""
        text = self.run("systemd-analyze", "security", "--no-pager", unit)
        (found,) = re.findall(r"Overall exposure level for \S+: ([0-9.]+)", text)
        return float(found)


_UP = ("running", "degraded")


def _removed(cgroup: Path) -> bool:
    with suppress(OSError):
        cgroup.rmdir()
    return not cgroup.exists()
