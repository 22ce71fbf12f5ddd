"""The messages between page and server, and what is generated from them."""

import re

import msgspec
import pytest

from pebble.web import messages, messages_docs

decoder = msgspec.json.Decoder(messages.FromPage)


def test_the_documents_are_current():
    assert messages_docs.DOCS.read_text() == re.sub(r"\n{3,}", "\n\n", messages_docs.markdown())
    assert messages_docs.DECLARATIONS.read_text() == messages_docs.declarations()


@pytest.mark.parametrize(
    "wrong",
    [
        b'{"op":"drive","ref":"a/b/c","g":1,"t":1,"x":NaN}',
        b'{"op":"drive","ref":"a/b/c","g":1,"t":1,"x":Infinity}',
        b'{"op":"drive","ref":"a/b/c","g":1,"t":1,"x":1.01}',
        b'{"op":"drive","ref":"a/b/c","g":1,"t":1,"x":"1"}',
        b'{"op":"drive","ref":"a/b/c","g":-1,"t":1}',
        b'{"op":"drive","ref":"a/b/c","g":1,"t":1e300}',
        b'{"op":"estop","ref":"","stop":"not a name"}',
        b'{"op":"estop","ref":"","stop":"0123456789abcdef\\n"}',
        b'{"op":"format-disk"}',
        b'{"ref":"a/b/c"}',
        b"[]",
        b"[" * 5000,
    ],
)
def test_what_is_not_a_message_is_refused(wrong):
    with pytest.raises((msgspec.MsgspecError, RecursionError)):
        decoder.decode(wrong)


def test_what_a_page_sends_is_understood():
    op = decoder.decode(
        b'{"op":"drive","ref":"pebble/robots/goob","g":3,"t":1234.5,"x":0.25,"z":-1,"y":0,"final":false}'
    )
    assert op == messages.DriveOp(ref="pebble/robots/goob", g=3, t=1234.5, x=0.25, z=-1.0)
