"""The streams that robots serve themselves: only the origins that they report may be shown, and none by a trick.

What the server allows is in the policy of the page; the page checks each address again.
"""

from __future__ import annotations

import re
import socket
from collections.abc import Iterator

import httpx
import msgspec
import pytest

from pebble.client.page import WebSettings
from pebble.transports import MqttSettings
from pebble.web.access.guard import CONTENT_SECURITY_POLICY
from pebble.web.media.robot_streams import MAX_ORIGINS, OwnHosts, origin
from tests.support import Broker, until
from tests.web.in_node import evaluate
from tests.web.served import RecordingRobot, Served

HOST = "pebble.local"
NAMES = (HOST, "*.hall.example", "[fd00::7]:9", "lab.example:443")
BROKER = MqttSettings(host="127.0.0.1")
OWN = OwnHosts(WebSettings(broker=BROKER, names=NAMES))

GOOD = {
    "http://pitcam.local:8889/cam": "http://pitcam.local:8889",
    "https://pitcam.local/cam/?controls=false#top": "https://pitcam.local",
    "HTTP://PitCam.Local": "http://pitcam.local",
    "http://10.0.0.7:8889": "http://10.0.0.7:8889",
    "http://[fe80::1]:8889/cam": "http://[fe80::1]:8889",
    "http://a.b/@c": "http://a.b",
}
BAD = [
    "javascript:alert(1)",
    "JavaScript:alert(1)//http://a.b",
    "data:text/html,<script>alert(1)</script>",
    "blob:http://a.b/1",
    "file:///etc/passwd",
    "ftp://a.b/",
    "//a.b/cam",
    "/cam",
    "",
    "http://",
    "http:///a.b",
    "http:a.b",
    "http://user:secret@a.b/",
    "http://user@a.b/",
    "http://@a.b/",
    "http://pebble.local:80@evil.test/",
    "http://a.b\\@evil.test/",
    "http://a.b:8889\\@evil.test/",
    "http://a.b:/",
    "http://a.b:0/",
    "http://a.b:65536/",
    "http://a.b:8889:80/",
    "http://a.b:8889evil/",
    "http://*/",
    "http://*.b/",
    "http://a.b; script-src *",
    "http://a.b;script-src/",
    "http://a.b,c/",
    "http://a b/",
    " http://a.b/",
    "http://a.b/ x",
    "http://a.b/\nx",
    "http://a.b\r\nset-cookie:x",
    "http://a.b/\u00e9",
    "http://\u0430.b/",
    "http://a'b/",
    "http://[::1",
    "http://a_b/",
    "http://-a.b/",
    "http://a.b/" + "x" * 500,
    # the page's own host, on any port: browsers send its cookies there as well
    "http://pebble.local/",
    "http://pebble.local:8889/cam",
    "https://PEBBLE.LOCAL:1/",
    "http://pebble.local./",
]
#: The page's own hosts by other names and in other spellings, which browsers may have its cookie for.
ALIASES = [
    "http://127.0.0.1:8889/",
    "http://127.1/",
    "http://2130706433/",
    "http://0x7f.1:8889/",
    "http://0177.0.0.1/",
    "http://0x7F000001/",
    "http://127.8.9.10/",
    "http://[::1]:8889/",
    "http://[0:0:0::1]/",
    "http://[::ffff:127.0.0.1]/",
    "http://[::ffff:7f00:1]/",
    "http://0.0.0.0:8889/",
    "http://0/",
    "http://[::]/",
    "http://localhost/",
    "http://LocalHost:8889/",
    "http://localhost./",
    "http://pebble.localhost/",
    "http://cam.hall.example/",
    "https://[fd00:0::7]/",
    "http://lab.example/",
]


@pytest.mark.parametrize("url", GOOD)
def test_an_origin_is_scheme_host_and_port(url: str) -> None:
    assert origin(url, OWN) == GOOD[url]


@pytest.mark.parametrize("url", [*BAD, *ALIASES])
def test_tricks_are_no_origin(url: str) -> None:
    assert origin(url, OWN) == ""


@pytest.mark.parametrize("value", [None, 7, True, {"url": "http://a.b"}, ["http://a.b"]])
def test_what_is_no_text_is_no_origin(value: object) -> None:
    assert origin(value, OWN) == ""


