"""A griffe extension for what docstrings here have and mkdocstrings does not know.

Roles such as ``:class:`~a.b.C``` become links, and a single "Example:" is code, too.
"""

from __future__ import annotations

import re
from typing import Any

import griffe

_EXAMPLE = re.compile(r"^Example:$", re.MULTILINE)
_ROLE = re.compile(r":(?:class|func|meth|mod|attr|data|exc):`(~?)([\w.]+)`")


class Roles(griffe.Extension):
    """Turns roles into optional links: where nothing is documented, only the name remains."""

    def on_object(self, *, obj: griffe.Object, **kwargs: Any) -> None:
        """Changes an object's docstring in place."""
        if obj.docstring is not None:
            text = _EXAMPLE.sub("Examples:", obj.docstring.value)
            obj.docstring.value = _ROLE.sub(_link, text)


def _link(role: re.Match[str]) -> str:
    name = role[2].rpartition(".")[2] if role[1] else role[2]
    if "." not in role[2]:  # it could be a heading of that name
        return f"`{name}`"
    return f'<autoref optional identifier="{role[2]}"><code>{name}</code></autoref>'
