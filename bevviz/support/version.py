"""Version of the package, which the build takes from git."""

from __future__ import annotations

import re
from importlib.metadata import PackageNotFoundError, version

try:
    __version__ = version("bevviz")
except PackageNotFoundError:  # a checkout on the path that is not installed
    __version__ = "0+unknown"


def install_command(extra: str = "", number: str = __version__) -> str:
    """Return the shell command that installs a version of bevviz.

    A released version comes from the package index. Any other is installed in a checkout of its commit.

    Args:
        extra: an extra of the package, such as ``workbench``.
        number: the version.
    """
    extras = f"[{extra}]" if extra else ""
    if re.fullmatch(r"\d+(\.\d+)*", number):
        return f"pip install 'bevviz{extras}=={number}'"
    commit = re.search(r"\+g([0-9a-f]{7,})", number)
    checkout = f"git checkout {commit[1]} && " if commit else ""
    return f"{checkout}pip install '.{extras}'  # in a checkout of bevviz {number}"
