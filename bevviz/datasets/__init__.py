"""Readers of folders as streams of messages, and of result files. Imports `sync` and the layers below it."""

from __future__ import annotations

import difflib
from functools import cache
from pathlib import Path

from bevviz.datasets.dataset import NOT_AS_DOCUMENTED, Dataset, describe_error, subfolders
from bevviz.errors import UserError
from bevviz.support.extensions import load_class, registered

LEVELS = 2  # of subfolders in which drives are looked for
MAX_SUBFOLDERS = 200  # that are examined in each folder


@cache
def loaders() -> dict[str, type[Dataset]]:
    """Return the registered loaders and that of plain folders by name. The loader of any folder is last."""
    from bevviz.datasets.folder import Folder

    classes: list[type[Dataset]] = [load_class(point, Dataset) for point in registered("datasets").values()]
    classes.append(Folder)
    classes.sort(key=lambda loader: (loader.any_folder, loader.name))
    return {loader.name: loader for loader in classes}


def find_loader(path: Path) -> type[Dataset] | None:
    """Return the loader that recognises a folder; None if there is none.

    The loader of any folder does not take one with a drive of another loader below it: that of a detector's
    training has folders of cut-out objects beside the drive.
    """
    if not path.is_dir():
        return None
    loader = next((loader for loader in loaders().values() if loader.fits(path)), None)
    return None if loader and loader.any_folder and not loader.states(path) and drives_below(path) else loader


def drives_below(path: Path) -> dict[str, type[Dataset]]:
    """Return the loaders of the drives in a folder and in its subfolders, by the drive's relative path.

    The loader of any folder is not asked.
    """
    known = [loader for loader in loaders().values() if not loader.any_folder]
    drives = dict[str, type[Dataset]]()
    level = [path]
    for _ in range(LEVELS):
        inner = [child for folder in level for child in subfolders(folder)[:MAX_SUBFOLDERS]]
        fitting = {child: next((loader for loader in known if loader.fits(child)), None) for child in inner}
        drives |= {child.relative_to(path).as_posix(): loader for child, loader in fitting.items() if loader}
        level = [child for child, loader in fitting.items() if loader is None]
    return drives


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
    warning = ""
    if loader is None:
        drives = drives_below(path) if path.is_dir() else {}
        if not drives:
            return None
        choice, sequence = _choose_below(path, drives, sequence)
        loader, path = drives[choice], path / choice
        warning = f"no drive itself: its folder {choice} is taken ({loader.about})"
    try:
        dataset = loader(path, sequence)
        if warning:
            dataset.warn(warning)
        return dataset
    except NOT_AS_DOCUMENTED as error:
        raise UserError(f"{path}: not as {loader.about} is documented ({describe_error(error)})") from error


def _choose_below(path: Path, drives: dict[str, type[Dataset]], sequence: str) -> tuple[str, str]:
    """Return the chosen one of several drives below a folder, and the sequence within it.

    Raises:
        UserError: there are several, and the user chose none of them.
    """
    if sequence in drives:
        return sequence, ""
    if len(drives) > 1:
        listed = ", ".join(f"{name} ({loader.about})" for name, loader in [*drives.items()][:5])
        more = " ..." if len(drives) > 5 else ""
        raise UserError(
            f"{path}: no drive itself, and {len(drives)} below it; give one of them, or --sequence NAME; "
            f"there are {listed}{more}"
        )
    return next(iter(drives)), sequence
