"""Readers of data set folders as streams of messages. Imports `sync` and the layers below it."""

from __future__ import annotations

import difflib
from functools import cache
from importlib import import_module
from pathlib import Path
from pkgutil import iter_modules

from bevviz.datasets.dataset import NOT_AS_DOCUMENTED, Dataset, describe_error
from bevviz.errors import UserError


@cache
def loaders() -> dict[str, type[Dataset]]:
    """Return all loaders by name. The loader of any folder is last."""
    for module in iter_modules(__path__):
        import_module(f"{__name__}.{module.name}")
    classes = sorted(Dataset.__subclasses__(), key=lambda loader: (loader.any_folder, loader.name))
    return {loader.name: loader for loader in classes}


def find_loader(path: Path) -> type[Dataset] | None:
    """Return the loader that recognises a folder; None if there is none."""
    if not path.is_dir():
        return None
    return next((loader for loader in loaders().values() if loader.fits(path)), None)


def open_dataset(path: Path, name: str = "", sequence: str = "") -> Dataset | None:
    """Open the drive in a folder. Return None if no loader recognises the folder.

    Args:
        path: folder.
        name: name of the loader; empty: the loader that recognises the folder.
        sequence: name of the drive if the folder has several.

    Raises:
        UserError: there is no such loader, or the folder does not have the layout of its data set.
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
        raise UserError(f"{path}: not as {loader.about} is documented ({describe_error(error)})") from error
