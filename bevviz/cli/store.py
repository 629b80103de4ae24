"""Command ``bevviz store``: show or empty the store of results."""

from __future__ import annotations

from dataclasses import dataclass

from bevviz.cli.command import command, flag
from bevviz.errors import UserError


@dataclass(frozen=True, kw_only=True)
class StoreOptions:
    """Options of ``store``."""

    clear: bool = flag("delete all results")


@command(
    "store",
    description="Print where detections of images and results of stages are kept, how many there are, "
    "and what they take. --set store.size=0 makes a command do without them.",
)
def _store(options: StoreOptions) -> int:
    from bevviz.config import load
    from bevviz.pipeline.result_store import ResultStore, store_folder

    limit, folder = load().store.size, store_folder()
    if folder is None:
        raise UserError("BEVVIZ_STORE is empty: no results are kept")
    with ResultStore(folder, int(limit * 1e6)) as store:
        if options.clear:
            print(f"{store.path}: {store.clear():,} results deleted")
            return 0
        count, size = store.summary()
        print(f"{store.path}: {count:,} results, {size / 1e6:,.1f} of {limit:,.0f} MB")
    return 0
