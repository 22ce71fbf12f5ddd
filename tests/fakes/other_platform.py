"""Runs a ``pebble`` command line without what only Linux has: ``other_platform.py ARGUMENT…``.

``import MODULE…`` imports modules instead, and ``each LINE…`` runs several command lines. Modules are hidden only from
our own code, because the standard library chooses by the platform on which it runs; attributes are deleted after the
libraries have been imported.
"""

import builtins
import importlib
import os
import socket
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

#: Absent from Windows.
MODULES = {"fcntl", "grp", "posix", "pty", "pwd", "readline", "resource", "syslog", "termios", "tty"}
ATTRIBUTES = {
    "os": (
        "eventfd eventfd_read eventfd_write EFD_CLOEXEC EFD_NONBLOCK fork forkpty openpty getuid geteuid getgid "
        "getegid getgroups getpgid setpgid setsid killpg ttyname uname sysconf mkfifo chown fchown fchmod pread pwrite "
        "preadv pwritev memfd_create MFD_CLOEXEC pidfd_open posix_spawn register_at_fork sched_getaffinity "
        "sched_setaffinity sched_yield nice getpriority setpriority set_blocking get_blocking wait3 wait4 WNOHANG "
        "O_CLOEXEC O_NOCTTY O_NONBLOCK O_DIRECTORY O_NOFOLLOW pipe2 statvfs getloadavg sendfile copy_file_range"
    ),
    "select": "epoll poll",
    "signal": (
        "SIGHUP SIGKILL SIGSTOP SIGCONT SIGTSTP SIGQUIT SIGALRM SIGUSR1 SIGUSR2 SIGCHLD SIGPIPE SIGWINCH SIGTTIN "
        "SIGTTOU setitimer getitimer ITIMER_REAL alarm pause siginterrupt pthread_kill pthread_sigmask SIG_BLOCK "
        "SIG_UNBLOCK SIG_SETMASK sigpending sigwait sigwaitinfo sigtimedwait pidfd_send_signal"
    ),
    "socket": (
        "AF_UNIX SOCK_CLOEXEC SOCK_NONBLOCK SOCK_SEQPACKET TCP_INFO TCP_USER_TIMEOUT SO_PEERCRED SCM_RIGHTS AF_NETLINK "
        "CMSG_LEN CMSG_SPACE MSG_DONTWAIT send_fds recv_fds"
    ),
    "time": (
        "clock_gettime clock_gettime_ns CLOCK_BOOTTIME CLOCK_MONOTONIC CLOCK_MONOTONIC_RAW CLOCK_REALTIME "
        "pthread_getcpuclockid"
    ),
    "mmap": "MAP_SHARED MAP_PRIVATE PROT_READ PROT_WRITE MADV_DONTNEED",
}
LIBRARIES = (
    "asyncio", "ctypes", "email", "getpass", "http.client", "importlib.metadata", "inspect", "logging.handlers",
    "multiprocessing.shared_memory", "queue", "secrets", "shutil", "sqlite3", "ssl", "subprocess", "tempfile", "uuid",
    "cryptography.x509", "msgspec", "numpy", "paho.mqtt.client", "rich.console", "rich.table", "rich.live",
    "starlette.applications", "typer", "uvicorn", "websockets.asyncio.server", "zenoh",
)  # fmt: skip


def _socketpair(*_: object) -> tuple[socket.socket, socket.socket]:
    """Return a pair like the one that the standard library makes on Windows."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        first = socket.create_connection(server.getsockname())
        return first, server.accept()[0]


def hide() -> None:
    for name in LIBRARIES:
        try:
            importlib.import_module(name)
        except ImportError:
            sys.stderr.write(f"not installed: {name}\n")
    for name, attributes in ATTRIBUTES.items():
        module = importlib.import_module(name)
        for attribute in attributes.split():
            if hasattr(module, attribute):
                delattr(module, attribute)
    os.environ.setdefault("USERNAME", "ann")
    os.environ.setdefault("HOME", os.devnull)  # where it is not set, Linux would ask for the user's id
    socket.socketpair = _socketpair  # type: ignore[assignment]
    real = builtins.__import__

    def other(name, globals=None, *arguments, **named):  # type: ignore[no-untyped-def]  # noqa: A002
        if name.partition(".")[0] in MODULES and str((globals or {}).get("__name__")).startswith("pebble"):
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)
        return real(name, globals, *arguments, **named)

    builtins.__import__ = other


hide()
if sys.argv[1] == "import":
    for name in sys.argv[2:]:
        importlib.import_module(name)
else:
    from pebble.cli import main

    if sys.argv[1] != "each":
        sys.exit(main())
    lines, failed = sys.argv[2:], 0
    for line in lines:
        sys.argv[1:] = line.split()
        try:
            failed |= int(main())
        except SystemExit as end:
            failed |= int(end.code or 0)
    sys.exit(failed)
