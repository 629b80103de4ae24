"""Pages for any browser that need nothing but themselves, filled in from ``bevviz/templates``.

Whatever is filled in is text and escaped; what is markup stands in the templates.
"""

from __future__ import annotations

from base64 import b64encode
from functools import lru_cache

from jinja2 import Environment, PackageLoader, StrictUndefined

from bevviz.support.text import printable


def render(template: str, **values: object) -> str:
    """The page.

    Args:
        template: name of its file.
        values: what the template names, and nothing that it names may be missing.
    """
    return environment().get_template(template).render(values)


@lru_cache(maxsize=1)
def environment() -> Environment:
    """The templates, and what they may do with values."""
    found = Environment(
        loader=PackageLoader("bevviz"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        finalize=_visible,
    )
    found.filters["base64"] = _base64
    found.filters["words"] = _words
    return found


def _visible(value: object) -> object:
    """What no reader would see, and might be misled by, is told as Python would."""
    if type(value) is not str or value.isprintable():  # markup has a type of its own
        return value
    return "\n".join(printable(line) for line in value.split("\n"))


def _base64(data: bytes) -> str:
    return b64encode(data).decode()


def _words(name: str) -> str:
    """``no_cluster`` as ``no cluster``."""
    return name.replace("_", " ")
