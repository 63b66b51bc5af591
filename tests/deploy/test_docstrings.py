"""What stands under a name is found with the name, and fits into a table."""

import types

import pytest

from deploy import docstrings as module
from deploy.docstrings import docstrings, markdown

SOURCE = '''"""The module."""

PERIOD_S: float = 0.2
"""How often."""
LIMIT = 3
UNDOCUMENTED = 4

class Message:
    """Not a field."""

    seq: int
    """Number, over
    two lines."""
    nameless: int

    def method(self):
        """Not a field either."""
'''


def test_names_and_fields_come_with_what_stands_under_them(monkeypatch):
    monkeypatch.setattr(module.inspect, "getsource", lambda _: SOURCE)
    found = docstrings(types.ModuleType("sample"))
    assert found == {"PERIOD_S": "How often.", "Message.seq": "Number, over\n    two lines."}


@pytest.mark.parametrize(
    ("docstring", "line"),
    [
        ("Number, over\n    two lines.\n", "Number, over two lines."),
        ("``map`` or ``arrays``", "`map` or `arrays`"),
        (
            "see :mod:`common.journal` and :class:`~common.messages.Status`",
            "see `common.journal` and `common.messages.Status`",
        ),
        ("this | that", "this \\| that"),
    ],
)
def test_a_docstring_becomes_one_line_of_markdown(docstring, line):
    assert markdown(docstring) == line
