"""Outputs of a command: recordings, viewers, servers, and lines on stderr."""

from __future__ import annotations

import argparse
import os
import re
import shlex
import shutil
import socket
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple
from urllib.parse import unquote

from bevviz.cli import style
from bevviz.cli.interrupts import wait_for_interrupt
from bevviz.support import progress
from bevviz.support.text import printable

if TYPE_CHECKING:
    from rerun.blueprint import Blueprint

    from bevviz.config import Config
    from bevviz.model.frame import Scene
    from bevviz.recording.sinks import OpenRecording


class Outputs(NamedTuple):
    """Outputs that the options of ``add_output`` request."""

    save: Path | None = None
    serve: int | None = None  # Port of the web viewer.
    bind: str = "127.0.0.1"  # Address at which it listens.
    connect: str | None = None  # URL of a running viewer.
    viewer: bool = False
    blueprint: str | Blueprint = "debug"
    unseen: bool = False  # Saved because nothing could be shown.
    browser: bool = False  # Whether to open the page of ``serve``.

    @staticmethod
    def of(options: argparse.Namespace) -> Outputs:
        """Return the outputs that the options request."""
        blueprint = getattr(options, "blueprint", "debug")
        return Outputs(options.save, options.serve, options.bind, options.connect, options.viewer, blueprint)

    def __bool__(self) -> bool:
        """Return whether any output is requested."""
        return bool(
            self.save is not None or self.serve is not None or self.connect is not None or self.viewer
        )

    def or_viewer(self) -> Outputs:
        """Return the requested outputs. If there are none and there is a display, return the viewer."""
        return self if self or not has_display() else self._replace(viewer=True)

    def or_file(self, default: Path) -> Outputs:
        """Return the requested outputs. If there are none, return the viewer, the browser or a file."""
        chosen = self.or_viewer()
        if chosen:
            return chosen
        if has_browser():
            from bevviz.recording.ports import free_port

            return chosen._replace(serve=free_port(9090), browser=True)
        say(f"no display: saving {default}")
        return chosen._replace(save=default, unseen=True)

    @contextmanager
    def opened(self, scene: Scene, config: Config) -> Iterator[OpenRecording]:
        """Open a recording with these outputs and print their addresses."""
        from bevviz.recording.sinks import open_recording

        with open_recording(
            scene,
            config,
            save=self.save,
            serve=self.serve,
            bind=self.bind,
            connect=self.connect,
            spawn=self.viewer,
            blueprint=self.blueprint,
        ) as sinks:
            for url in sinks.urls:
                say(f"viewer at {url}", always=True)
                if self.browser:
                    open_browser(url)
            warn(sinks.warnings)
            yield sinks

    def keep_serving(self, sinks: OpenRecording, what: str = "") -> None:
        """Serve until the user ends it, if a server is requested."""
        if self.serve is not None:
            from bevviz.recording.saved_viewer import too_large_for_web

            if self.save is not None and sinks.file is not None and sinks.file.exists():
                warn(filter(None, [too_large_for_web(self.save, sinks.file.stat().st_size)]))
            say(f"{what}serving until Ctrl-C")
            sinks.check()
            wait_for_interrupt()


_quiet = False


def set_up_notes(*, quiet: bool) -> None:
    """Print notes and progress on stderr, unless ``quiet``. A process that is a command calls this."""
    global _quiet
    _quiet = quiet
    progress.set_receiver(None if quiet else say, bars=not quiet)


def say(line: str, *, always: bool = False) -> None:
    """Print a line on stderr. ``--quiet`` suppresses it unless ``always`` is set."""
    if always or not _quiet:
        print(f"bevviz: {printable(line)}", file=sys.stderr)


def warn(warnings: Iterable[str]) -> None:
    """Print warnings on stderr."""
    for warning in warnings:
        print(f"bevviz: {style.warning('warning:')} {printable(warning)}", file=sys.stderr)


def print_hints(scene: Scene, config: Config) -> None:
    """Tell the user which missing input or setting would give more."""
    from bevviz.support.kernel import CACHED

    if not CACHED:
        say(
            "no place to keep compiled stages in: every run compiles them anew, which takes some 15 seconds; "
            "set NUMBA_CACHE_DIR to a folder that can be written"
        )
    if scene.cameras and not config.detector.model:
        say("no detector: give --model FILE.onnx, or name it in bevviz.toml, to find objects in the images")


def announce_viewer(address: str) -> None:
    """Print the address of a viewer and how to reach it from elsewhere. Open the browser if there is one."""
    say(f"viewer at {address}", always=True)
    ports = [str(port) for port in re.findall(r":(\d+)", unquote(address))]
    over_ssh = " ".join(f"-L {port}:localhost:{port}" for port in ports)
    if os.environ.get("SSH_CONNECTION"):
        say(f"on your own machine first: ssh {over_ssh} {socket.gethostname()}")
    if has_browser():
        open_browser(address)
    say("serving until Ctrl-C; only this machine can reach it")


def program() -> str:
    """Return the command that runs this program, to be typed again."""
    script = Path(sys.argv[0])
    if script.name == "__main__.py":
        return f"{shlex.quote(sys.executable)} -m bevviz"
    installed = shutil.which("bevviz")
    if installed is not None and Path(installed).resolve() == script.resolve():
        return "bevviz"
    return shlex.quote(str(script))


def has_browser() -> bool:
    """Return whether a browser opens without a display. Remote editors and WSL set $BROWSER for that."""
    return bool(os.environ.get("BROWSER")) and not has_display()


def open_browser(address: str) -> None:
    """Open a page in the browser."""
    import webbrowser

    webbrowser.open(address)


def has_display() -> bool:
    """Return whether windows can be shown."""
    return sys.platform != "linux" or bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
