"""This is as much MQTT 3.1.1 as the robot and the operator in MicroPython need. Only connecting waits."""

import json, select, socket, struct, time

ALIVE_S, LONGEST = 5, 1024  # a longer packet is skipped, not stored: memory is small


class Mqtt:
    """``login``: user, password, and the certificate of the broker's authority; (): without, and without TLS."""

    def __init__(self, host, port, name, login, connected, lost, will=None):
        """``connected`` and ``lost`` are called then; ``lost`` also before each attempt, which may take seconds."""
        self.host, self.port, self.name, self.login, self.will = host, port, name, login, will
        self.connected, self.lost = connected, lost
        self.socket = self.poller = None
        self.drop()

    def drop(self):
        if self.socket:
            self.socket.close()
        self.socket, self.into, self.out, self.skip, self.number = None, b"", b"", 0, 0

    def connect(self):
        """Raises OSError."""
        if time.gmtime()[0] < 2024:  # certificates have a date
            import ntptime

            ntptime.settime()
        self.socket = socket.socket()
        self.socket.settimeout(2)
        self.socket.connect(socket.getaddrinfo(self.host, self.port)[0][-1])
        if self.login:
            import tls

            context = tls.SSLContext(tls.PROTOCOL_TLS_CLIENT)
            context.verify_mode = tls.CERT_REQUIRED
            context.load_verify_locations(self.login[2])
            self.socket = context.wrap_socket(self.socket, server_hostname=self.host)
        self.socket.setblocking(False)
        self.poller = select.poll()
        self.poller.register(self.socket, select.POLLIN)
        will = text(self.will[0]) + text(self.will[1]) if self.will else b""
        flags = (
            0x02 | (0x2C if self.will else 0) | (0xC0 if self.login else 0)
        )  # a clean session; a will that is retained
        login = text(self.login[0]) + text(self.login[1]) if self.login else b""
        self.send(0x10, text("MQTT") + bytes((4, flags, 0, ALIVE_S)) + text(self.name) + will + login)
        self.received_at = self.pinged = time.ticks_ms()
        while not self.into:
            self.turn(20)
        if self.into[:1] != b"\x20" or self.into[3]:
            raise OSError("the broker refuses it")
        self.into = self.into[4:]

    def send(self, first, body):
        size = len(body)
        self.out += bytes((first, size)) if size < 128 else bytes((first, size & 127 | 128, size >> 7))
        self.out += body

    def publish(self, topic, value, qos=1, retain=False):
        self.number = self.number % 65535 + 1
        if self.socket:
            number = struct.pack("!H", self.number) if qos else b""
            self.send(0x30 | qos << 1 | retain, text(topic) + number + json.dumps(value).encode())

    def subscribe(self, *topics):
        self.send(0x82, b"\x00\x01" + b"".join([text(one) + b"\x01" for one in topics]))

    def turn(self, wait_ms):
        """Send, and wait so long for what arrives. Raises OSError when the connection has ended."""
        self.out = self.out[self.socket.write(self.out) or 0 :] if self.out else b""
        for _ in self.poller.poll(wait_ms):
            more = self.socket.read(LONGEST)  # None: of TLS there is only a part of a record
            if more == b"":
                raise OSError("the broker has closed the connection")
            self.into, self.received_at = self.into + (more or b""), time.ticks_ms()
        if time.ticks_diff(time.ticks_ms(), self.received_at) > 1000 * ALIVE_S:
            raise OSError("the broker is silent")
        if time.ticks_diff(time.ticks_ms(), self.pinged) > 400 * ALIVE_S:
            self.pinged = time.ticks_ms()
            self.send(0xC0, b"")

    def messages(self, wait_ms):
        """Wait so long; topic, payload and whether it was retained, of each message that has arrived."""
        try:
            if not self.socket:
                self.lost()
                self.connect()
                self.connected()
            self.turn(wait_ms)
        except OSError:
            self.drop()
            self.lost()
            time.sleep_ms(200)
        while True:
            skipped = min(self.skip, len(self.into))
            self.skip, self.into = self.skip - skipped, self.into[skipped:]
            at, size, byte = 1, 0, 128
            while byte > 127 and at < len(self.into):
                byte = self.into[at]
                size, at = size | (byte & 127) << 7 * (at - 1), at + 1
            if byte > 127 or len(self.into) < at + min(size, LONGEST):
                return
            first, body = self.into[0], self.into[at : at + min(size, LONGEST)]
            self.into, self.skip = self.into[at + len(body) :], size - len(body)
            if first >> 4 == 3:
                start = 2 + struct.unpack("!H", body)[0]
                if first & 6:
                    self.send(0x40, body[start : start + 2])
                payload = body[start + (2 if first & 6 else 0) :] if not self.skip else b"too long"
                yield body[2:start].decode(), payload, bool(first & 1)


def text(of):
    of = of.encode() if isinstance(of, str) else of
    return struct.pack("!H", len(of)) + of
