"""One run of ``pebble setup``: answers are completed, steps are shown and done, and what became of them is shown."""

import os
import subprocess
import sys
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import typer
from msgspec.structs import replace
from rich.console import Console

from pebble.config.text_files import read_password
from pebble.contract.serial_protocols import SERIAL_PROTOCOLS
from pebble.demo.phone import show_qr
from pebble.fleet import certificates
from pebble.fleet.database import DatabaseError
from pebble.fleet.people import has_user, usable
from pebble.setup import detect, manifest, plan, questions, restore
from pebble.setup.manifest import Manifest, SetupError
from pebble.setup.places import Places
from pebble.setup.plan import Plan
from pebble.setup.questions import HERE, NONE, Answers, AnswersError, Secrets
from pebble.setup.steps import Engine, Result, State

_SUDO = "sudo pebble setup"
_TRIES = 3  # for an answer that cannot be
_WIDTH = max(map(len, State))


@dataclass
class Session:
    """One run of the command."""

    places: Places
    yes: bool
    dry: bool
    notes: list[str] = field(default_factory=list)

    @property
    def asks(self) -> bool:
        return sys.stdin.isatty() and not self.yes

    # -- forwards

    def set_up(self, file: Path | None, given: dict[str, Any], backup_file: Path | None, second: str | None) -> int:
        there = self._known()
        backup = None
        if backup_file is not None:
            backup = restore.read(backup_file)
            restore.check(backup, there)
            there = restore.begin(backup, second=second is not None)
            given |= {"id": second or given["id"]}
        known = there or Manifest()
        from_file = {} if file is None else questions.decode(questions.read_file(file), str(file))
        if from_file.get("broker_ca"):
            from_file["broker_ca"] = str(Path(from_file["broker_ca"]).absolute())
        answers = questions.combined(known.answers, from_file, given)
        secrets = _read_secrets(from_file | {key: one for key, one in given.items() if one is not None})
        machine = detect.machine(self.places)
        wanted = Plan(self.places, answers, machine, known, secrets)
        if self.asks and file is None and (there is None or not _is_named(given)):
            wanted = self._asked(wanted)
        self._require(wanted, known, {} if backup is None else backup.files, is_second=second is not None)
        known.answer(questions.plain(wanted.answers), leaves=second is None)
        engine = Engine(self.places, known, is_live=self.places.is_live)
        if self.dry:
            return self._show(engine, wanted, backup)
        self._confirm(engine, wanted)
        return self._do(engine, wanted, backup, is_second=second is not None)

    def _known(self) -> Manifest | None:
        """What is known of this machine; a dry run goes without what this user may not read."""
        try:
            return manifest.load(self.places)
        except SetupError:
            if not self.dry:
                raise
            return None

    def _require(self, wanted: Plan, known: Manifest, restored: Collection[str], *, is_second: bool) -> None:
        """Raise AnswersError for what is missing still. ``restored``: files of a backup."""
        answers = wanted.answers
        renamed = known.answers.get("id") not in (None, answers.id) and answers.is_far
        if renamed and answers.broker_user == known.answers.get("broker_user"):
            raise AnswersError(
                f"broker_user is missing: {answers.broker_user} is the account of {known.answers['id']} (--broker-user)"
            )
        try:
            known_user = answers.user is not None and has_user(self.places.people, answers.user)
        except (PermissionError, DatabaseError):
            known_user = True  # the step reports it
        known_user |= self.dry or self._named(self.places.people) in restored
        known_login = _exists(wanted.broker_password)
        known_login |= not is_second and self._named(wanted.broker_password) in restored
        missing = questions.missing(answers, wanted.secrets, has_login=known_login, has_user=known_user)
        if missing:
            raise questions.missing_error(missing)
        if wanted.secrets.password is not None:
            usable(wanted.secrets.password)

    def _named(self, file: Path) -> str:
        """What the file is called in a backup."""
        return str(file.relative_to(self.places.root))

    def _show(self, engine: Engine, wanted: Plan, backup: restore.Backup | None) -> int:
        for name in () if backup is None else backup.files:
            typer.echo(f"{State.NEW:<{_WIDTH}}  /{name} of the backup")
        for result in (*engine.states(plan.steps(wanted)), *engine.states(engine.left_over(plan.steps(wanted)))):
            _print(result, self.places)
        typer.echo("Nothing was written: this was a dry run.")
        return 0

    def _confirm(self, engine: Engine, wanted: Plan) -> None:
        if self.yes:
            return
        if not self.asks:
            raise AnswersError("yes is missing: standard input is no terminal, so confirm with --yes (or --dry-run)")
        typer.echo("\n6. These steps are done:")
        for result in engine.states(plan.steps(wanted)):
            _print(result, self.places)
        engine.forget()
        typer.confirm("Do it?", abort=True)

    def _do(self, engine: Engine, wanted: Plan, backup: restore.Backup | None, *, is_second: bool) -> int:
        if wanted.machine.writable:
            raise SetupError(wanted.machine.writable)
        if engine.is_live and os.geteuid() != 0:
            raise SetupError(f"only root can set up this machine: {_SUDO}")
        if backup is not None:
            engine.begin()
            self.notes += restore.put(engine, backup, second=is_second)
        results = []
        for result in engine.apply(plan.steps(wanted)):
            results.append(result)
            _print(result, self.places)
        engine.finish({robot: plan.removal_of(robot) for robot in engine.manifest.leaving})
        checked = self._selftest(engine, wanted)
        self._summary(results, wanted, checked)
        return 1 if any(result.state is State.CANNOT for result in results) or checked else 0

    def _selftest(self, engine: Engine, wanted: Plan) -> int | None:
        """The exit code of the self-test of the robot that now runs; None: it is not started by this machine."""
        if not engine.is_live or wanted.machine.systemd or wanted.machine.unit:
            return None
        command = [sys.executable, "-m", "pebble", "doctor", str(self.places.config), "--running"]
        return subprocess.run(command, check=False).returncode

    # -- the end

    def _summary(self, results: Sequence[Result], wanted: Plan, checked: int | None) -> None:
        done = sum(result.state is State.NEW for result in results)
        could_not = [f"{result.step.what}: {result.why}" for result in results if result.state is State.CANNOT]
        skipped = [result.step.what for result in results if result.state is State.SKIPPED]
        by_hand = [result for result in results if result.state is State.BY_HAND]
        could_not += [f"{_where(one, self.places)} was changed by hand and stays{_then(one.why)}" for one in by_hand]
        if skipped:
            could_not.append(f"{self.places.root} is not the system that runs, so not: {'; '.join(skipped)}")
        could_not += [*self.notes, *wanted.machine.lacks()]
        if checked:
            could_not.append(f"the self-test ended with {checked}: pebble doctor {self.places.config} --running")
        _block("Done", [f"{done} steps that were new, see above" if done else "nothing: all was so before"])
        _block("Could not", could_not or ["nothing"])
        _block("Next", self._next(wanted))
        if wanted.answers.page and (self.places.tls / certificates.SERVER_CERT).is_file():
            typer.echo()
            show_qr(_url(self.places), Console())

    def _next(self, wanted: Plan) -> Iterator[str]:
        answers, places = wanted.answers, self.places
        if answers.page and (places.tls / certificates.CA_CERT).is_file():
            yield f"Open {_url(places)} on a phone, and log in as {answers.user}."
            sha = certificates.show(places.tls / certificates.CA_CERT).sha256
            yield f"It trusts the robot once it has {_url(places)}ca.pem; compare the fingerprint: SHA-256 {sha}"
        if wanted.has_own_broker and places.broker_folder.is_dir():
            yield f"Accounts for others: sudo pebble fleet add NAME --role driver --folder {places.broker_folder}"
        if answers.broker == NONE:
            yield f"The robot has no broker yet: {_SUDO} --broker here"
        yield f"{_SUDO} again changes an answer; --undo removes all of it."

    # -- backwards

    def undo(self, *, purge: bool) -> int:
        found = manifest.load(self.places)
        if found is None:
            raise SetupError(f"{self.places.manifest} is not there: this machine was not set up by this command")
        wanted = Plan(self.places, questions.combined(found.answers), detect.machine(self.places), found, Secrets())
        engine = Engine(self.places, found, is_live=self.places.is_live)
        if engine.is_live and os.geteuid() != 0 and not self.dry:
            raise SetupError(f"only root can undo it: {_SUDO} --undo")
        if not (self.dry or self.yes):
            if not self.asks:
                raise AnswersError(
                    "yes is missing: standard input is no terminal, so confirm with --yes (or --dry-run)"
                )
            what = "ERASE this robot, with its keys, people and state" if purge else "remove what setup made"
            typer.confirm(f"Really {what}?", abort=True)
        left = 0
        for what, state, why in engine.undo(plan.steps(wanted), purge=purge, dry=self.dry):
            word = "done" if state is State.NEW and not self.dry else str(state)
            typer.echo(f"{word:<{_WIDTH}}  {what}{_then(why)}")
            left += state is State.CANNOT
        if self.dry:
            typer.echo("Nothing was removed: this was a dry run.")
        elif not purge and self.places.state.exists():
            typer.echo(f"{self.places.state} stays, with the stop and the people in it; --undo --purge would erase it.")
        return 1 if left else 0

    # -- questions

    def _asked(self, wanted: Plan) -> Plan:
        """The plan with the answers to the six questions; what an option answers is not asked."""
        answers, secrets = wanted.answers, wanted.secrets
        for number, ask in enumerate((_ask_id, _ask_board, _ask_camera, _ask_broker, _ask_page), start=1):
            for remaining in reversed(range(_TRIES)):
                found, more = ask(number, answers, secrets)
                wrong = questions.mistakes(found)
                if not wrong:
                    answers, secrets = found, more
                    break
                typer.echo("\n".join(f"    {line}" for line in wrong))
                if not remaining:
                    raise AnswersError("\n".join(wrong))
        secrets = _ask_passwords(wanted, answers, secrets)
        return Plan(wanted.places, answers, wanted.machine, wanted.manifest, secrets)


