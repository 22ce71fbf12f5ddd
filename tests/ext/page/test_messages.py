"""The messages between page and server, and what is generated from them."""

import msgspec

from pebble.extensions.operator.client import drive_reasons
from pebble.extensions.page import messages
from tools import messages_docs

decoder = msgspec.json.Decoder(messages.FromPage)


def test_the_declarations_are_current():
    assert messages_docs.DECLARATIONS.read_text() == messages_docs.declarations()


def test_the_table_has_each_word(tmp_path):
    messages_docs.main([str(tmp_path)])
    words = (tmp_path / "words.md").read_text()
    assert [code for code in drive_reasons.WORDS if f"| `{code}` |" not in words] == []


def test_what_a_page_sends_is_understood():
    op = decoder.decode(
        b'{"op":"drive","ref":"pebble/robots/goob","g":3,"t":1234.5,"x":0.25,"z":-1,"y":0,"final":false}'
    )
    assert op == messages.DriveOp(ref="pebble/robots/goob", g=3, t=1234.5, x=0.25, z=-1.0)
