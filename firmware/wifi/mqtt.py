"""An MQTT 3.1.1 client: bytes in, bytes out, no socket, no clock. Pure.

Memory is fixed: one incoming packet and a small output buffer. Longer packets are skipped without being stored. A
ValueError means that the broker refused the connection or violated the protocol: close it. Section numbers are those
of the OASIS standard of 2014.
"""


class Client:
    """The client. ``space`` and ``take`` are for input; ``send``, ``out``, ``waiting`` and ``sent`` for output."""

    def __init__(self, incoming: int, outgoing: int, root: bytes, topics: tuple, plain: int, names) -> None:
        """Store the arguments. ``incoming``: bytes of the longest packet to read; ``outgoing``: of the output buffer.

        ``topics``: the first ``plain`` ones are subscribed to, below ``root``; the first of all is the topic of stops.
        ``names``: the module names.py if the broker checks names, so that all are subscribed to with the sender's
        account, too; else None.
        """
        self.data = memoryview(bytearray(incoming))
        self.out = memoryview(bytearray(outgoing))
        self.root = root
        self.topics = topics
        self.plain = plain
        self.names = names
        self.topic = -1  # of the publication: its place in ``topics``, -1: it is none of them
        self.by = ""  # the account in its topic; "": there is none
        self.first = self.last = 0  # the payload is ``data[first:last]``
        self.retained = 0  # 1: it was retained
        self.restart()

    def restart(self) -> None:
        """Discard all state for a new connection."""
        self.waiting = self._at = self._end = self._skip = self._asked = 0
        self._more: list[bytes | memoryview] = []  # what follows ``out``, and has no room in it yet

    # -- in

    def space(self) -> memoryview:
        """Return the buffer for the next bytes; pass their number to ``take``."""
        left = self._end - self._at
        if left and self._at:
            self.data[:left] = bytes(self.data[self._at : self._end])
        self._at = 0
        self._end = left
        return self.data[left:]

    def take(self, count: int = 0) -> str:
        """Return the kind of the next packet: "welcome", "subscribed", "publication" or "pong"; "": there is none.

        ``count`` bytes were received since the last call. A publication is on ``topics[topic]``, ``retained`` or not,
        of the account ``by``; its payload is ``data[first:last]`` until the next call of ``space``. If its payload is
        too long to be stored, the kind is "too long". After "subscribed" that range has a byte for each topic of
        ``subscribe``, above 127 if the topic is refused.
        """
        data = self.data
        self._end += count
        # Nothing is read while ``_more``, which is to be sent, waits for room in ``out``. 6: an answer, and a ping.
        while not self._more and len(self.out) - self.waiting > 6:
            skipped = min(self._skip, self._end - self._at)
            self._skip -= skipped
            start = at = self._at = self._at + skipped
            length = shift = 0
            byte = 128
            while byte > 127:  # 2.2.3: seven bits a byte, least significant first, at most four bytes
                at += 1
                if at >= self._end:
                    return ""
                if shift > 21:
                    raise ValueError("length")
                byte = data[at]
                length |= (byte & 127) << shift
                shift += 7
            stop = at + 1 + length
            if stop > self._end and self._end - start < len(data):  # incomplete, and there is room for more of it
                return ""
            self._at = min(stop, self._end)
            self._skip = stop - self._at  # the rest of a packet that is too long
            first = data[start]
            if first >> 4 == 3:
                self._publication(first, at + 1, stop)
                return "too long" if self._skip else "publication"
            code = data[self._at - 1]
            if first == 0x20 and length == 2:  # CONNACK
                if code:  # 3.2.2.3: 1 protocol, 2 client id, 3 broker unavailable, 4 user or password, 5 rights
                    raise ValueError("refused by the broker: %d" % code)
                return "welcome"
            if first == 0x90 and length == 2 + self._asked:  # SUBACK
                self.first = at + 3
                self.last = stop
                return "subscribed"
            if first == 0xD0 and not length:  # PINGRESP
                return "pong"
            raise ValueError("packet %02x" % first)
        return ""

    def _publication(self, first: int, at: int, stop: int) -> None:
        """Acknowledge a publication, even one too long to be stored: else the broker holds back the next ones."""
        data = self.data
        # ``topic`` is where the topic ends: beyond ``stop``, and so refused below, if not even its length is there.
        # ``body`` is where the payload begins, ``_end`` the end of what was received.
        topic = at + 2 + (data[at] << 8 | data[at + 1]) if stop - at > 1 else stop + 1
        body = topic + (first & 6)  # QoS 1 sets the bit of 2, and puts a packet id of 2 bytes before it
        if first & 4 or body > stop or body > self._end:  # QoS above 1, or cut off
            raise ValueError("publication")
        if body > topic:
            out, end = self.out, self.waiting
            out[end] = 0x40  # PUBACK, written in place: a flood of them must not allocate memory
            out[end + 1] = 2
            out[end + 2] = data[topic]
            out[end + 3] = data[topic + 1]
            self.waiting = end + 4
        self._match(at + 2, topic)
        self.first = body
        self.last = stop
        self.retained = first & 1

    def _match(self, at: int, stop: int) -> None:
        """Set ``topic`` and ``by`` for the topic in this range."""
        data, topics, count = self.data, self.topics, self.plain
        self.by = ""
        self.topic = -1
        first = at + len(self.root)
        if first > stop or data[at:first] != self.root:
            return
        if self.names and data[first : first + 3] == b"by/":  # type: ignore[comparison-overlap]
            self.by, first = self.names.sender(data, first + 3, stop)
            count = len(topics) if self.by else 1  # with an invalid account only a stop counts
        name = data[first:stop]
        while count and name != topics[count - 1]:
            count -= 1
        self.topic = count - 1

    # -- out

    def send(self, first: int, *parts: bytes) -> bool:
        """Queue a packet of these parts; False if there is no room now. One longer than ``out`` passes in pieces."""
        length = sum(map(len, parts))
        size = len(self.out)
        if self._more or size - self.waiting < length + 3 <= size:  # no room now; it fits once ``out`` is empty
            return False
        self._more.append(bytes((first, length)) if length < 128 else bytes((first, length & 127 | 128, length >> 7)))
        self._more.extend(parts)
        self.sent(0)  # nothing was sent: this only fills ``out``
        return True

    def subscribe(self, count: int) -> None:
        """Subscribe to the first ``count`` topics: the ``plain`` ones, then all with the sender's account (3.8).

        The second part only if names are checked. Stops and resets have QoS 1, all others QoS 0: for a client that
        reads slowly a broker drops the newest messages of QoS 0, but stores some of QoS 1.
        """
        names = self.names
        both = self.topics[: min(count, self.plain)]
        both += tuple([names.ANY + topic for topic in self.topics[:count]] if names else ())
        self._asked = len(both)
        filters = [text(self.root + topic) + (b"\1" if b"estop" in topic else b"\0") for topic in both]
        self.send(0x82, b"\x00\x01", *filters)  # with packet id 1

    def publish(self, retain: int, topic: bytes, payload: bytes) -> bool:
        """Publish with QoS 0; ``retain`` 1: as a retained message. False if there is no room for it now."""
        return self.send(0x30 | retain, bytes((len(topic) >> 8, len(topic) & 255)), topic, payload)

    def sent(self, count: int) -> None:
        """Remove the ``count`` bytes of ``out`` that were sent, and refill it."""
        left = self.waiting - count
        if count and left:
            self.out[:left] = bytes(self.out[count : self.waiting])
        while self._more and left < len(self.out):
            part = self._more.pop(0)
            room = len(self.out) - left
            if len(part) > room:
                part = memoryview(part)
                self._more.insert(0, part[room:])
                part = part[:room]
            self.out[left : left + len(part)] = part
            left += len(part)
        self.waiting = left


def text(data: bytes) -> bytes:
    """Return a string of a packet: its length, then its bytes (1.5.3)."""
    return bytes((len(data) >> 8, len(data) & 255)) + data


def login(name: bytes, user: bytes, password: bytes, topic: bytes, will: bytes, alive_s: int) -> tuple:
    """Return a CONNECT for ``send``: a clean session, and a retained ``will`` of QoS 1 on ``topic`` (3.1)."""
    # clean session 2, will 4, its QoS 8, its retain flag 32, password 64, user 128
    # a password needs a user, whose name may be empty (3.1.2.9)
    flags = 0x2E | (0xC0 if password else 0x80 if user else 0)
    head = b"\x00\x04MQTT\x04" + bytes((flags, alive_s >> 8, alive_s & 255))
    secrets = (text(user) if user or password else b"") + (text(password) if password else b"")
    return 0x10, head, text(name), text(topic), text(will), secrets