def _is_named(given: dict[str, Any]) -> bool:
    return any(value is not None for value in given.values())


def _exists(file: Path) -> bool:
    try:
        return file.exists()
    except PermissionError:
        return True  # below a folder that only root may read


def _read_secrets(given: dict[str, Any]) -> Secrets:
    """The passwords in the files that are named. Raises PebbleError, which does not repeat their names."""
    found = {key: given[key] for key in questions.FILES if given.get(key) is not None}
    read = {key: read_password(Path(str(file)), questions.option(key)) for key, file in found.items()}
    return Secrets(password=read.get("password_file"), broker_password=read.get("broker_password_file"))


def _then(why: str) -> str:
    return f": {why}" if why else ""


def _print(result: Result, places: Places) -> None:
    where = _where(result, places)
    shown = f"{result.step.what} ({where})" if where else result.step.what
    typer.echo(f"{result.state:<{_WIDTH}}  {shown}{_then(result.why)}")


def _where(result: Result, places: Places) -> str:
    step = result.step
    return places.named(step.target) if step.target is not None else " ".join(step.command)


def _block(title: str, lines: Iterator[str] | Sequence[str]) -> None:
    typer.echo(f"\n{title}")
    for line in lines:
        typer.echo(f"  {line}")


def _url(places: Places) -> str:
    names = certificates.show(places.tls / certificates.SERVER_CERT).names
    host = f"[{names[0]}]" if ":" in names[0] else names[0]
    return f"https://{host}:{plan.PAGE_PORT}/"


