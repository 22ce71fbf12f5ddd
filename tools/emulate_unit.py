"""Runs a command within the limits of a systemd unit, without systemd: ``emulate_unit.py UNIT -- COMMAND …``.

``--read FOLDER`` and ``--write FOLDER`` stay reachable, wherever the unit hides them. It needs libseccomp, root or user
namespaces, and systemd-analyze, only to name the system calls of a group. What it does not emulate is printed first:
devices, users, and the limits of memory and tasks are matters of cgroups and PID 1.
"""

from __future__ import annotations

import argparse
import ctypes
import errno
import os
import resource
import socket
import subprocess
import sys
from collections import defaultdict
from collections.abc import Iterable
from pathlib import Path

#: Keys of [Service] that take effect here; of those in `RESTRICTIONS` the others are named as missing.
EMULATED = frozenset(
    {
        *("AmbientCapabilities", "CapabilityBoundingSet", "NoNewPrivileges"),
        *(
            "PrivateTmp",
            "ProtectControlGroups",
            "ProtectHome",
            "ProtectKernelTunables",
            "ProtectSystem",
            "ReadWritePaths",
        ),
        *("LimitCORE", "LimitMEMLOCK", "MemoryDenyWriteExecute", "UMask"),
        *("RestrictAddressFamilies", "RestrictNamespaces", "RestrictRealtime"),
        *("SystemCallArchitectures", "SystemCallErrorNumber", "SystemCallFilter"),
    }
)
RESTRICTIONS = (
    *("Ambient", "Capab", "Device", "Keyring", "Limit", "Lock", "Memory", "NoNew", "Private", "Proc", "Protect"),
    *("ReadWrite", "RemoveIPC", "Restrict", "RootDir", "SystemCall", "Tasks", "User", "UMask"),
)

NEWNS, NEWUSER = 0x00020000, 0x10000000
ALL_NAMESPACES = 0x7E020080  # CLONE_NEW{TIME,NS,CGROUP,UTS,IPC,USER,PID,NET} of sched.h
MS_NOSUID, MS_NODEV, MS_BIND, MS_REC, MS_PRIVATE = 2, 4, 4096, 16384, 1 << 18
MOUNT_SETATTR, AT_FDCWD, AT_RECURSIVE, ATTR_RDONLY = 442, -100, 0x8000, 1
PR_CAPBSET_DROP, PR_SET_SECUREBITS, PR_SET_NO_NEW_PRIVS, PR_SET_MDWE = 24, 28, 38, 65
NOROOT_LOCKED = 0b11  # no capabilities for user 0 at execve, for ever
ALLOW, ERRNO = 0x7FFF0000, 0x00050000
EQUAL, MASKED_EQUAL = 4, 7
ORDINARY_POLICIES = (0, 3, 5)  # SCHED_OTHER, SCHED_BATCH, SCHED_IDLE

_libc = ctypes.CDLL(None, use_errno=True)


class MountAttributes(ctypes.Structure):
    """``struct mount_attr`` of mount_setattr(2)."""

    _fields_ = [(name, ctypes.c_uint64) for name in ("set", "clear", "propagation", "userns")]


class Comparison(ctypes.Structure):
    """``struct scmp_arg_cmp`` of seccomp_rule_add(3)."""

    _fields_ = [("argument", ctypes.c_uint), ("operator", ctypes.c_int), ("a", ctypes.c_uint64), ("b", ctypes.c_uint64)]


class Capabilities(ctypes.Structure):
    """The header and both words of ``struct __user_cap_data_struct`` of capset(2), one after the other."""

    _fields_ = [("version", ctypes.c_uint32), ("pid", ctypes.c_int)]


def service(unit: str) -> dict[str, list[str]]:
    """Every value of each key of [Service], as systemd reads them: an empty one takes the earlier ones back."""
    found: dict[str, list[str]] = defaultdict(list)
    section = ""
    for line in unit.replace("\\\n", " ").splitlines():
        text = line.strip()
        if text.startswith("["):
            section = text
        elif section == "[Service]" and "=" in text and not text.startswith(("#", ";")):
            key, _, value = (part.strip() for part in text.partition("="))
            found[key] = [*found[key], value] if value else []
    return dict(found)


def missing(keys: Iterable[str]) -> list[str]:
    """The restrictions among ``keys`` that a command under the emulation does not feel."""
    return sorted(key for key in keys if key.startswith(RESTRICTIONS) and key not in EMULATED)


