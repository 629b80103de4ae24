"""Bags at an address: what is read of them, by which requests, and what is said when that fails."""

from __future__ import annotations

import gzip
import re
import threading
import tracemalloc
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import fsspec
import pytest
from fsspec.implementations.memory import MemoryFileSystem

from bevviz.bags import remote
from bevviz.bags.bag import Recording
from bevviz.bags.source import BagSource
from bevviz.cli import main
from bevviz.config import load
from bevviz.errors import UserError
from bevviz.extras.demo.bag import write_bag
from bevviz.extras.demo.drive import SyntheticSource

pytest.importorskip("aiohttp", reason="needs fsspec's HTTP: pip install 'bevviz[remote]'")


@dataclass
class WebServer:
    """Files of a folder, by ranges unless told otherwise."""

    address: str
    loaded: list[int] = field(default_factory=list)  # bytes of each answer
    ranges: bool = True
    failures: int = 0  # answers that fail from now on


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("web")
    source = SyntheticSource(frames=6)
    write_bag(source, folder / "drive.mcap", source)
    whole = (folder / "drive.mcap").read_bytes()
    (folder / "cut.mcap").write_bytes(whole[: len(whole) // 2])
    (folder / "page.html").write_text("<!doctype html>" * 9)
    return folder


@pytest.fixture
def web(folder: Path) -> Iterator[WebServer]:
    class Handler(BaseHTTPRequestHandler):
        def do_HEAD(self) -> None:
            self.answer(body=False)

        def do_GET(self) -> None:
            self.answer(body=True)

        def answer(self, *, body: bool) -> None:
            path = folder / self.path.lstrip("/").partition("?")[0]
            if site.failures and body:
                site.failures -= 1
                self.send_error(503)
                return
            if not path.is_file():
                self.send_error(404)
                return
            data = path.read_bytes()
            asked = re.fullmatch(r"bytes=(\d+)-(\d+)", self.headers.get("Range", ""))
            if asked and site.ranges:
                first, last = int(asked[1]), min(int(asked[2]), len(data) - 1)
                self.send_response(206)
                self.send_header("Content-Range", f"bytes {first}-{last}/{len(data)}")
                data = data[first : last + 1]
            else:
                self.send_response(200)
            self.send_header("Accept-Ranges", "bytes" if site.ranges else "none")
            self.send_header("Content-Length", str(len(data)))
            self.end_headers()
            if body:
                site.loaded.append(len(data))
                self.wfile.write(data)

        def log_message(self, *arguments: Any) -> None:
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    site = WebServer(f"http://127.0.0.1:{server.server_port}")
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    yield site
    server.shutdown()
    thread.join()
    server.server_close()


def messages(path: str | Path) -> list[tuple[str, int, bytes]]:
    with Recording([Path(path)]) as recording:
        topics = [topic.name for topic in recording.topics]
        return [(m.topic, m.received, bytes(m.data)) for m in recording.messages(topics)]


def test_a_bag_at_an_address_gives_the_same_messages(web: WebServer, folder: Path) -> None:
    assert messages(f"{web.address}/drive.mcap") == messages(folder / "drive.mcap")


def test_only_the_needed_parts_are_loaded(web: WebServer, folder: Path) -> None:
    with BagSource([Path(f"{web.address}/drive.mcap")], load()) as source:
        opened = sum(web.loaded)
        assert source.frame(5) is not None and sum(web.loaded) > opened
        assert source.recording.size == (folder / "drive.mcap").stat().st_size
    assert opened < source.recording.size


def test_names_and_recordings_hold_no_signature(
    web: WebServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    address = f"{web.address}/drive.mcap?X-Amz-Signature=c0ffee"
    assert main(["bag", address, "--frames", ":2", "--save", "out.rrd"]) == 0
    assert b"c0ffee" not in Path("out.rrd").read_bytes() and "c0ffee" not in capsys.readouterr().err
    assert remote.name_of(Path(address)) == "drive.mcap"
    assert remote.beside(Path(address)) == tmp_path / "drive.mcap"


def test_a_failure_of_the_network_is_tried_again(web: WebServer, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(remote, "PAUSE", 0.01)
    with Recording([Path(f"{web.address}/drive.mcap")]) as recording:
        web.failures = remote.TRIES - 1
        assert recording.first(recording.topics[0].name) is not None and not web.failures
        web.failures = 99
        with pytest.raises(UserError, match=r"^drive\.mcap: cannot be read over the network"):
            list(recording.messages([topic.name for topic in recording.topics]))


@pytest.mark.parametrize(
    ("file", "text"),
    [
        ("absent.mcap", "absent.mcap: there is no such file at this address"),
        ("cut.mcap", "cut.mcap: the file ends early (no footer): download it"),
        ("page.html", "page.html: only MCAP and ROS 1 bag are read from an address: download it"),
    ],
)
def test_a_file_that_cannot_be_read_by_parts_is_one_line(
    web: WebServer, file: str, text: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["info", f"{web.address}/{file}"]) != 0
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"bevviz: error: {text}")


def test_a_server_without_ranges_is_told(web: WebServer) -> None:
    web.ranges = False
    with pytest.raises(UserError, match="download it"):
        Recording([Path(f"{web.address}/drive.mcap")])


class Storage(MemoryFileSystem):  # type: ignore[misc]
    """Object storage that refuses to answer without credentials."""

    protocol = "s3"
    credentials = True

    @classmethod
    def _strip_protocol(cls, path: str) -> str:
        return "/" + path.removeprefix("s3://").lstrip("/")

    def info(self, path: str, **options: object) -> dict[str, object]:
        if not self.credentials:
            raise type("NoCredentialsError", (Exception,), {})
        return dict(super().info(path, **options))


def test_a_bag_in_object_storage_is_read_as_a_file(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    fsspec.register_implementation("s3", Storage, clobber=True)
    address = "s3://drives/drive.mcap"
    Storage().pipe_file(address, (folder / "drive.mcap").read_bytes())
    assert messages(address) == messages(folder / "drive.mcap")
    assert main(["info", address]) == 0 and address in capsys.readouterr().out
    monkeypatch.setattr(Storage, "credentials", False)
    assert main(["info", address]) != 0
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("bevviz: error: drive.mcap: no credentials for s3://: set AWS_PROFILE")


def test_a_batch_refuses_an_address(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["batch", "s3://drives/drive.mcap", "-o", str(tmp_path / "runs")]) != 0
    assert "drive.mcap: a batch reads no bags at addresses: download it" in capsys.readouterr().err


def test_a_missing_package_for_object_storage_is_named() -> None:
    fsspec.register_implementation("gs", "no_such_package.System", clobber=True)
    with pytest.raises(UserError, match=r"^drive\.mcap: reading gs:// needs more packages: .* gcsfs$"):
        Recording([Path("gs://drives/drive.mcap")])


class LyingHandler(BaseHTTPRequestHandler):
    """Answers other than those that were asked for. The path names the kind."""

    protocol_version = "HTTP/1.1"
    sent = 0  # bytes of bodies

    def do_GET(self) -> None:
        first, last = map(int, re.findall(r"\d+", self.headers["Range"]))
        kind, size = self.path.strip("/").partition(".")[0], last - first + 1
        headers = {"Content-Range": f"bytes {first}-{last}/99999999", "Content-Length": f"{size}"}
        body: Iterator[bytes] = iter([bytes(size)])
        status = 206
        if kind in ("endless", "whole"):
            status = 206 if kind == "endless" else 200
            headers["Content-Length"] = f"{1 << 40}"
            body = (bytes(1 << 16) for _ in range(1 << 14))
        elif kind == "packed":
            body = iter([packed := gzip.compress(bytes(1 << 24))])
            headers |= {"Content-Encoding": "gzip", "Content-Length": f"{len(packed)}"}
        elif kind == "moved":
            status, body = 302, iter(())
            headers = {"Location": f"http://localhost:{self.server.server_port}/x", "Content-Length": "0"}  # type: ignore[attr-defined]
        elif kind == "file":
            status, body = 302, iter(())
            headers = {"Location": "file:///etc/passwd", "Content-Length": "0"}
        elif kind == "other":
            headers["Content-Range"] = f"bytes {first + 1}-{last + 1}/99999999"
        elif kind == "unsized":
            headers["Content-Range"] = f"bytes {first}-{last}/{10**30}"
        elif kind in ("silent", "trickle") and size > 1:
            body = self.pieces(0.02 if kind == "trickle" else 5)
        self.send_response(status)
        for name, value in headers.items():
            self.send_header(name, value)
        self.end_headers()
        with suppress(OSError):
            for piece in body:
                self.wfile.write(piece)
                type(self).sent += len(piece)
        self.close_connection = True

    def pieces(self, pause: float) -> Iterator[bytes]:
        """Yield a byte at a time until the client or the test ends."""
        while not self.server.ended.wait(pause):  # type: ignore[attr-defined]
            yield b"\0"

    def log_message(self, *arguments: Any) -> None:
        pass


@pytest.fixture
def liar() -> Iterator[str]:
    server = ThreadingHTTPServer(("127.0.0.1", 0), LyingHandler)
    server.ended = threading.Event()  # type: ignore[attr-defined]
    LyingHandler.sent = 0
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
    thread.start()
    yield f"http://127.0.0.1:{server.server_port}"
    server.ended.set()  # type: ignore[attr-defined]
    server.shutdown()
    thread.join()
    server.server_close()


@pytest.mark.parametrize(
    ("kind", "text"),
    [
        ("endless", "gives more bytes than were asked for"),
        ("whole", "does not serve parts of files"),
        ("packed", "sends compressed bytes"),
        ("moved", "redirects to an address that is neither https:// nor its own"),
        ("file", "redirects to an address that is neither https:// nor its own"),
        ("other", "gives another part of the file"),
        ("unsized", "does not state the size"),
        ("silent", "is too slow"),
        ("trickle", "is too slow"),
    ],
)
def test_a_server_that_lies_costs_neither_time_nor_memory(
    liar: str, kind: str, text: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    if text == "is too slow":
        monkeypatch.setattr(remote, "TIMEOUT", 0.2)
        monkeypatch.setattr(remote, "LEAST_RATE", 1 << 20)
    tracemalloc.start()
    try:
        assert main(["info", f"{liar}/{kind}.mcap"]) == 2
        assert tracemalloc.get_traced_memory()[1] < 1 << 26
    finally:
        tracemalloc.stop()
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"bevviz: error: {kind}.mcap: the server {text}")
    assert LyingHandler.sent < 1 << 26  # the buffers of the sockets hold some megabytes


def test_no_more_is_asked_for_at_once_than_the_stated_limit(
    liar: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = remote.open_bytes(Path(f"{liar}/drive.mcap"))
    monkeypatch.setattr(remote, "MAX_REQUEST", 1 << 20)
    with pytest.raises(UserError, match=r"^drive\.mcap: it asks for 99,000,000 bytes at once"):
        file.read(0, 99_000_000)
    assert LyingHandler.sent <= 1  # the byte with which the size comes