# -- the six questions

_Asked = tuple[Answers, Secrets]


def _choose(number: int, text: str, choices: Sequence[tuple[str, str]], default: str) -> str:
    """One of the values, by its number, or another text."""
    typer.echo(f"\n{number}. {text}")
    for place, (value, label) in enumerate(choices, start=1):
        typer.echo(f"     {place}  {value}{f'  ({label})' if label else ''}")
    answer = str(typer.prompt("   Number, or another answer", default=default))
    return choices[int(answer) - 1][0] if answer.isdecimal() and 0 < int(answer) <= len(choices) else answer


def _ask_id(number: int, answers: Answers, secrets: Secrets) -> _Asked:
    typer.echo(f"\n{number}. What is the robot called? It is a part of all its topics.")
    name = str(typer.prompt("   Name", default=answers.id or questions.host_name()))
    return replace(answers, id=name), secrets


def _ask_board(number: int, answers: Answers, secrets: Secrets) -> _Asked:
    typer.echo("\n   Listening to serial ports…")
    found = list(detect.boards(detect.SERIAL_PORTS))
    choices = [(board.port, board.text) for board in found] + [(NONE, "no board now")]
    known = next((board.port for board in found if board.baud), NONE)
    port = _choose(number, "Which board drives the motors?", choices, answers.port or known)
    if port == NONE:
        return replace(answers, port=NONE, protocol=None, baud=None), secrets
    board = next((board for board in found if board.port == port), None)
    protocol = answers.protocol or (board.protocol if board else None) or next(iter(SERIAL_PROTOCOLS))
    if board is None or board.protocol is None:
        protocol = _choose(number, "What does it speak?", [(name, "") for name in SERIAL_PROTOCOLS], protocol)
    return replace(answers, port=port, protocol=protocol, baud=board.baud if board else answers.baud), secrets


