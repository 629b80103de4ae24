"""Take a screenshot of a recording in the web viewer, with a headless Chromium driven over WebDriver.

python tools/screenshot.py demo.rrd docs/images/debug.png --size 1920x1200 --wait 30
"""

from __future__ import annotations

import argparse
import base64
import json
import socket
import subprocess
import sys
import tempfile
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any
from urllib.parse import quote

FLAGS = [
    "--headless=new",
    "--no-sandbox",
    "--use-angle=swiftshader",  # no GPU is needed
    "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist",
    "--no-first-run",
    "--disable-quic",
    "--disable-sync",
    "--disable-background-networking",
    "--disable-component-update",
    "--hide-scrollbars",
    "--force-dark-mode",
]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("source", help=".rrd file, or the URL of a web viewer")
    parser.add_argument("image", type=Path, help="PNG file")
    parser.add_argument("--size", default="1920x1200", help="of the window, pixels")
    parser.add_argument("--wait", type=float, default=30.0, help="seconds until everything is drawn")
    parser.add_argument("--browser", default="/usr/bin/chromium")
    parser.add_argument("--driver", default="/usr/bin/chromedriver")
    options = parser.parse_args()

    with ExitStack() as stack:
        url = options.source
        if not url.startswith("http"):
            url = stack.enter_context(served(Path(url)))
        profile = stack.enter_context(tempfile.TemporaryDirectory(ignore_cleanup_errors=True))
        driver = stack.enter_context(webdriver(options.driver))
        flags = [*FLAGS, f"--window-size={options.size.replace('x', ',')}", f"--user-data-dir={profile}"]
        chrome = {"binary": options.browser, "args": flags}
        session = call(
            driver, "POST", "/session", {"capabilities": {"alwaysMatch": {"goog:chromeOptions": chrome}}}
        )["sessionId"]
        try:
            call(driver, "POST", f"/session/{session}/timeouts", {"script": 600_000, "pageLoad": 600_000})
            call(driver, "POST", f"/session/{session}/url", {"url": url})
            time.sleep(options.wait)
            png = base64.b64decode(patiently(driver, "GET", f"/session/{session}/screenshot"))
        finally:
            call(driver, "DELETE", f"/session/{session}")
    options.image.parent.mkdir(parents=True, exist_ok=True)
    options.image.write_bytes(png)
    print(f"{options.image}: {len(png) // 1000} kB")
    return 0


@contextmanager
def served(recording: Path) -> Iterator[str]:
    """The web viewer with the recording open, as a URL."""
    web, data = free_port(), free_port()
    command = [sys.executable, "-m", "rerun", str(recording), "--serve-web"]
    command += ["--web-viewer-port", str(web), "--port", str(data)]
    with running(command, web):
        yield f"http://127.0.0.1:{web}/?url={quote(f'rerun+http://127.0.0.1:{data}/proxy', safe='')}"


@contextmanager
def webdriver(binary: str) -> Iterator[str]:
    port = free_port()
    with running([binary, f"--port={port}"], port):
        yield f"http://127.0.0.1:{port}"


@contextmanager
def running(command: list[str], port: int) -> Iterator[None]:
    """The command, from when it listens on the port until the block is left."""
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        deadline = time.monotonic() + 30
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
        process.terminate()
        process.wait(10)


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def patiently(driver: str, method: str, path: str) -> Any:
    """Drawing in software keeps the page busy for longer than the driver waits: ask again."""
    for _ in range(20):
        try:
            return call(driver, method, path)
        except RuntimeError as error:
            reason = error
            time.sleep(2)
    raise SystemExit(str(reason))


def call(driver: str, method: str, path: str, body: dict[str, Any] | None = None) -> Any:
    data = None if body is None else json.dumps(body).encode()
    request = urllib.request.Request(driver + path, data, {"Content-Type": "application/json"}, method=method)
    try:
        with urllib.request.urlopen(request, timeout=600) as response:
            return json.load(response)["value"]
    except urllib.error.HTTPError as error:
        raise RuntimeError(json.load(error)["value"]["message"]) from None


if __name__ == "__main__":
    sys.exit(main())
