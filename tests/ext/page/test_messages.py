"""The messages between page and server, and what is generated from them."""

from pebble.extensions.operator.client import drive_reasons
from tools import messages_docs


def test_the_declarations_are_current():
    assert messages_docs.DECLARATIONS.read_text() == messages_docs.declarations()


def test_the_table_has_each_word(tmp_path):
    messages_docs.main([str(tmp_path)])
    words = (tmp_path / "words.md").read_text()
    assert [code for code in drive_reasons.WORDS if f"| `{code}` |" not in words] == []
