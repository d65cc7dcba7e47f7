"""The text of an option is the string below its declaration: read from the source, never repeated."""

import ast
import inspect
import textwrap
from functools import cache
from typing import Any


@cache
def texts(struct: type[Any]) -> dict[str, str]:
    """Option to text, for a settings Struct and those it inherits from; one line each."""
    found: dict[str, str] = {}
    for kind in reversed(struct.__mro__):
        if kind.__module__ not in ("builtins", "msgspec", "msgspec._core") and hasattr(
            kind, "__struct_fields__"
        ):
            found |= _own_texts(kind)
    return found


def _own_texts(struct: type[Any]) -> dict[str, str]:
    try:
        tree = ast.parse(textwrap.dedent(inspect.getsource(struct)))
    except (OSError, TypeError):
        return {}
    found: dict[str, str] = {}
    option = ""
    for node in tree.body[0].body if isinstance(tree.body[0], ast.ClassDef) else ():
        if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
            option = node.target.id
        elif option and isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
            found[option] = " ".join(str(node.value.value).split())
            option = ""
        else:
            option = ""
    return found
