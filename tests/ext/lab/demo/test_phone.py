"""The demo's page for a phone: its address as a QR code, a login, and a password that nothing but a terminal gets."""

from __future__ import annotations

import io
import json
import re
import ssl
import urllib.error
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from rich.console import Console

from pebble.errors import PebbleError
from pebble.extensions.lab.demo.main import run
from pebble.extensions.lab.demo.phone import NAME, Phone, qr_lines
from pebble.extensions.lab.rig.processes import end_all
from pebble.extensions.lab.rig.testbed import PageServer
from tests.support import WAIT_S, Broker


def test_the_code_is_read_as_the_address() -> None:
    lines = list(qr_lines(url := "https://192.168.100.100:45678/"))
    halves = [[one in signs for one in line] for line in lines for signs in ("▀█", "▄█")]
    picture = np.where(np.array(halves), 0, 255).astype(np.uint8).repeat(8, 0).repeat(8, 1)
    assert cv2.QRCodeDetector().detectAndDecode(picture)[0] == url
    assert len(lines[0]) <= 45, "it fits beside nothing else into the smallest terminal"
    assert len(lines) <= 23


def test_without_a_terminal_nothing_is_started(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(PebbleError, match="prints a password, to a terminal only"):
        run(for_phones=True)
    assert capsys.readouterr().out == ""


@pytest.fixture
def phone(tmp_path: Path) -> Phone:
    return Phone(tmp_path)


@pytest.fixture
def page(tmp_path: Path, phone: Phone) -> Iterator[PageServer]:
    broker = Broker(tmp_path)
    server = PageServer(tmp_path, broker.port, port=0, **phone.settings)
    try:
        server.wait()
        yield server
    finally:
        end_all([server])
        broker.stop()


def login(url: str, password: str, authority: Path) -> int:
    """The status of the answer, of a browser that trusts the authority."""
    headers = {"Content-Type": "application/json", "Origin": url.rstrip("/")}
    body = json.dumps({"user": NAME, "password": password}).encode()
    request = urllib.request.Request(f"{url}api/login", body, headers)
    try:
        with urllib.request.urlopen(
            request, timeout=WAIT_S, context=ssl.create_default_context(cafile=authority)
        ) as one:
            return int(one.status)
    except urllib.error.HTTPError as error:
        return error.code


def test_the_password_that_is_printed_opens_the_page(tmp_path: Path, phone: Phone, page: PageServer) -> None:
    printed = Console(file=io.StringIO(), width=80, force_terminal=True)
    phone.show(page.url, printed)
    shown = printed.file.getvalue()  # type: ignore[attr-defined]
    (password,) = re.findall(rf"Log in as {NAME} with the password (\S+)", shown)
    authority = phone.settings["authority"]
    port = page.url.rstrip("/").rpartition(":")[2]
    for host in (page.url, f"https://localhost:{port}/"):
        assert [login(host, one, authority) for one in (password, password[::-1])] == [200, 401]
    stored = [file for file in tmp_path.rglob("*") if file.is_file() and password.encode() in file.read_bytes()]
    assert stored == []
    assert password not in Path(f"/proc/{page.pid}/cmdline").read_text()