def group(name: str) -> set[str]:
    """The system calls of one of systemd's groups."""
    done = subprocess.run(["systemd-analyze", "syscall-filter", name], capture_output=True, text=True, check=True)
    names = {line.strip() for line in done.stdout.splitlines()[1:] if line.strip() and not line.strip().startswith("#")}
    return calls(names)


def calls(names: Iterable[str]) -> set[str]:
    """System calls by name, with groups resolved."""
    return {call for name in names for call in (group(name) if name.startswith("@") else {name})}


def allowed_calls(filters: Iterable[str]) -> set[str]:
    """What SystemCallFilter= lines allow together, if the first of them is a list of allowed calls."""
    allowed: set[str] = set()
    for line in filters:
        if line.startswith("~"):
            allowed -= calls(line[1:].split())
        else:
            allowed |= calls(line.split())
    return allowed


class Limits:
    """The limits of one unit, to be put on this process and all that it starts."""

    def __init__(self, keys: dict[str, list[str]]) -> None:
        self._keys = keys

    def _is(self, key: str, value: str = "yes") -> bool:
        return self._keys.get(key, [""])[-1:] == [value]

    def apply(self, readable: list[Path], writable: list[Path]) -> None:
        """Restricts in systemd's order: file systems, resource limits, capabilities, and last of all system calls."""
        allowed = allowed_calls(self._keys.get("SystemCallFilter", ()))  # asks a program that soon cannot start
        self._mount(readable, writable)
        self._limit_resources()
        self._drop_capabilities()
        if self._is("NoNewPrivileges"):
            _prctl(PR_SET_NO_NEW_PRIVS, 1)
        if self._is("MemoryDenyWriteExecute"):
            _prctl(PR_SET_MDWE, 1)
        if allowed:
            self._filter(allowed)

    def _mount(self, readable: list[Path], writable: list[Path]) -> None:
        namespaces = NEWNS if os.geteuid() == 0 else NEWNS | NEWUSER
        user, group_ = os.geteuid(), os.getegid()
        _check(_libc.unshare(namespaces), "unshare")
        if namespaces & NEWUSER:
            Path("/proc/self/setgroups").write_text("deny")
            Path("/proc/self/uid_map").write_text(f"{user} {user} 1")
            Path("/proc/self/gid_map").write_text(f"{group_} {group_} 1")
        _mount("none", Path("/"), None, MS_REC | MS_PRIVATE)
        writable = writable + [Path(path) for value in self._keys.get("ReadWritePaths", ()) for path in value.split()]
        reachable = [(path, os.open(path, os.O_PATH), path in writable) for path in (*readable, *writable)]
        if self._is("ProtectSystem", "strict"):
            _read_only(Path("/"))
            _read_only(Path("/dev"), False)
            _read_only(Path("/proc"), False, recursive=False)
        hidden = []
        if self._is("PrivateTmp"):
            hidden += [Path("/tmp"), Path("/var/tmp")]  # noqa: S108
        homes = [
            Path(path) for path in ("/home", "/root", "/run/user") if self._is("ProtectHome") and Path(path).is_dir()
        ]
        for path in (*hidden, *homes):
            _mount("tmpfs", path, "tmpfs", MS_NOSUID | MS_NODEV, "mode=1777" if path in hidden else "mode=755")
        if self._is("ProtectKernelTunables") or self._is("ProtectControlGroups"):
            _read_only(Path("/sys"))
            _mount("/proc/sys", Path("/proc/sys"), None, MS_BIND)
            _read_only(Path("/proc/sys"))
        for path, descriptor, may_write in reachable:
            path.mkdir(parents=True, exist_ok=True)
            _mount(f"/proc/self/fd/{descriptor}", path, None, MS_BIND | MS_REC)
            _read_only(path, not may_write)
            os.close(descriptor)
        for path in homes:
            _read_only(path, recursive=False)
        os.chdir(Path.cwd())  # the folder of this name, and not what was there before

    def _limit_resources(self) -> None:
        for key, limit in (("LimitCORE", resource.RLIMIT_CORE), ("LimitMEMLOCK", resource.RLIMIT_MEMLOCK)):
            for value in self._keys.get(key, [])[-1:]:
                most = resource.getrlimit(limit)[1] if value == "infinity" else int(value)  # raising it takes PID 1
                resource.setrlimit(limit, (most, most))
        for value in self._keys.get("UMask", [])[-1:]:
            os.umask(int(value, 8))

    def _drop_capabilities(self) -> None:
        if self._keys.get("CapabilityBoundingSet") != []:
            return
        last = int(Path("/proc/sys/kernel/cap_last_cap").read_text())
        for number in range(last + 1):
            _prctl(PR_CAPBSET_DROP, number)
        _prctl(PR_SET_SECUREBITS, NOROOT_LOCKED)
        header = Capabilities(0x20080522, 0)
        _check(_libc.capset(ctypes.byref(header), (ctypes.c_uint32 * 6)()), "capset")

    def _filter(self, allowed: set[str]) -> None:
        seccomp = ctypes.CDLL("libseccomp.so.2")
        seccomp.seccomp_init.restype = ctypes.c_void_p
        named = self._keys.get("SystemCallErrorNumber", ["EPERM"])[-1]
        rules = ctypes.c_void_p(seccomp.seccomp_init(ctypes.c_uint32(ERRNO | getattr(errno, named))))

        def allow(name: str, *comparisons: Comparison, instead: int = ALLOW) -> None:
            number = seccomp.seccomp_syscall_resolve_name(name.encode())
            if number >= 0:  # else another architecture's
                array = (Comparison * len(comparisons))(*comparisons)
                added = seccomp.seccomp_rule_add_array(rules, ctypes.c_uint32(instead), number, len(comparisons), array)
                if added != 0:
                    raise OSError(-added, f"seccomp rule of {name}: {os.strerror(-added)}")

        if families := " ".join(self._keys.get("RestrictAddressFamilies", ())).split():
            for family in families:
                allow("socket", Comparison(0, EQUAL, getattr(socket, family)))
            allowed = allowed - {"socket"}
        if self._is("RestrictNamespaces"):
            for name in {"clone", "unshare"} & allowed:
                allow(name, Comparison(0, MASKED_EQUAL, ALL_NAMESPACES, 0))
            allow("clone3", instead=ERRNO | errno.ENOSYS)  # its flags are in memory: the C library uses clone then
            allowed = allowed - {"clone", "clone3", "unshare", "setns"}
        if self._is("RestrictRealtime") and "sched_setscheduler" in allowed:
            for policy in ORDINARY_POLICIES:
                allow("sched_setscheduler", Comparison(1, EQUAL, policy))
            allowed = allowed - {"sched_setscheduler"}
        for name in sorted(allowed):
            allow(name)
        _check(seccomp.seccomp_load(rules), "seccomp_load")


