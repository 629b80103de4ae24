"""Readers of data set folders as streams of messages. Imports `sync` and below."""

from __future__ import annotations

import difflib
from functools import cache
from importlib import import_module
from pathlib import Path
from pkgutil import iter_modules

from bevviz.datasets.dataset import NOT_AS_DOCUMENTED, Dataset, describe
from bevviz.errors import UserError


@cache
def loaders() -> dict[str, type[Dataset]]:
    """Every loader by its name; the one that takes any folder is last."""
    for module in iter_modules(__path__):
        import_module(f"{__name__}.{module.name}")
    found = sorted(Dataset.__subclasses__(), key=lambda loader: (loader.any_folder, loader.name))
    return {loader.name: loader for loader in found}


def find_loader(path: Path) -> type[Dataset] | None:
    """Who recognises a folder; None: nobody."""
    if not path.is_dir():
        return None
    return next((loader for loader in loaders().values() if loader.fits(path)), None)


def open_dataset(path: Path, name: str = "", sequence: str = "") -> Dataset | None:
    """The drive in a folder; None: no loader recognises it.

    Args:
        path: the folder.
        name: of the loader; "": the one that recognises it.
        sequence: which drive, where there are several.

    Raises:
        UserError: no such loader, or the folder is not as its data set asks for.
    """
    if not name:
        loader = find_loader(path)
    elif name in loaders():
        loader = loaders()[name]
        if not path.is_dir():
            raise UserError(f"{path}: --dataset {name} takes a folder: {loader.expects}")
    else:
        near = difflib.get_close_matches(name, loaders(), n=1)
        hint = f"did you mean {near[0]}? There are" if near else "there are"
        raise UserError(f"--dataset {name}: {hint} {', '.join(loaders())}")
    if loader is None:
        return None
    try:
        return loader(path, sequence)
    except NOT_AS_DOCUMENTED as error:
        raise UserError(f"{path}: not as {loader.about} is documented ({describe(error)})") from error
