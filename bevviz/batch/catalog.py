"""The recordings in a Rerun catalog, for queries across all of them and for links into each."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

import rerun as rr

from bevviz.batch.summary import Link
from bevviz.batch.table import RunInfo
from bevviz.errors import UserError, first_line
from bevviz.logging import blueprints, entities
from bevviz.logging.sinks import APPLICATION, check_port, free_port

TIMEOUT = 600  # seconds


def register(url: str, name: str, results: Sequence[tuple[Path, RunInfo]], blueprint: str) -> Link:
    """Make the dataset hold these recordings; what it holds already stays, what has changed is replaced.

    Args:
        url: of the catalog server, rerun+http://host:51234; it must see the files under the same paths.
        name: of the dataset; made where it is missing.
        results: recording and its description for each bag.
        blueprint: layout for all of them, where the dataset has none yet.

    Returns:
        What makes the address of a frame.

    Raises:
        UserError: the server or what it needs is missing, or it cannot read a recording.
    """
    from rerun.catalog import CatalogClient, OnDuplicateSegmentLayer
    from rerun.error_utils import RerunMissingDependencyError

    try:
        dataset = CatalogClient(url).create_dataset(name, exist_ok=True)
        wanted = {info.recording_id: path for path, info in results}
        there = set(dataset.segment_ids())
        stems = {path.stem for path in wanted.values()}
        if old := [s for s in there - set(wanted) if s.rpartition("-")[0] in stems]:
            dataset.unregister(segments_to_drop=old, layers_to_drop=[]).wait()
        if wanted:
            uris = [path.resolve().as_uri() for path in wanted.values()]
            replace = OnDuplicateSegmentLayer.REPLACE
            for result in dataset.register(uris, on_duplicate=replace).iter_results(TIMEOUT):
                if result.error is not None:
                    raise UserError(f"--catalog {url}: {result.uri}: {first_line(result.error)}")
            if dataset.default_blueprint() is None:
                with TemporaryDirectory() as folder:
                    layout = Path(folder) / "layout.rbl"
                    blueprints.load(blueprint, results[0][1].scene).save(APPLICATION, str(layout))
                    dataset.register_blueprint(layout.as_uri())
    except RerunMissingDependencyError:
        raise UserError("a catalog needs more packages: pip install 'bevviz[catalog]'") from None
    except (OSError, RuntimeError, ValueError, LookupError) as error:
        raise UserError(f"--catalog {url}: {first_line(error)}") from None

    def link(recording_id: str, frame: int) -> str:
        return f"{dataset.segment_url(recording_id)}#when={entities.FRAME}@{frame}"

    return link


@contextmanager
def served(port: int) -> Iterator[tuple[str, str]]:
    """A catalog server on this machine, and a web viewer: their addresses.

    Raises:
        UserError: a port is in use.
    """
    check_port(port, "--serve-catalog")
    web_port = free_port(9090, but=port)
    try:
        server = rr.server.Server(host="127.0.0.1", port=port)
        rr.serve_web_viewer(web_port=web_port, open_browser=False)
    except (RuntimeError, ValueError, OSError) as error:
        raise UserError(f"--serve-catalog {port}: {first_line(error)}") from None
    with server:
        yield f"rerun+http://127.0.0.1:{port}", f"http://localhost:{web_port}"
