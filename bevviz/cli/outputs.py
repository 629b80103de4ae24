"""Outputs of a command: recordings, viewers, JSON, lines on stderr, and the check of their paths."""

from __future__ import annotations

import argparse
import atexit
import html
import math
import os
import re
import shlex
import shutil
import socket
import sys
import tempfile
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from functools import partial
from getpass import getuser
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple
from urllib.parse import unquote

from bevviz.cli.interrupts import wait_for_interrupt
from bevviz.errors import UserError
from bevviz.support import progress
from bevviz.support.text import printable

if TYPE_CHECKING:
    from rerun.blueprint import Blueprint

    from bevviz.config import Config
    from bevviz.model.frame import Scene
    from bevviz.recording.sinks import OpenRecording

TOKEN = "token="  # in the address of a page that needs one
BROWSER_START = 60.0  # seconds until the file that leads a browser to such a page is deleted


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
            from bevviz.recording.rerun_cli import too_large_for_web

            if self.save is not None and sinks.file is not None and sinks.file.exists():
                warn(filter(None, [too_large_for_web(self.save, sinks.file.stat().st_size)]))
            say(f"{what}serving until Ctrl-C")
            sinks.check()
            wait_for_interrupt()


# --- lines on stderr ---------------------------------------------------------------------------

_quiet = False


def set_up_notes(*, quiet: bool) -> None:
    """Print notes and progress on stderr, unless ``quiet``. A process that is a command calls this."""
    global _quiet
    _quiet = quiet
    progress.set_receiver(None if quiet else say, bars=not quiet)


def say(line: str, *, always: bool = False) -> None:
    """Print a line on stderr. ``--quiet`` suppresses it unless ``always`` is set."""
    if always or not _quiet:
        with progress.cleared():
            print(f"bevviz: {printable(line)}", file=sys.stderr)


def warn(warnings: Iterable[str]) -> None:
    """Print warnings on stderr."""
    for warning in warnings:
        with progress.cleared():
            print(f"bevviz: {_colored('warning:', '33')} {printable(warning)}", file=sys.stderr)


def print_error(message: object, kind: str = "error") -> None:
    """Print an error on stderr."""
    print(f"{_colored(f'bevviz: {kind}:', '1;31')} {message}", file=sys.stderr)


def _colored(text: str, code: str) -> str:
    """Colour a text on stderr. NO_COLOR (no-color.org) disables colours, FORCE_COLOR forces them."""
    is_terminal = os.environ.get("TERM") != "dumb" and sys.stderr.isatty()
    if os.environ.get("NO_COLOR") or not (os.environ.get("FORCE_COLOR") or is_terminal):
        return text
    return f"\x1b[{code}m{text}\x1b[0m"


def print_hints(scene: Scene, config: Config) -> None:
    """Tell the user which missing input or setting would give more."""
    from bevviz.support.numba_kernel import CACHED

    if not CACHED:
        say(
            "no place to keep compiled stages in: every run compiles them anew, which takes some 15 seconds; "
            "set NUMBA_CACHE_DIR to a folder that can be written"
        )
    if scene.cameras and not config.detector.model:
        say("no detector: give --model FILE.onnx, or name it in bevviz.toml, to find objects in the images")


def announce(what: str, address: str, browser: bool = True) -> None:
    """Print an address and how to reach it from elsewhere. With ``browser``, open it if there is one.

    Args:
        what: what is at the address.
        address: address of a page of this machine.
        browser: whether to open it.
    """
    say(f"{what} at {address}", always=True)
    ports = [str(port) for port in re.findall(r":(\d+)", unquote(address))]
    over_ssh = " ".join(f"-L {port}:localhost:{port}" for port in ports)
    # The browser of a remote editor reads no file of this machine, see ``open_browser``.
    opens = browser and (has_display() or (has_browser() and TOKEN not in address))
    if os.environ.get("SSH_CONNECTION") or not opens:
        say(f"from another machine, there first: ssh -N {over_ssh} {getuser()}@{socket.gethostname()}")
    if opens:
        open_browser(address)
    say("open until Ctrl-C; only this machine can reach it")


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
    """Open a page in the browser.

    Other users can read the arguments of a process. So the browser gets the name of a private file that leads
    to the page, and not the token in its address. The file lies in the home folder, under a name without a
    dot: browsers in a sandbox (Snap) read neither hidden nor temporary folders.
    """
    import webbrowser

    from bevviz.support import cleanup

    if TOKEN not in address:
        webbrowser.open(address)
        return
    try:
        folder = Path(tempfile.mkdtemp(prefix="bevviz-page-", dir=Path.home()))  # only this user may enter it
    except (OSError, RuntimeError):  # RuntimeError: there is no home folder.
        folder = Path(tempfile.mkdtemp(prefix="bevviz-page-"))
    delete = partial(shutil.rmtree, folder, ignore_errors=True)
    cleanup.register(folder, delete)
    atexit.register(delete)
    file = folder / "open.html"
    file.touch(mode=0o600)
    refresh = html.escape(f"0; url={address}")
    file.write_text(
        '<!doctype html><meta name="referrer" content="no-referrer">'
        f'<meta http-equiv="refresh" content="{refresh}"><title>bevviz</title>\n'
    )
    webbrowser.open(file.as_uri())
    timer = threading.Timer(BROWSER_START, delete)
    timer.daemon = True
    timer.start()


