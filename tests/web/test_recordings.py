"""Recordings as the server offers them to pages: over HTTP, read in another process, and only read."""

from __future__ import annotations

import io
import json
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from functools import partial
from itertools import product
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import av
import httpx
import pytest

from pebble.fleet.people import People
from pebble.fleet.roles import Role
from pebble.recordings.library import files
from pebble.recordings.seek import questions
from pebble.recordings.seek.segment import Flag, unpacked
from pebble.web.recordings import archive_process, routes
from tests.recordings.messages import START_NS
from tests.recordings.others import DAMAGED
from tests.recordings.playing import GOOB, js, ms
from tests.recordings.seek.filming import CAMERA, FPS, film
from tests.support import Broker, until
from tests.web.served import Served

SECONDS = 40
DAY = "2023-11-14"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return film(tmp_path_factory.mktemp("recordings"), "h264", SECONDS)


@pytest.fixture(scope="module")
def archive(broker: Broker, folder: Path) -> Iterator[Served]:
    with Served(broker.port, recordings=folder) as running:
        yield running


def get(served: Served, path: str, **parameters: Any) -> httpx.Response:
    return httpx.get(f"{served.origin}/archive/{path}", params=parameters, timeout=30)


def post(served: Served, path: str, body: Any) -> httpx.Response:
    return httpx.post(f"{served.origin}/archive/{path}", json=body, headers={"origin": served.origin}, timeout=30)


def test_days_and_their_robots(archive: Served) -> None:
    (day,) = get(archive, "days").json()
    assert (day["day"], day["robots"], day["gaps"]) == (DAY, [GOOB], 0)
    assert (day["first"], day["last"]) == (ms(0), ms(SECONDS - 0.02))


