"""Text for terminals, pages and files."""

import pytest

from plenocli.base.text import json_value, printable, printable_lines, utf8


@pytest.mark.parametrize(
    "text, shown",
    [
        ("Käse 3.5 µm \N{HIRAGANA LETTER A}", "Käse 3.5 µm \N{HIRAGANA LETTER A}"),
        ("a\x1b[31mb\x07", r"a\x1b[31mb\x07"),
        ("\x9d0;title\x9c", r"\x9d0;title\x9c"),
        ("a\nb\tc\r", r"a\nb\tc\r"),
        ("caf\udce9", r"caf\xe9"),
        ("gnp.\N{RIGHT-TO-LEFT OVERRIDE}exe", r"gnp.\u202eexe"),
    ],
)
def test_what_controls_a_terminal_is_shown_escaped(text, shown):
    assert printable(text) == shown and printable(shown) == shown
    assert printable_lines(f"{text}\n\tx") == f"{printable(text, keep=chr(10) + chr(9))}\n\tx"
    assert utf8(text).decode() and json_value({text: [text]}) == {
        printable(text): [printable_lines(text)]
    }
