"""Docstrings of names rather than of functions: the text under a field, a constant or a member of an enumeration."""

from __future__ import annotations

import ast
import inspect
import re
from collections.abc import Iterator
from functools import cache
from itertools import pairwise
from types import ModuleType


@cache
def docstrings(module: ModuleType) -> dict[str, str]:
    """Return name, or ``Class.name``, -> the docstring under its assignment."""
    tree = ast.parse(inspect.getsource(module))
    found = dict(_documented(tree.body, ""))
    for node in tree.body:
        if isinstance(node, ast.ClassDef):
            found |= _documented(node.body, f"{node.name}.")
    return found


def markdown(docstring: str) -> str:
    """Return a docstring as one line that can stand in a Markdown table."""
    text = re.sub(r":\w+:`~?([^`]*)`|``(.*?)``", lambda match: f"`{match[1] or match[2]}`", docstring)
    return re.sub(r"\s+", " ", text).strip().replace("|", "\\|")


def _documented(body: list[ast.stmt], prefix: str) -> Iterator[tuple[str, str]]:
    for statement, following in pairwise(body):
        if isinstance(following, ast.Expr) and isinstance(following.value, ast.Constant):
            match statement:
                case ast.AnnAssign(target=ast.Name(id=name)) | ast.Assign(targets=[ast.Name(id=name)]):
                    yield prefix + name, str(following.value.value)