def _prctl(option: int, value: int) -> None:
    _check(_libc.prctl(option, ctypes.c_ulong(value), 0, 0, 0), f"prctl {option}")


def _mount(source: str, target: Path, kind: str | None, flags: int, data: str | None = None) -> None:
    encoded = [text.encode() if text is not None else None for text in (source, str(target), kind, data)]
    _check(_libc.mount(*encoded[:3], ctypes.c_ulong(flags), encoded[3]), f"mount {target}")


def _read_only(path: Path, read_only: bool = True, *, recursive: bool = True) -> None:
    attributes = MountAttributes(ATTR_RDONLY if read_only else 0, 0 if read_only else ATTR_RDONLY, 0, 0)
    size = ctypes.c_size_t(ctypes.sizeof(attributes))
    flags = ctypes.c_uint(AT_RECURSIVE if recursive else 0)
    done = _libc.syscall(MOUNT_SETATTR, AT_FDCWD, str(path).encode(), flags, ctypes.byref(attributes), size)
    _check(done, f"mount_setattr {path}")


def _check(result: int, what: str) -> None:
    if result != 0:
        number = ctypes.get_errno() or -result
        raise OSError(number, f"{what}: {os.strerror(number)}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--read", type=Path, action="append", default=[], metavar="FOLDER")
    parser.add_argument("--write", type=Path, action="append", default=[], metavar="FOLDER")
    parser.add_argument("unit", type=Path)
    parser.add_argument("command", nargs="+")
    chosen = parser.parse_args()
    keys = service(chosen.unit.read_text())
    print(f"{chosen.unit.name}: not emulated: {', '.join(missing(keys))}", flush=True)
    try:
        Limits(keys).apply(chosen.read, chosen.write)
    except (OSError, subprocess.CalledProcessError) as error:
        sys.exit(f"{chosen.unit.name} cannot be emulated here: {error}")
    os.execvp(chosen.command[0], chosen.command)  # noqa: S606


if __name__ == "__main__":
    main()
