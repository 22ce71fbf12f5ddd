"""A board's network for the interpreter in Node.js: Wi-Fi, a name server, a time server and an MQTT broker.

What the robot sends is looked at between its turns, so that nothing of this is on its account.
"""

import struct

import board

NAME_SERVER, BROKER, TIME_SERVER = "192.168.1.1", "192.168.1.2", "192.168.1.3"
CONNECT, SUBSCRIBE, PINGREQ, PUBLISH = 1, 8, 12, 3

wifi_up = False
broker_up = True
datagrams = []  # (socket, data, address) from the board
answers = {}  # socket: (data, address) for it
connection = None  # the board's TCP socket
state = bytearray(300)  # the newest that the robot published of its emergency stop
counts = {}  # of the packets that the broker got, by kind


class WLAN:
    PM_NONE = 0

    def __init__(self, interface):
        pass

    def active(self, on=True):
        return True

    def config(self, *_, **__):
        return ""

    def isconnected(self):
        return wifi_up

    def ifconfig(self):
        return ("192.168.1.9", "255.255.255.0", NAME_SERVER, NAME_SERVER)

    def connect(self, ssid, password):
        assert ssid == "Lab"
        assert password == "geheim123"

    def disconnect(self):
        pass


class Socket:
    def __init__(self, family=2, kind=1, *_):
        self._open = True

    def setblocking(self, on):
        assert not on

    def connect(self, address):
        global connection
        assert address[0] == BROKER, address
        connection = self
        board.to_board.clear()
        board.from_board.clear()
        raise OSError(board.Errno.EINPROGRESS)

    def sendto(self, data, address):
        datagrams.append((self, bytes(data), address))
        return len(data)

    def recvfrom(self, size):
        if self not in answers:
            raise OSError(board.Errno.EAGAIN)
        return answers.pop(self)

    def readinto(self, buffer, count=None):
        return board.to_board.readinto(buffer) if broker_up else None

    def write(self, data, first=None, count=None):
        return board.from_board.take(data, first, count) if broker_up else None

    def close(self):
        global connection
        answers.pop(self, None)
        if connection is self:
            connection = None

    def ready(self, mask):
        return broker_up


def serve():
    """What the world does between two turns of the robot."""
    while datagrams:
        socket, data, address = datagrams.pop()
        if address[1] == 53:
            answers[socket] = (name_answer(data), address)
        elif address[1] == 123:
            answers[socket] = (time_answer(data), address)
    if broker_up and board.from_board.used:
        packets(board.from_board.all())


def name_answer(query):
    number = TIME_SERVER if b"pool" in query else BROKER
    address = bytes([int(part) for part in number.split(".")])
    return query[:2] + b"\x81\x80\0\1\0\1\0\0\0\0" + query[12:] + b"\xc0\x0c\0\1\0\1\0\0\0\x3c\0\x04" + address


def time_answer(request):
    return b"\x24\x01\x00\xec" + bytes(20) + request[40:48] + bytes(8) + struct.pack(">II", 3_990_000_000, 0)


def packets(data):
    at = 0
    while at < len(data):
        kind, length, shift = data[at] >> 4, 0, 0
        while True:
            at += 1
            length |= (data[at] & 127) << shift
            shift += 7
            if not data[at] & 128:
                break
        at += 1
        counts[kind] = counts.get(kind, 0) + 1
        if kind == CONNECT:
            board.to_board.put(b"\x20\x02\0\0")
        elif kind == SUBSCRIBE:
            granted = b"\x01" * data[at : at + length].count(b"/incoming/")  # one topic each
            board.to_board.put(bytes((0x90, 2 + len(granted))) + data[at : at + 2] + granted)
        elif kind == PUBLISH and b"/outgoing/estop/mcu" in data[at : at + length]:
            payload = data[data.find(b"{", at) : at + length]
            state[: len(payload)] = payload
            for index in range(len(payload), len(state)):
                state[index] = 32
        elif kind == PINGREQ:
            board.to_board.put(b"\xd0\0")
        at += length
    assert at == len(data), "the robot sent half a packet"


def publish(topic, payload, flags=0):
    """A PUBLISH of the broker; flags: QoS 1 (2), retained (1)."""
    ident = b"\x12\x34" if flags & 2 else b""
    rest = len(topic).to_bytes(2, "big") + topic + ident + payload
    size = bytes((len(rest),)) if len(rest) < 128 else bytes((len(rest) & 127 | 128, len(rest) >> 7))
    return bytes((0x30 | flags,)) + size + rest


class Network:
    WLAN = WLAN
    STA_IF, AP_IF = 0, 1


class SocketModule:
    socket = Socket
    AF_INET, SOCK_DGRAM = 2, 2


board.modules["network"] = Network
board.modules["socket"] = SocketModule
board.modules["ssl"] = board.Nothing  # no case has TLS
