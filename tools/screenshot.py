"""Take a screenshot of a recording in the web viewer, with a headless Chromium.

    python tools/screenshot.py demo.rrd docs/images/debug.png --size 1920x1200 --wait 30

Drawn in software, on a busy machine, a frame takes many seconds: hence the DevTools protocol itself, as
WebDriver gives up on a screenshot after ten.
"""

from __future__ import annotations

import argparse
import base64
import json
import os
import signal
import socket
import struct
import subprocess
import sys
import tempfile
import time
import urllib.request
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any
from urllib.parse import quote, urlsplit

FLAGS = [
    "--headless=new",
    "--no-sandbox",
    "--use-angle=swiftshader",  # no GPU is needed
    "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist",
    "--force-dark-mode",
    "--hide-scrollbars",
    "--no-first-run",
    "--disable-quic",
    "--disable-sync",
    "--disable-background-networking",
    "--disable-component-update",
]


def main() -> int:
    parser = argparse.ArgumentParser(description="Take a screenshot of a recording in the web viewer.")
    parser.add_argument("source", help=".rrd file, or the URL of a web viewer")
    parser.add_argument("image", type=Path, help="PNG file")
    parser.add_argument("--size", default="1920x1200", help="of the window, pixels")
    parser.add_argument("--wait", type=float, default=30.0, help="seconds until everything is drawn")
    parser.add_argument("--browser", default="chromium", help="Chromium or Chrome")
    options = parser.parse_args()

    with ExitStack() as stack:
        url = options.source
        if not url.startswith("http"):
            url = stack.enter_context(served(Path(url)))
        page = stack.enter_context(browser(options.browser, url, options.size))
        time.sleep(options.wait)
        png = base64.b64decode(page.call("Page.captureScreenshot")["data"])
    options.image.parent.mkdir(parents=True, exist_ok=True)
    options.image.write_bytes(png)
    print(f"{options.image}: {len(png) // 1000} kB")
    return 0


@contextmanager
def served(recording: Path) -> Iterator[str]:
    """Serve the recording in the web viewer and yield the URL."""
    web, data = free_port(), free_port()
    command = [sys.executable, "-m", "rerun", str(recording), "--serve-web"]
    command += ["--web-viewer-port", str(web), "--port", str(data)]
    with running(command, web):
        yield f"http://127.0.0.1:{web}/?url={quote(f'rerun+http://127.0.0.1:{data}/proxy', safe='')}"


@contextmanager
def browser(binary: str, url: str, size: str) -> Iterator[DevTools]:
    """Open the page in a browser window of that size."""
    port = free_port()
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        command = [binary, *FLAGS, f"--window-size={size.replace('x', ',')}", f"--user-data-dir={profile}"]
        with running([*command, f"--remote-debugging-port={port}", url], port):
            with urllib.request.urlopen(f"http://127.0.0.1:{port}/json", timeout=60) as response:
                pages = [target for target in json.load(response) if target["type"] == "page"]
            yield DevTools(pages[0]["webSocketDebuggerUrl"])


@contextmanager
def running(command: list[str], port: int) -> Iterator[None]:
    """Run a command until the block is left. The block starts when the command listens on the port."""
    quiet = subprocess.DEVNULL
    process = subprocess.Popen(command, stdout=quiet, stderr=quiet, start_new_session=True)
    try:
        deadline = time.monotonic() + 60
        while True:
            try:
                socket.create_connection(("127.0.0.1", port), 1).close()
                break
            except OSError:
                if process.poll() is not None or time.monotonic() > deadline:
                    raise SystemExit(f"{command[0]}: does not listen on port {port}") from None
                time.sleep(0.2)
        yield
    finally:
        os.killpg(process.pid, signal.SIGTERM)  # with what it started itself
        process.wait(30)


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


class DevTools:
    """A page's DevTools over a WebSocket (RFC 6455): as much of it as one call at a time needs."""

    def __init__(self, url: str) -> None:
        parts = urlsplit(url)
        self._socket = socket.create_connection((parts.hostname, parts.port), 600)
        self._stream = self._socket.makefile("rb")
        key = base64.b64encode(os.urandom(16)).decode()
        self._socket.sendall(
            f"GET {parts.path} HTTP/1.1\r\nHost: {parts.netloc}\r\nUpgrade: websocket\r\n"
            f"Connection: Upgrade\r\nSec-WebSocket-Key: {key}\r\nSec-WebSocket-Version: 13\r\n\r\n".encode()
        )
        while self._stream.readline().strip():
            pass  # the answer's header ends with an empty line

    def call(self, method: str, **parameters: Any) -> Any:
        self._send(json.dumps({"id": 1, "method": method, "params": parameters}).encode())
        while True:
            message = json.loads(self._receive())
            if message.get("id") == 1:
                if "error" in message:
                    raise SystemExit(f"{method}: {message['error']['message']}")
                return message["result"]

    def _send(self, payload: bytes) -> None:
        mask = os.urandom(4)
        masked = bytes(byte ^ mask[i % 4] for i, byte in enumerate(payload))
        self._socket.sendall(struct.pack("!BBH", 0x81, 0x80 | 126, len(payload)) + mask + masked)

    def _receive(self) -> bytes:
        """One text message, of however many frames."""
        message = b""
        while True:
            first, length = self._stream.read(2)
            if length == 126:
                (length,) = struct.unpack("!H", self._stream.read(2))
            elif length == 127:
                (length,) = struct.unpack("!Q", self._stream.read(8))
            message += self._stream.read(length)
            if first & 0x80:
                return message


if __name__ == "__main__":
    sys.exit(main())