def test_the_page_refuses_the_same() -> None:
    addresses = [*GOOD, *BAD, "http://0x7f.1:8889/", "http://2130706433/", "http://127.1/"]
    steps = """
    const { addresses, host } = given;
    const page = { protocol: "http:", hostname: host };
    const own = { protocol: "http:", hostname: "127.0.0.1" };
    const secure = { protocol: "https:", hostname: host };
    const status = [{ value: { webrtc_url: "a" } }, { value: { webrtcUrl: "a" } }, { value: { url: "a" } },
      { value: { url: 7 } }, { value: null }, { value: [] }, null, 7, undefined];
    result = {
      shown: addresses.filter((one) => !refusal(one, page)),
      own: addresses.slice(-3).filter((one) => !refusal(one, own)),
      secure: addresses.filter((one) => !refusal(one, secure)),
      reported: status.map(reported),
    };"""
    found = evaluate(
        {"core/stream.js": "refusal", "ui/parts/words.js": "reported"}, steps, {"addresses": addresses, "host": HOST}
    )
    assert found["shown"][: len(GOOD)] == list(GOOD)
    assert set(found["shown"][len(GOOD) :]) <= set(addresses[-3:])
    assert found["own"] == []
    assert [one for one in found["secure"] if one in GOOD] == [url for url in GOOD if url.startswith("https")]
    assert found["reported"] == ["a", "a", "a", "", "", "", "", "", ""]


@pytest.fixture
def robot(broker: Broker) -> Iterator[RecordingRobot]:
    with RecordingRobot(broker.port, "pebble/robots/pitcam") as one:
        yield one
        one.publish("status", {"value": {}}, retain=True)


def policy(served: Served, path: str = "/", host: str = "127.0.0.1") -> str:
    found: str = httpx.get(f"http://{host}:{served.port}{path}").headers["content-security-policy"]
    return re.sub(r"'sha256-[^']+' ", "", found)  # of the page's own start


def report(served: Served, robot: RecordingRobot, url: object, key: str = "webrtc_url") -> None:
    """Publish it, and wait until the server has it."""
    robot.publish("status", {"t": 1, "value": {key: url}}, retain=True)
    robots = served.app.state.robots
    assert until(lambda: msgspec.json.encode(url) in bytes(robots.value(robot.base, "status") or b""))


def test_the_page_may_show_exactly_what_robots_report(served: Served, robot: RecordingRobot) -> None:
    assert policy(served) == CONTENT_SECURITY_POLICY
    for number, key in enumerate(("webrtc_url", "webrtcUrl", "url")):
        report(served, robot, f"http://pitcam.local:{8880 + number}/cam", key)
        for path in ("/", f"/r/{robot.base}", "/r/pebble/robots/other"):
            assert policy(served, path) == f"{CONTENT_SECURITY_POLICY}; frame-src http://pitcam.local:{8880 + number}"
        assert policy(served, "/login") == CONTENT_SECURITY_POLICY
    report(served, robot, "https://pitcam.local/")
    assert policy(served) == f"{CONTENT_SECURITY_POLICY}; frame-src https://pitcam.local"


def test_what_may_not_be_shown_changes_no_policy(served: Served, robot: RecordingRobot) -> None:
    for url in ("javascript:alert(1)", "http://a.b; script-src *", "http://u:p@a.b/", 7, ["x"]):
        report(served, robot, url)
        assert policy(served) == policy(served, f"/r/{robot.base}") == CONTENT_SECURITY_POLICY, url


def test_the_own_hosts_are_refused_by_whichever_name_the_page_was_opened(served: Served, robot: RecordingRobot) -> None:
    for url in ("http://localhost:8889/cam", "http://127.1:8889/cam"):
        report(served, robot, url)
        assert policy(served) == policy(served, host="localhost") == CONTENT_SECURITY_POLICY
        with served.page() as page:
            page.send("stream-address", ref=robot.base, url=url)
            assert until(lambda page=page: page.refused)
            assert "browsers would send its login there" in page.refused[0]["why"]


def test_the_addresses_of_a_machine_are_its_own_where_the_page_is_reached_by_them() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.connect(("192.0.2.1", 9))  # sends nothing
        address = probe.getsockname()[0]
    local, reached = (OwnHosts(WebSettings(broker=BROKER, host=one)) for one in ("127.0.0.1", "0.0.0.0"))
    assert (address in local, address in reached, "192.0.2.1" in reached) == (False, True, False)
    assert socket.gethostname() in reached


def test_the_open_robot_comes_first_and_the_header_stays_short(
    served: Served, broker: Broker, robot: RecordingRobot
) -> None:
    robots = [RecordingRobot(broker.port, f"pebble/robots/cam{number}") for number in range(MAX_ORIGINS + 2)]
    try:
        for number, one in enumerate(robots):
            report(served, one, f"http://cam{number}.local/")
        last = robots[-1]
        listed = policy(served, f"/r/{last.base}").partition("frame-src ")[2].split()
        assert listed[0] == f"http://cam{len(robots) - 1}.local"
        assert len(listed) == len(set(listed)) == MAX_ORIGINS
    finally:
        for one in robots:
            one.publish("status", {"value": {}}, retain=True)
            one.close()
