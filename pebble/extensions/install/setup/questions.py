"""The questions of ``pebble setup`` in a terminal. The robot's present value is each question's default."""

import os
import shutil
import socket
import textwrap
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import typer
from msgspec.structs import replace

from pebble.contract.serial_protocols import SERIAL_PROTOCOLS
from pebble.extensions.fleet.people import has_user, usable
from pebble.extensions.install.setup import detect
from pebble.extensions.install.setup.answers import HERE, NONE, AnswersError, needs_login
from pebble.extensions.install.setup.steps import Job

_Given = dict[str, Any]


def say(text: str, indent: int = 0) -> None:
    """Print a text, with line breaks between words."""
    width = shutil.get_terminal_size().columns
    lines = textwrap.wrap(
        text,
        width,
        initial_indent=" " * indent,
        subsequent_indent=" " * (indent + 2),
        break_long_words=False,
        break_on_hyphens=False,
    )
    typer.echo("\n".join(lines))


def asked(job: Job) -> Job:
    """Return the job with the answers from the terminal. A wrong answer is asked for again."""
    questions: list[Callable[[Job, str], _Given]] = [_ask_board, _ask_camera, _ask_broker, _ask_page]
    if job.config is None:
        questions.insert(0, _ask_name)
    for number, ask in enumerate(questions, start=1):
        job = _answered(job, number, ask)
    return _with_passwords(job)


def _answered(job: Job, number: int, ask: Callable[[Job, str], _Given]) -> Job:
    """Return the job with the answer to one question, which is asked until its answer is right."""
    while True:
        try:
            return job.with_answers(ask(job, f"{number}."))
        except AnswersError as error:
            for line in str(error).splitlines():
                say(line, 3)


def _ask(question: str) -> None:
    typer.echo()
    say(question)


def _choose(question: str, choices: Sequence[tuple[str, str]], default: str, other: str = "another answer") -> str:
    """Return one of the values, chosen by its number, or another text that was typed."""
    _ask(question)
    for place, (value, label) in enumerate(choices, start=1):
        say(f"{place}  {value}{f'  ({label})' if label else ''}", 5)
    answer = str(typer.prompt(f"   Number, or {other}", default=default))
    if answer.isdecimal() and 0 < int(answer) <= len(choices):
        return choices[int(answer) - 1][0]
    return answer


def _ask_name(_job: Job, number: str) -> _Given:
    _ask(f"{number} What is the robot called? The name is a part of all its topics.")
    host = socket.gethostname().partition(".")[0] or "robot"
    return {"id": str(typer.prompt("   Name", default=host))}


def _ask_board(job: Job, number: str) -> _Given:
    typer.echo("\n   Listening to serial ports…")
    boards = {board.port: board for board in detect.boards(detect.SERIAL_PORTS)}
    choices = [*((board.port, board.text) for board in boards.values()), (NONE, "no board now")]
    ports_that_send = [board.port for board in boards.values() if board.baud]
    default = job.answers.port or (ports_that_send[0] if ports_that_send else NONE)
    port = _choose(f"{number} Which board drives the motors?", choices, default)
    if port == NONE:
        return {"port": NONE}
    board = boards.get(port)
    if board is not None and board.protocol is not None:
        return {"port": port, "protocol": board.protocol, "baud": board.baud}
    usual = job.answers.protocol or next(iter(SERIAL_PROTOCOLS))
    protocol = _choose("What does it speak?", [(name, "") for name in SERIAL_PROTOCOLS], usual)
    given: _Given = {"port": port, "protocol": protocol}
    if board is not None and board.baud:
        given["baud"] = board.baud
    return given


def _ask_camera(job: Job, number: str) -> _Given:
    choices = [*((camera, "") for camera in detect.cameras(detect.DEVICES)), (NONE, "no camera now")]
    return {"camera": _choose(f"{number} Which camera?", choices, job.answers.camera or choices[0][0])}


def _ask_broker(job: Job, number: str) -> _Given:
    question = f"{number} Where is the broker, at which operators meet the robot?"
    choices = [(HERE, "on this robot"), (NONE, "none yet")]
    broker = _choose(question, choices, job.answers.broker or HERE, "HOST[:PORT]")
    if broker == NONE:
        return {"broker": NONE, "page": False}
    answers = job.with_answers({"broker": broker}).answers
    given: _Given = {"broker": broker}
    if answers.is_far:
        default = answers.broker_user or str(answers.id)
        given["broker_user"] = str(typer.prompt("   The robot's account there", default=default))
        present = answers.broker_ca or ""
        ca = str(typer.prompt("   File with its authority, ca.pem (empty: a public one)", default=present))
        given["broker_ca"] = str(Path(ca).absolute()) if ca else None
    return given


def _ask_page(job: Job, number: str) -> _Given:
    if job.answers.broker == NONE:
        return {"page": False}
    _ask(f"{number} May phones and computers in this network open the robot's page?")
    yes_by_default = job.answers.page is not False  # also if it is not answered yet
    if not typer.confirm("   Page", default=yes_by_default):
        return {"page": False}
    if has_user(job.people):
        return {"page": True}
    name = (os.environ.get("SUDO_USER") or "admin").lower()
    return {"page": True, "user": str(typer.prompt("   First user, who may do everything", default=name))}


def _with_passwords(job: Job) -> Job:
    """Return the job with the passwords that it still needs, after asking for them."""
    answers, secrets = job.answers, job.secrets
    if needs_login(answers):
        text, default = f"   Password of {answers.account} at the broker", None
        if job.has_login:
            text, default = f"{text} (empty: as before)", ""
        typed = str(typer.prompt(text, default=default, show_default=False, hide_input=True))
        secrets = replace(secrets, broker_password=typed or None)
    if job.needs_user:
        text = f"   Password of {answers.user}"
        typed = str(typer.prompt(text, hide_input=True, confirmation_prompt="   Again"))
        secrets = replace(secrets, password=usable(typed))
    return job.with_answers({}, secrets)
