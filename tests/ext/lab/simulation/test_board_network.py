"""The network of a simulated board, real and virtual: MicroPython's semantics, and network faults."""

from __future__ import annotations

import errno
import socket
import ssl
import struct
import threading
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

from pebble.extensions.lab.simulation.micropython.answers import name_answer, time_answer
from pebble.extensions.lab.simulation.micropython.clock import RealClock, VirtualClock
from pebble.extensions.lab.simulation.micropython.modules.sockets import MAX_SOCKETS, HostNetwork
from pebble.extensions.lab.simulation.micropython.modules.streams import POLLERR, POLLIN, POLLOUT
from pebble.extensions.lab.simulation.micropython.servers import LoopbackServers
from tests.ext.lab.simulation.virtual_network import BROKER
from tests.support import free_port, until

TLS = Path(__file__).parents[3] / "data" / "tls"


def joined(network: Any) -> dict[str, Any]:
    """The modules of a board that has joined its Wi-Fi."""
    modules = network.modules()
    station = modules["network"].WLAN(modules["network"].STA_IF)
    station.active(True)
    network.radio.join_s = 0.0
    station.connect("home", "secret")
    assert station.isconnected()
    return modules


def asked(host: str, ident: int = 77) -> bytes:
    """A DNS query for the IPv4 address of ``host``."""
    labels = b"".join(bytes([len(label)]) + label for label in host.encode().split(b"."))
    return struct.pack("!HHHHHH", ident, 0x0100, 1, 0, 0, 0) + labels + b"\0" + struct.pack("!HH", 1, 1)


class TestAnswers:
    def test_a_name_that_is_known(self) -> None:
        query = asked("Broker.lan")
        reply = name_answer(query, {"broker.lan": "10.1.2.3"}.get)
        assert reply is not None
        assert reply[:2] == query[:2]
        assert struct.unpack_from("!HHHHH", reply, 2) == (0x8180, 1, 1, 0, 0)
        assert reply[12 : len(query)] == query[12:]
        assert reply[len(query) :] == struct.pack("!HHHIH", 0xC00C, 1, 1, 60, 4) + bytes([10, 1, 2, 3])

    def test_a_name_that_does_not_exist(self) -> None:
        reply = name_answer(asked("nowhere.lan"), {}.get)
        assert reply is not None
        assert struct.unpack_from("!HHH", reply, 2) == (0x8183, 1, 0)

    @pytest.mark.parametrize(
        "query", [b"", b"\0" * 12, b"\0" * 11 + b"\xff", asked("a.b")[:-1], name_answer(asked("a.b"), {}.get) or b""]
    )
    def test_what_is_no_query_is_not_answered(self, query: bytes) -> None:
        assert name_answer(query, {}.get) is None

    def test_the_time_server_repeats_what_it_was_asked_with(self) -> None:
        request = b"\x23" + bytes(39) + b"12345678"
        reply = time_answer(request, 1_800_000_000.25)
        assert reply is not None
        assert (reply[0], reply[1], reply[24:32]) == (0x24, 2, b"12345678")
        assert struct.unpack_from("!II", reply, 40) == ((1_800_000_000 + 2_208_988_800) & 0xFFFFFFFF, 1 << 30)
        assert time_answer(request[:47], 0.0) is None
        assert time_answer(bytes(48), 0.0) is None


class TestWlan:
    def test_joining_takes_a_while_and_a_second_request_meanwhile_is_an_error_on_an_esp32(self) -> None:
        clock = VirtualClock()
        modules = HostNetwork(clock).modules()
        station = modules["network"].WLAN()
        with pytest.raises(OSError, match="Not Started"):
            station.connect("home", "secret")
        station.active(True)
        station.connect("home", "secret")
        assert not station.isconnected()
        assert station.status() == modules["network"].STAT_CONNECTING
        with pytest.raises(OSError, match="Wifi Internal Error"):
            station.connect("home", "secret")
        clock.advance(1.0)
        assert station.isconnected()
        assert station.ifconfig()[0] == "10.0.0.42"

    @pytest.mark.parametrize("rejoins", [True, False])
    def test_a_lost_access_point_comes_back(self, rejoins: bool) -> None:
        clock = VirtualClock()
        network = HostNetwork(clock)
        station = joined(network)["network"].WLAN()
        network.radio.rejoins = rejoins
        network.radio.lose()
        assert not station.isconnected()
        network.radio.restore()
        assert station.isconnected() is rejoins
        station.disconnect()
        station.connect("home", "secret")
        assert station.isconnected()


@pytest.fixture
def listener() -> Iterator[socket.socket]:
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.settimeout(5)
        yield server


