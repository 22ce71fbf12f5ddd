"""DNS queries for IPv4 addresses (RFC 1035; one-shot mDNS, RFC 6762 section 5.1). Pure: bytes in, bytes out."""


def query(host: str, nonce: bytes) -> bytes:
    """Return the query for ``host``; ``nonce`` is two random bytes. Raises ValueError for an invalid name."""
    # recursion desired; one question
    data = nonce + b"\1\0\0\1\0\0\0\0\0\0"
    for label in host.lower().encode().rstrip(b".").split(b"."):
        if not 0 < len(label) < 64:
            raise ValueError("not a host name: " + host)
        data += bytes((len(label),)) + label
    return data + b"\0\0\1\0\1"  # type address, class internet


def answer(data: bytes, asked: bytes, skip: int = 0) -> str | None:
    """Return the address in ``data``, "" if there is none, None if it does not answer the query ``asked``.

    Of several addresses it returns the first if ``skip`` is 0. Else it sorts them, and ``skip`` modulo their number is
    the index. Servers change the order of their answers: so a caller can try each only by its place in a sorted list.
    The case of the name does not matter; in ``asked`` it is lower, see `query`.
    """
    at = len(asked)
    if len(data) < at or data[:2] != asked[:2] or data[12:at].lower() != asked[12:]:
        return None
    if data[2] & 0xF8 != 0x80 or data[4:6] != b"\0\1":  # not a response to a standard query of one question
        return None
    # Aliases (CNAME) come first, then their addresses: none for an unknown name, or if the server has trouble
    addresses: list[bytes] = []
    for _ in range(data[6] << 8 | data[7]):
        while at < len(data) and 0 < data[at] < 64:  # a name: labels, then 0 or, above 63, where the rest is
            at += data[at] + 1
        at += 1 if data[at : at + 1] == b"\0" else 2
        if at + 10 > len(data):
            break
        length = data[at + 8] << 8 | data[at + 9]
        # type address, class internet; mDNS may set the highest bit of the class
        if data[at : at + 2] == b"\0\1" and data[at + 2] & 127 == 0 and data[at + 3] == 1 and length == 4:
            address = data[at + 10 : at + 14]
            if len(address) == 4 and address not in addresses:
                addresses.append(address)
            if not skip:
                break
        at += 10 + length
    if not addresses:
        return ""
    addresses.sort()
    return "%d.%d.%d.%d" % tuple(addresses[skip % len(addresses)])
