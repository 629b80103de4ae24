"""Recordings in a Rerun catalog, for queries over all of them and for links into each."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

from bevviz.errors import UserError, first_line
from bevviz.extras.batch.summary import Link
from bevviz.extras.batch.table import RunInfo
from bevviz.recording import blueprints, entities, rerun_cli
from bevviz.recording.ports import LOOPBACK, allowed_origins, check_port, free_port, host_for, own_address

TIMEOUT = 600  # seconds


def register(url: str, name: str, results: Sequence[tuple[Path, RunInfo]], blueprint: str) -> Link:
    """Register the recordings in a dataset. Changed ones replace their old version; the others stay.

    Args:
        url: of the catalog server, rerun+http://host:51234. It must see the files under the same paths.
        name: of the dataset. It is made if it is missing.
        results: recording and description of each bag.
        blueprint: layout of the dataset, unless it has one already.

    Returns:
        A function that makes the address of a frame.

    Raises:
        UserError: the server or a package is missing, or the server cannot read a recording.
    """
    from rerun.catalog import CatalogClient, OnDuplicateSegmentLayer
    from rerun.error_utils import RerunMissingDependencyError

    try:
        dataset = CatalogClient(url).create_dataset(name, exist_ok=True)
        wanted = {info.recording_id: path for path, info in results}
        registered = set(dataset.segment_ids())
        stems = {path.stem for path in wanted.values()}
        if outdated := [s for s in registered - set(wanted) if s.rpartition("-")[0] in stems]:
            dataset.unregister(segments_to_drop=outdated, layers_to_drop=[]).wait()
        if wanted:
            uris = [path.resolve().as_uri() for path in wanted.values()]
            replace = OnDuplicateSegmentLayer.REPLACE
            for result in dataset.register(uris, on_duplicate=replace).iter_results(TIMEOUT):
                if result.error is not None:
                    raise UserError(f"--catalog {url}: {result.uri}: {first_line(result.error)}")
            if dataset.default_blueprint() is None:
                with TemporaryDirectory() as folder:
                    layout = Path(folder) / "layout.rbl"
                    scene = results[0][1].scene
                    application = blueprints.application_id(blueprint, scene)
                    blueprints.load(blueprint, scene).save(application, str(layout))
                    dataset.register_blueprint(layout.as_uri())
    except RerunMissingDependencyError:
        raise UserError("a catalog needs more packages: pip install 'bevviz[catalog]'") from None
    except (OSError, RuntimeError, ValueError, LookupError) as error:
        raise UserError(f"--catalog {url}: {first_line(error)}") from None

    def link(recording_id: str, frame: int) -> str:
        return f"{dataset.segment_url(recording_id)}#when={entities.FRAME}@{frame}"

    return link


@contextmanager
def serve_catalog(port: int, bind: str = LOOPBACK) -> Iterator[tuple[str, str]]:
    """Start a catalog server and a web viewer, and yield their addresses.

    Raises:
        UserError: a port is in use, or the address does not belong to this machine.
    """
    address = own_address(bind)
    check_port(port, "--serve-catalog")
    web_port, host = free_port(9090, but=port), host_for(address)
    url = f"rerun+http://{host}:{port}"
    arguments = ["server", "--host", address, "--port", str(port)]
    for origin in allowed_origins(address, web_port):
        arguments += ["--cors-allow-origin", origin]
    with ExitStack() as stack:
        stack.callback(rerun_cli.stop, rerun_cli.start(arguments, address, port))
        stack.callback(rerun_cli.stop, rerun_cli.start_web_viewer(address, web_port, url))
        yield url, f"http://{host}:{web_port}"