class TestHostTcp:
    def test_nothing_waits(self, listener: socket.socket) -> None:
        network = HostNetwork(RealClock(), routes={BROKER: listener.getsockname()})
        sock = joined(network)["socket"].socket()
        assert network.new_sockets
        with pytest.raises(OSError) as raised:
            sock.connect(BROKER)
        assert raised.value.errno == errno.EINPROGRESS
        far, _ = listener.accept()
        with closing(far), closing(sock):
            assert until(lambda: sock.ready(POLLOUT))
            assert sock.read(10) is None
            assert sock.write(b"hello") == 5
            assert far.recv(10) == b"hello"
            far.sendall(b"abcdef")
            assert until(lambda: sock.ready(POLLIN))
            room = bytearray(4)
            assert (sock.readinto(room), bytes(room), network.unread) == (4, b"abcd", True)
            assert (sock.read(10), network.unread) == (b"ef", False)
            far.close()
            assert until(lambda: sock.ready(POLLIN))
            assert sock.read(10) == b""

    def test_a_write_is_partial_when_the_peer_does_not_read(self, listener: socket.socket) -> None:
        sock = joined(HostNetwork(RealClock(), routes={BROKER: listener.getsockname()}))["socket"].socket()
        with pytest.raises(OSError):
            sock.connect(BROKER)
        far, _ = listener.accept()
        with closing(far), closing(sock):
            assert until(lambda: sock.ready(POLLOUT))
            big = bytes(64_000_000)
            first = sock.write(big)
            assert first is not None
            assert 0 < first < len(big)
            while sock.write(big):
                pass
            assert sock.write(big) is None

    def test_a_refused_connection_is_an_error_at_the_next_read(self) -> None:
        sock = joined(HostNetwork(RealClock(), routes={BROKER: ("127.0.0.1", free_port())}))["socket"].socket()
        with closing(sock):
            with pytest.raises(OSError):
                sock.connect(BROKER)
            assert until(lambda: sock.ready(POLLIN) & POLLERR)
            with pytest.raises(OSError):
                sock.read(1)

    def test_without_wifi_nothing_arrives_and_nothing_can_be_sent(self, listener: socket.socket) -> None:
        network = HostNetwork(RealClock(), routes={BROKER: listener.getsockname()})
        modules = joined(network)
        sock = modules["socket"].socket()
        with pytest.raises(OSError):
            sock.connect(BROKER)
        far, _ = listener.accept()
        with closing(far), closing(sock):
            assert until(lambda: sock.ready(POLLOUT))
            network.radio.lose()
            far.sendall(b"late")
            assert (sock.read(10), sock.write(b"x"), sock.ready(POLLIN | POLLOUT)) == (None, None, 0)
            with pytest.raises(OSError):
                modules["socket"].socket().connect(BROKER)
            network.radio.restore()
            assert until(lambda: sock.read(10) == b"late")

    def test_sockets_that_are_not_closed_run_out(self) -> None:
        network = HostNetwork(RealClock())
        modules = joined(network)
        retained = [modules["socket"].socket() for _ in range(MAX_SOCKETS)]
        with pytest.raises(OSError):
            modules["socket"].socket()
        retained[0].close()
        retained[0].close()
        modules["socket"].socket()
        network.modules()
        assert not network.open

    def test_a_name_holds_the_board_up_and_a_number_does_not(self) -> None:
        clock = VirtualClock()
        module = HostNetwork(clock).modules()["socket"]
        assert module.getaddrinfo("10.0.0.2", 1883)[0][-1] == BROKER
        assert clock.now() == 0.0
        with pytest.raises(OSError):
            module.getaddrinfo("broker.lan", 1883)
        assert clock.now() >= 2.0


class TestTls:
    @pytest.fixture
    def server(self, listener: socket.socket) -> socket.socket:
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
        context.load_cert_chain(TLS / "server.crt", TLS / "server.key")
        threading.Thread(target=_echo, args=(context, listener), daemon=True).start()
        return listener

    def wrapped(self, server: socket.socket, ca: str, name: str | None) -> Any:
        modules = joined(HostNetwork(RealClock(), routes={BROKER: server.getsockname()}))
        context = modules["ssl"].SSLContext(modules["ssl"].PROTOCOL_TLS_CLIENT)
        context.load_verify_locations(cadata=(TLS / ca).read_bytes())
        sock = modules["socket"].socket()
        with pytest.raises(OSError):
            sock.connect(BROKER)
        assert until(lambda: sock.ready(POLLOUT))
        return context.wrap_socket(sock, do_handshake_on_connect=False, server_hostname=name)

    def test_the_handshake_goes_on_with_reads_and_writes(self, server: socket.socket) -> None:
        tls = self.wrapped(server, "ca.crt", "localhost")
        with closing(tls):
            assert until(lambda: tls.write(b"hello") == 5)
            assert until(lambda: tls.read(3) == b"hel")
            assert tls.ready(POLLIN) == POLLIN  # what was deciphered is not in the socket any more
            assert tls.read(10) == b"lo"
            assert tls.read(10) is None

    def test_reads_and_writes_do_not_wait_for_it(self, listener: socket.socket) -> None:
        with closing(self.wrapped(listener, "ca.crt", "localhost")) as tls:  # nothing listens there
            assert (tls.write(b"early"), tls.read(1)) == (None, None)

    @pytest.mark.parametrize(("ca", "name"), [("other-ca.crt", "localhost"), ("ca.crt", "elsewhere.lan")])
    def test_a_stranger_is_an_error(self, server: socket.socket, ca: str, name: str) -> None:
        tls = self.wrapped(server, ca, name)

        def refused() -> bool:
            try:
                tls.read(1)
            except OSError:
                return True
            return False

        with closing(tls):
            assert until(refused)


def _echo(context: ssl.SSLContext, listener: socket.socket) -> None:
    try:
        near, _ = listener.accept()
        with context.wrap_socket(near, server_side=True) as tls:
            while data := tls.recv(100):
                tls.sendall(data)
    except OSError:
        return


class TestServers:
    def test_names_and_time_over_real_udp(self) -> None:
        servers = LoopbackServers()
        network = HostNetwork(RealClock(), routes=servers.routes)
        modules = joined(network)
        with closing(servers), closing(modules["socket"].socket(2, modules["socket"].SOCK_DGRAM)) as sock:

            def address(host: str) -> bytes | None:
                sock.sendto(asked(host), ("10.0.0.53", 53))
                for server in servers.sockets:
                    servers.serve(server)
                try:
                    reply, place = sock.recvfrom(512)
                except OSError:
                    return None
                assert place == ("10.0.0.53", 53)
                return bytes(reply[-4:])

            assert address("pool.ntp.org") == bytes([10, 0, 0, 123])
            assert until(lambda: address("localhost") == bytes([127, 0, 0, 1]))
            servers.names = False
            assert address("pool.ntp.org") is None