def test_a_timeline_is_indexed_once(archive: Served, folder: Path) -> None:
    pytest.importorskip("duckdb")
    answers: list[httpx.Response] = []

    def made() -> bool:
        answers.append(get(archive, "timeline", day=DAY, robot=GOOB))
        return answers[-1].status_code == 200

    assert until(made, 30, step=0.2), answers[-1].text
    assert {answer.status_code for answer in answers[:-1]} <= {202}
    found = answers[-1].json()
    assert found["from"] == ms(0) // 10_000 * 10_000
    assert found["step"] == 10_000
    online, driven, pictures, sound = 1, 2, 64, 128
    assert [step & (online | driven | pictures | sound) for step in found["activity"]] == [
        online | driven | pictures | sound
    ] * len(found["activity"])
    assert len(found["activity"]) == len(found["video"]) == len(found["audio"]) == len(found["rest"]) == 4
    assert found["audio"][1] == pytest.approx(50 * 664 * 8 / 1000, abs=0.1)  # as in the paper, Table 4.1
    assert [round(one["until"] - one["since"]) // 1000 for one in found["sessions"]] == [SECONDS + 10]
    assert (folder / "index").is_dir()
    began = time.monotonic()
    assert get(archive, "timeline", day=DAY, robot=GOOB).status_code == 200
    assert time.monotonic() - began < 2.0


def test_a_segment_is_what_was_recorded(archive: Served) -> None:
    answer = get(archive, "segment", robot=GOOB, at=ms(11), **{"for": 2000, "seek": 1})
    found = list(unpacked(answer.content))
    assert float(answer.headers["x-next"]) == ms(13)
    assert answer.headers["x-complete"] == "1"
    assert sum(bool(flags & Flag.CHAIN) for _, flags, _, _ in found) == FPS  # key frames come every two seconds
    assert get(archive, "segment", robot=GOOB, at=ms(100), **{"for": 2000}).headers["x-next"] == ""


def test_a_picture_a_strip_of_them_and_nothing_where_there_is_none(archive: Served) -> None:
    answer = get(archive, "frame", robot=GOOB, at=ms(20), w=160)
    assert answer.headers["content-type"] == "image/jpeg"
    assert abs(float(answer.headers["x-captured-ms"]) - ms(20)) < 1000 / FPS
    assert av.open(io.BytesIO(answer.content), format="mjpeg").streams.video[0].width == 160
    assert get(archive, "frame", robot=GOOB, at=ms(-60)).status_code == 404
    strip = get(archive, "strip", robot=GOOB, since=ms(0), step=10_000, count=4, w=160)
    assert av.open(io.BytesIO(strip.content), format="mjpeg").streams.video[0].width == 640


@pytest.mark.parametrize("form", ["mkv", "mp4", "mcap"])
def test_a_stretch_is_exported_and_fetched(archive: Served, tmp_path: Path, form: str) -> None:
    answer = post(archive, "exports", {"robot": GOOB, "since": ms(5), "until": ms(15), "as": form})
    assert answer.status_code == 202, answer.text
    place = f"exports/{answer.json()['id']}"
    assert until(lambda: get(archive, place).json()["state"] != "running", 60, step=0.1)
    state = get(archive, place).json()
    assert (state["state"], state["why"], state["done"]) == ("ready", "", pytest.approx(1.0, abs=0.02))
    fetched = get(archive, f"{place}/file")
    assert f"goob-20231114T221325Z.{form}" in fetched.headers["content-disposition"]
    assert len(fetched.content) == state["bytes"]
    target = tmp_path / f"x.{form}"
    target.write_bytes(fetched.content)
    seconds = files([target]) if form == "mcap" else av.open(str(target)).duration / 1e6
    assert seconds == ([target] if form == "mcap" else pytest.approx(10, abs=0.2))
    assert post(archive, f"{place}/end", {}).status_code == 200
    assert get(archive, place).status_code == 404


def test_what_cannot_be_read_is_named_beside_its_day_and_export(broker: Broker, tmp_path: Path) -> None:
    (tmp_path / "a.mcap").write_bytes(DAMAGED["a chunk"][0])
    (tmp_path / "b.mcap").write_bytes(b"no recording")
    with Served(broker.port, recordings=tmp_path) as served:
        unread = [line for day in get(served, "days").json() for line in day["unread"]]
        assert [line.split(": ")[0] for line in sorted(unread)] == ["a.mcap", "b.mcap"]
        begin = START_NS / 1e6
        wanted = {"robot": GOOB, "since": begin, "until": begin + 1000, "as": "mcap"}
        place = f"exports/{post(served, 'exports', wanted).json()['id']}"
        assert until(lambda: get(served, place).json()["state"] != "running", 60, step=0.1)
        state = get(served, place).json()
        assert (state["state"], "1 damaged parts" in state["why"]) == ("ready", True)


def test_one_export_at_a_time_and_it_can_be_ended(archive: Served) -> None:
    wanted = {"robot": GOOB, "since": ms(0), "until": ms(SECONDS), "as": "mp4"}
    first = post(archive, "exports", wanted).json()["id"]
    assert post(archive, "exports", wanted).status_code == 409
    post(archive, f"exports/{first}/end", {})
    second = post(archive, "exports", wanted)
    assert second.status_code == 202
    post(archive, f"exports/{second.json()['id']}/end", {})


@pytest.mark.parametrize(
    ("path", "parameters", "line"),
    [
        ("segment", {"robot": GOOB, "at": "soon", "for": 2000}, "at: a number from 0 to"),
        ("segment", {"robot": GOOB, "at": "nan", "for": 2000}, "at: a number from 0 to"),
        ("segment", {"robot": GOOB, "at": 0, "for": 3_600_000}, "for: a number from 0 to 10000 is needed"),
        ("segment", {"robot": "goob", "at": 0, "for": 1}, 'robot: "goob" is none: write system/type/id'),
        ("segment", {"robot": "a/b/#", "at": 0, "for": 1}, 'robot: "a/b/#" is none'),
        ("timeline", {"robot": GOOB, "day": "../../etc"}, 'day: "../../etc" is none: write 2026-11-20'),
        ("strip", {"robot": GOOB, "since": 0, "step": 1, "count": 999}, "count: a number from 0 to 24"),
        ("strip", {"robot": GOOB, "since": 0, "step": 1, "count": 0}, "count is at least 1"),
        ("frame", {"robot": GOOB}, "at: a number from 0 to"),
    ],
)
def test_a_bad_question_gets_one_line(archive: Served, path: str, parameters: dict[str, Any], line: str) -> None:
    answer = get(archive, path, **parameters)
    assert answer.status_code == 400
    assert line in answer.text
    assert "\n" not in answer.text


@pytest.mark.parametrize(
    "body",
    [
        {},
        {"robot": GOOB, "since": 0, "until": 1e12, "as": "mkv"},
        {"robot": GOOB, "since": 5, "until": 4, "as": "mkv"},
        7,
    ],
)
def test_a_bad_export_is_refused(archive: Served, body: Any) -> None:
    assert post(archive, "exports", body).status_code == 400


def test_nothing_to_export_is_one_line(archive: Served) -> None:
    answer = post(archive, "exports", {"robot": "pebble/robots/no", "since": 5, "until": 9, "as": "mkv"})
    assert (answer.status_code, answer.text) == (422, "nothing is recorded of pebble/robots/no in this time")


def test_without_a_folder_and_without_a_session(broker: Broker, folder: Path, tmp_path: Path) -> None:
    with Served(broker.port) as plain:
        answer = get(plain, "days")
        assert (answer.status_code, answer.text) == (
            404,
            "this server has no recordings: start it with --recordings DIR",
        )
        with plain.page() as page:
            assert page.welcome["recordings"] is False
    people = People(tmp_path / "people.sqlite")
    people.add("ann", "a long password", Role.VIEWER)
    people.close()
    with Served(broker.port, recordings=folder, login=True, people=tmp_path / "people.sqlite") as closed:
        paths = [route.path.replace("{id}", "1") for route in routes.routes() if "POST" not in (route.methods or ())]
        assert {httpx.get(closed.origin + path).status_code for path in paths} == {401}
        assert post(closed, "exports", {}).status_code == 401


def test_the_page_knows_that_there_are_some(archive: Served) -> None:
    with archive.page() as page:
        assert page.welcome["recordings"] is True
    assert httpx.get(f"{archive.origin}/replay/{GOOB}?at=1").status_code == 200


def test_the_process_that_reads_ends_with_the_server_and_is_replaced_if_it_dies(broker: Broker, folder: Path) -> None:
    with Served(broker.port, recordings=folder) as running:
        assert get(running, "days").status_code == 200
        (first,) = running.app.state.recordings.process._pool._processes
        os.kill(first, 9)
        assert until(lambda: get(running, "days").status_code == 200, 10)
        (second,) = running.app.state.recordings.process._pool._processes
    assert second != first
    assert until(lambda: not Path(f"/proc/{second}").exists() or _is_zombie(second), 5)


def test_recorded_commands_reach_no_robot(archive: Served, broker: Broker, folder: Path) -> None:
    """Every route is asked for a time with drive commands; nothing is published below the robot's base."""
    from tests.recordings.recorder.test_record import Reference

    reference = Reference(broker.port)
    for seek in (0, 1):
        get(archive, "segment", robot=GOOB, at=ms(3), **{"for": 5000, "seek": seek})
    for path, more in (("frame", {"at": ms(3)}), ("strip", {"since": ms(0), "step": 1000, "count": 3})):
        get(archive, path, robot=GOOB, **more)
    marker = f"{GOOB}/outgoing/marker"
    reference.transport.publish(marker, b"{}")
    assert until(lambda: reference.of(marker) == [b"{}"], 5)
    assert {message.topic for message in reference.received if message.topic.startswith(GOOB)} == {marker}
    reference.transport.close()


def test_what_was_recorded_may_be_read_with_the_json_that_the_page_reads(archive: Served) -> None:
    answer = get(archive, "segment", robot=GOOB, at=ms(1), **{"for": 1000})
    imu = [payload for _, _, metric, payload in unpacked(answer.content) if metric == "sensors/imu"]
    assert imu == [js(t=ms(1 + 0.1 * number), n=50 + 5 * number) for number in range(10)]
    assert json.loads(imu[0])["n"] == 50
    assert CAMERA.endswith("front-camera")


# -- jobs that fail


def without(package: str, answer: Connection, *arguments: Any) -> None:
    sys.modules[package] = None  # type: ignore[assignment]
    _job_of(arguments)(answer, *arguments)


def full(answer: Connection, *_: Any) -> None:
    _fail(answer, OSError(28, "No space left on device", "/tmp/x"))


def locked(answer: Connection, *arguments: Any) -> None:
    _fail(answer, PermissionError(13, "Permission denied", "/data/index"))


def faulty(answer: Connection, *_: Any) -> None:
    _fail(answer, ValueError("a fault\nof two lines"))


def too_large(answer: Connection, *_: Any) -> None:
    _fail(answer, MemoryError())


def killed(answer: Connection, *_: Any) -> None:
    answer.send(("done", 0.5))
    os.kill(os.getpid(), signal.SIGKILL)


def ended(_answer: Connection, *_: Any) -> None:
    sys.exit(3)


def silent(_answer: Connection, *_: Any) -> None:
    threading.Event().wait()


def stopped(answer: Connection, *_: Any) -> None:
    answer.send(("done", 0.5))
    os.kill(os.getpid(), signal.SIGSTOP)


def _job_of(arguments: tuple[Any, ...]) -> Callable[..., None]:
    return questions.make_timeline_job if isinstance(arguments[0], Path) else questions.export_job


def _fail(answer: Connection, error: Exception) -> None:
    def work() -> None:
        raise error

    questions.answer_with(answer, work)


FAILURES: dict[str, tuple[Callable[..., None], str]] = {
    "DuckDB is missing": (partial(without, "duckdb"), 'this needs DuckDB: pip install "pebble-robot[archive]"'),
    "zstandard is missing": (partial(without, "zstandard"), 'pip install "pebble-robot['),
    "PyAV is missing": (partial(without, "av"), "film needs PyAV: pip install 'pebble-robot[media]'"),
    "the disk is full": (full, "No space left on device; make room on its disk"),
    "the folder is closed": (locked, "/data/index: Permission denied; give the user of this server access to it"),
    "a fault": (faulty, "ValueError: a fault"),
    "no memory": (too_large, "there is too little memory: end other programs, or choose less"),
    "killed": (killed, "its process was killed, as it is where memory runs out"),
    "ended": (ended, "its process has ended (3): the log of the server says why"),
    "silent": (silent, "it did nothing for 3 s and was ended: look at the disk, then try again"),
    "stopped": (stopped, "it did nothing for 3 s and was ended: look at the disk, then try again"),
}
NOT_OF = {  # they do without
    ("timeline", "PyAV is missing"),
    ("timeline", "zstandard is missing"),
    ("export", "DuckDB is missing"),
}


@pytest.mark.parametrize(
    ("kind", "failure"), [one for one in product(["timeline", "export"], FAILURES) if one not in NOT_OF]
)
def test_a_job_that_fails_is_shown_with_its_reason_until_a_person_tries_again(
    broker: Broker, folder: Path, monkeypatch: pytest.MonkeyPatch, kind: str, failure: str
) -> None:
    job, why = FAILURES[failure]
    asked = partial(get, path="timeline", day=DAY, robot=GOOB)
    with Served(broker.port, recordings=folder) as running, monkeypatch.context() as patched:
        patched.setattr(archive_process, "SILENT_S", 3.0 if job in (silent, stopped) else archive_process.SILENT_S)
        patched.setattr(questions, "make_timeline_job" if kind == "timeline" else "export_job", job)
        if kind == "timeline":
            assert until(lambda: asked(running).status_code != 202, 30, step=0.1)
            answers = [asked(running) for _ in range(3)]
            assert [(one.status_code, why in one.text, "\n" in one.text) for one in answers] == 3 * [(422, True, False)]
        else:
            wanted = {"robot": GOOB, "since": ms(5), "until": ms(6), "as": "mkv"}
            place = f"exports/{post(running, 'exports', wanted).json()['id']}"
            assert until(lambda: get(running, place).json()["state"] != "running", 30, step=0.1)
            shown = get(running, place).json()
            assert (shown["state"], why in shown["why"]) == ("failed", True), shown
        patched.undo()
        if kind == "timeline":
            pytest.importorskip("duckdb")
            assert asked(running, again=1).status_code == 202
            assert until(lambda: asked(running).status_code == 200, 30, step=0.1)
        else:
            assert post(running, "exports", wanted).status_code == 202


@pytest.mark.parametrize(
    ("break_it", "why"),
    [
        (lambda archive, _: (archive / "index").write_text(""), "index: File exists; move it away"),
        (lambda _, scratch: scratch.rmdir(), ""),
    ],
)
def test_a_timeline_of_a_folder_that_is_not_as_it_was(
    broker: Broker, tmp_path: Path, break_it: Callable[[Path, Path], object], why: str
) -> None:
    pytest.importorskip("duckdb")
    archive = film(tmp_path, "h264", 2)
    with Served(broker.port, recordings=archive) as running:
        break_it(archive, Path(running.app.state.recordings.scratch))
        asked = partial(get, running, "timeline", day=DAY, robot=GOOB)
        assert until(lambda: asked().status_code != 202, 30, step=0.1)
        assert [why in one.text for one in (asked(), asked(), asked())] == [True] * 3
        assert asked().status_code == (422 if why else 200)


def test_a_day_names_a_file_of_which_a_part_cannot_be_read(broker: Broker, tmp_path: Path) -> None:
    pytest.importorskip("duckdb")
    archive = film(tmp_path, "h264", 2)
    _flip(next(archive.rglob("*.state.mcap")))
    with Served(broker.port, recordings=archive) as running:
        assert "state.mcap" in get(running, "days").text


def _flip(file: Path) -> None:
    with file.open("r+b") as opened:
        opened.write(b"x")


def _is_zombie(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "Z"
    except OSError:
        return True