def _ask_camera(number: int, answers: Answers, secrets: Secrets) -> _Asked:
    found = [(camera, "") for camera in detect.cameras(detect.DEVICES)]
    choices = [*found, (NONE, "no camera now")]
    camera = _choose(number, "Which camera?", choices, answers.camera or choices[0][0])
    return replace(answers, camera=camera), secrets


def _ask_broker(number: int, answers: Answers, secrets: Secrets) -> _Asked:
    choices = [(HERE, "on this robot"), (NONE, "none yet")]
    text = "Where is the broker, at which operators meet the robot? Else write HOST or HOST:PORT."
    found = replace(answers, broker=_choose(number, text, choices, answers.broker or HERE))
    if questions.mistakes(found) or not found.is_far:
        return found, secrets
    user = str(typer.prompt("   The robot's account there", default=answers.broker_user or str(answers.id)))
    ca = str(typer.prompt("   File with its authority, ca.pem (empty: a public one)", default=answers.broker_ca or ""))
    return replace(found, broker_user=user, broker_ca=str(Path(ca).absolute()) if ca else None), secrets


def _ask_page(number: int, answers: Answers, secrets: Secrets) -> _Asked:
    typer.echo(f"\n{number}. The operator page, for phones and computers in this network?")
    default = answers.broker != NONE if answers.page is None else answers.page
    page = typer.confirm("   Page", default=default)
    if not page:
        return replace(answers, page=False), secrets
    name = os.environ.get("SUDO_USER") or "admin"
    user = str(typer.prompt("   First user, who may do everything", default=answers.user or name.lower()))
    return replace(answers, page=True, user=user), secrets


def _ask_passwords(wanted: Plan, answers: Answers, secrets: Secrets) -> Secrets:
    """Ask for those that no file has and that are needed."""
    asked = Plan(wanted.places, answers, wanted.machine, wanted.manifest, secrets)
    if asked.has_login and secrets.broker_password is None and not _exists(asked.broker_password):
        text = f"   Password of {answers.account} at the broker"
        secrets = replace(secrets, broker_password=str(typer.prompt(text, hide_input=True)))
    if answers.page and secrets.password is None and not has_user(wanted.places.people, str(answers.user)):
        text = f"   Password of {answers.user}"
        typed = str(typer.prompt(text, hide_input=True, confirmation_prompt="   Again"))
        secrets = replace(secrets, password=usable(typed))
    return secrets
