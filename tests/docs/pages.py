"""Reads ``docs/wire-format.md``: its programs, its example and its tables."""

from __future__ import annotations

import re

from deploy.wire_tables import DOCUMENT
from tests.integration import wire_listener


def text() -> str:
    """The whole document."""
    return DOCUMENT.read_text(encoding="utf-8")


def programs(document: str) -> dict[str, str]:
    """File name -> the Python program that stands in the document under this name."""
    return dict(re.findall(r"^<!-- file: (\S+) -->\n```python\n(.*?)^```$", document, re.MULTILINE | re.DOTALL))


def table_rows(title: str) -> list[dict[str, str]]:
    """Rows of the first table after a line that contains ``title``."""
    return wire_listener.table_rows(text(), title)
