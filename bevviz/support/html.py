"""Self-contained web pages, rendered from ``bevviz/templates``.

Values are text and are escaped. Only the templates contain markup.
"""

from __future__ import annotations

from base64 import b64encode
from functools import lru_cache

from jinja2 import Environment, PackageLoader, StrictUndefined

from bevviz.errors import printable
from bevviz.support.colors import css_properties


def render(template: str, **values: object) -> str:
    """Render a page.

    Args:
        template: file name of the template.
        values: values that the template names. None of them may be missing.
    """
    return template_environment().get_template(template).render(values)


@lru_cache(maxsize=1)
def template_environment() -> Environment:
    """Return the environment of the templates, with the filters for values."""
    templates = Environment(
        loader=PackageLoader("bevviz"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        finalize=_visible,
    )
    templates.globals["palette"] = css_properties()
    templates.filters["base64"] = _base64
    templates.filters["words"] = _words
    return templates


def _visible(value: object) -> object:
    """Return a text with invisible characters escaped as in Python, since they could mislead a reader."""
    if type(value) is not str or value.isprintable():  # Markup has a type of its own.
        return value
    return "\n".join(printable(line) for line in value.split("\n"))


def _base64(data: bytes) -> str:
    """Return data as base64 text."""
    return b64encode(data).decode()


def _words(name: str) -> str:
    """Return ``no_cluster`` as ``no cluster``."""
    return name.replace("_", " ")
