"""Where a command's results go: what its options ask for, and what that means where they ask for nothing."""

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
    from bevviz.recording.sinks import Sinks


class Outputs(NamedTuple):
    """What the options of ``add_output`` ask for; several at once."""

    save: Path | None = None
    serve: int | None = None  # port
    bind: str = "127.0.0.1"  # address that it is at
    connect: str | None = None  # URL
    viewer: bool = False
    blueprint: str | Blueprint = "debug"
    unseen: bool = False  # saved as nothing could be shown
    browser: bool = False  # where the page of ``serve`` is opened

    @staticmethod
    def of(options: argparse.Namespace) -> Outputs:
        blueprint = getattr(options, "blueprint", "debug")
        return Outputs(options.save, options.serve, options.bind, options.connect, options.viewer, blueprint)

    def __bool__(self) -> bool:
        """Whether anything is asked for."""
        return bool(
            self.save is not None or self.serve is not None or self.connect is not None or self.viewer
        )

    def or_viewer(self) -> Outputs:
        """Where nothing is asked for, the viewer on this machine, if it can be shown."""
        return self if self or not has_display() else self._replace(viewer=True)

    def or_file(self, default: Path) -> Outputs:
        """Where nothing is asked for and nothing can be shown, a file."""
        chosen = self.or_viewer()
        if chosen:
            return chosen
        if has_browser():
            from bevviz.recording.ports import free_port

            return chosen._replace(serve=free_port(9090), browser=True)
        say(f"no display: saving {default}")
        return chosen._replace(save=default, unseen=True)

    @contextmanager
    def opened(self, scene: Scene, config: Config) -> Iterator[Sinks]:
        """A recording that goes there; addresses are said."""
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

    def keep_serving(self, sinks: Sinks, what: str = "") -> None:
        """Until the user ends it, where a server was asked for."""
        if self.serve is not None:
            from bevviz.recording.saved_viewer import too_large_for_web

            if self.save is not None and sinks.file is not None and sinks.file.exists():
                warn(filter(None, [too_large_for_web(self.save, sinks.file.stat().st_size)]))
            say(f"{what}serving until Ctrl-C")
            sinks.check()
            wait_for_interrupt()


_quiet = False


def speak(*, quiet: bool) -> None:
    """Of a process that is a command: what is announced is said, unless it is to be ``quiet``."""
    global _quiet
    _quiet = quiet
    progress.to(None if quiet else say, bars=not quiet)


def say(line: str, *, always: bool = False) -> None:
    """On stderr; with ``--quiet`` only what is ``always`` said, as the address of a server."""
    if always or not _quiet:
        print(f"bevviz: {printable(line)}", file=sys.stderr)


def warn(warnings: Iterable[str]) -> None:
    for warning in warnings:
        print(f"bevviz: {style.warning('warning:')} {printable(warning)}", file=sys.stderr)


def hint(scene: Scene, config: Config) -> None:
    """Say what would give the user more."""
    from bevviz.support.kernel import CACHED

    if not CACHED:
        say(
            "no place to keep compiled stages in: every run compiles them anew, which takes some 15 seconds; "
            "set NUMBA_CACHE_DIR to a folder that can be written"
        )
    if scene.cameras and not config.detector.model:
        say("no detector: give --model FILE.onnx, or name it in bevviz.toml, to find objects in the images")


def tell_of_browser(address: str) -> None:
    """Where to look, also from elsewhere, while a server runs."""
    say(f"viewer at {address}", always=True)
    ports = [str(port) for port in re.findall(r":(\d+)", unquote(address))]
    over_ssh = " ".join(f"-L {port}:localhost:{port}" for port in ports)
    if os.environ.get("SSH_CONNECTION"):
        say(f"on your own machine first: ssh {over_ssh} {socket.gethostname()}")
    if has_browser():
        open_browser(address)
    say("serving until Ctrl-C; only this machine can reach it")


def program() -> str:
    """How this program was called, to be typed again."""
    called = Path(sys.argv[0])
    if called.name == "__main__.py":
        return f"{shlex.quote(sys.executable)} -m bevviz"
    found = shutil.which("bevviz")
    if found is not None and Path(found).resolve() == called.resolve():
        return "bevviz"
    return shlex.quote(str(called))


def has_browser() -> bool:
    """Whether one opens without a display: $BROWSER, as remote editors and WSL set it for their user."""
    return bool(os.environ.get("BROWSER")) and not has_display()


def open_browser(address: str) -> None:
    import webbrowser

    webbrowser.open(address)


def has_display() -> bool:
    return sys.platform != "linux" or bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