def has_display() -> bool:
    """Return whether windows can be shown."""
    return sys.platform != "linux" or bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


# --- --json: the result for other programs, in one format for each command (docs/api.md) -------

OPTION = "--json"
STDOUT = "-"


def add_json(group: argparse._ArgumentGroup | argparse.ArgumentParser) -> None:
    """Add the option ``--json``."""
    group.add_argument(
        OPTION,
        nargs="?",
        const=STDOUT,
        type=Path,
        metavar="FILE.json",
        help="the result for programs, instead of the text; into a file: beside it",
    )


def join_json_option(arguments: Iterable[str]) -> list[str]:
    """Replace ``--json PATH`` by ``--json=- PATH``, unless PATH is a .json file."""
    joined: list[str] = []
    for argument in arguments:
        if joined and joined[-1] == OPTION and not argument.endswith(".json"):
            joined[-1] = f"{OPTION}={STDOUT}"
        joined.append(argument)
    return joined


def json_on_stdout(options: argparse.Namespace) -> bool:
    """Return whether JSON replaces the text on standard output."""
    return str(options.json) == STDOUT


def write_json(options: argparse.Namespace, form: str, tree: Mapping[str, Any]) -> None:
    """Print or write the result if ``--json`` is given.

    Args:
        options: of the command.
        form: name of the format, see ``bevviz.model.json_forms``.
        tree: the result: values that JSON can represent, NaN, and tuples.

    Raises:
        UserError: the file cannot be written.
    """
    if options.json is None:
        return
    import json

    from bevviz.model.json_forms import form_name
    from bevviz.support.files import save_text

    text = json.dumps({"form": form_name(form), **_plain(tree)}, indent=1, allow_nan=False)
    if json_on_stdout(options):
        print(text, flush=True)
    else:
        save_text(options.json, f"{text}\n", OPTION)


def print_result(
    options: argparse.Namespace, form: str, tree: Mapping[str, Any], text: Callable[[], str]
) -> None:
    """Print the result as text or as JSON, and write it as ``--json FILE`` says; see ``write_json``."""
    if not json_on_stdout(options):
        print(text(), flush=True)
    write_json(options, form, tree)


def _plain(value: Any) -> Any:
    """Replace NaN and infinity by None, and tuples by lists."""
    if isinstance(value, Mapping):
        return {str(key): _plain(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(inner) for inner in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


# --- the check that no output overwrites an input or another output ----------------------------

READ = ("paths", "recording", "config", "model", "a", "b", "kitti_labels", "note_file", "blueprint")
WRITTEN = {
    "save": "--save",
    "output": "-o",
    "csv": "--csv",
    "json": "--json",
    "junit": "--junit",
    "write": "--write",
}
# Files written at the end of the run. Only ``check_outputs`` checks their folder before.
TEXTS = ("csv", "json", "write")


def check_outputs(options: argparse.Namespace) -> None:
    """Check the output paths before the run starts.

    Raises:
        UserError: an output is one of the inputs, also by another name or link. Or two outputs are the same
            file. Or the folder of an output does not exist.
    """
    if getattr(options, "check", False):  # It writes nothing.
        return
    inputs = {identity: path for path in _inputs(options) for identity in _identities(path)}
    outputs: dict[Path, str] = {}
    for name, option in WRITTEN.items():
        target = getattr(options, name, None)
        if not isinstance(target, Path) or target.is_dir() or target == Path(STDOUT):
            continue
        other = outputs.setdefault(target.resolve(), option)
        if other != option and (target.is_file() or not target.exists()):
            raise UserError(f"{option} {target}: {other} writes that file; give another name")
        if name in TEXTS and not target.parent.is_dir():
            raise UserError(f"{option} {target}: there is no folder {target.parent}")
        for identity in _identities(target):
            if identity in inputs:
                other_name = "" if inputs[identity] == target else f" ({inputs[identity]})"
                raise UserError(f"{option} {target}: is what is read{other_name}; give another name")


def _inputs(options: argparse.Namespace) -> Iterator[Path]:
    for name in READ:
        values = getattr(options, name, None)
        for value in values if isinstance(values, list) else [values]:
            if isinstance(value, str | Path) and str(value):
                yield Path(value)


def _identities(path: Path) -> Iterator[tuple[int, int]]:
    """Yield device and inode of a file, or of each file in a folder."""
    with suppress(OSError, ValueError):
        for file in path.iterdir() if path.is_dir() else [path]:
            with suppress(OSError):
                status = file.stat()
                yield status.st_dev, status.st_ino
