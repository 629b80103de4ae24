"""Outputs of a command: recordings, viewers, JSON, lines on stderr, and the check of their paths."""

from __future__ import annotations

import atexit
import html
import os
import re
import shlex
import shutil
import socket
import sys
import tempfile
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from functools import partial
from getpass import getuser
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar
from urllib.parse import unquote

from bevviz.cli.command import Group, flag, option, option_values
from bevviz.cli.interrupts import wait_for_interrupt
from bevviz.cli.values import port
from bevviz.errors import UserError, printable
from bevviz.support import progress

if TYPE_CHECKING:
    from rerun.blueprint import Blueprint

    from bevviz.config import Config
    from bevviz.model.frame import Scene
    from bevviz.recording.sinks import OpenRecording

TOKEN = "token="  # in the address of a page that needs one
BROWSER_START = 60.0  # seconds until the file that leads a browser to such a page is deleted


def layout_option(default: str) -> Any:
    """Return the option for the layout of the viewer."""
    text = "debug, live, explain, bug_report, compare, a .py or a .rbl (default: %(default)s)"
    return option("NAME|FILE", text, default=default, file="read")


def bind_option(server: str) -> Any:
    """Return the option for the address at which a server listens."""
    text = "at this address (default: 127.0.0.1, for this machine alone; 0.0.0.0: for everybody)"
    return option("ADDRESS", f"{server} {text}", default="127.0.0.1")


@dataclass(frozen=True, kw_only=True)
class ViewerOptions:
    """Options for viewers. A subclass states what is saved, and the layout."""

    group: ClassVar = Group("output", "The viewer, where there is a display. Several can be given at once.")

    save: Path | tuple[Path, ...] | None = None
    serve: int | None = option("PORT", "web viewer on this machine (default: 9090)", parse=port, const=9090)
    bind: str = bind_option("--serve")
    connect: str | None = option("URL", "a viewer elsewhere, e.g. rerun+http://laptop:9876/proxy")
    viewer: bool = flag("open the viewer, beside the other outputs")
    blueprint: str = "debug"


@dataclass(frozen=True, kw_only=True)
class Outputs(ViewerOptions):
    """Outputs of a command."""

    save: Path | None = option("FILE.rrd", "save the recording, blueprint included", file="written")
    unseen: bool = False  # Saved because nothing could be shown.
    browser: bool = False  # Whether to open the page of ``serve``.

    def __bool__(self) -> bool:
        """Return whether any output is requested."""
        return bool(
            self.save is not None or self.serve is not None or self.connect is not None or self.viewer
        )

    def or_viewer(self) -> Outputs:
        """Return the requested outputs. If there are none and there is a display, return the viewer."""
        return self if self or not has_display() else replace(self, viewer=True)

    def or_file(self, default: Path) -> Outputs:
        """Return the requested outputs. If there are none, return the viewer, the browser or a file."""
        chosen = self.or_viewer()
        if chosen:
            return chosen
        if has_browser():
            from bevviz.recording.ports import free_port

            return replace(chosen, serve=free_port(9090), browser=True)
        say(f"no display: saving {default}")
        return replace(chosen, save=default, unseen=True)

    @contextmanager
    def opened(
        self, scene: Scene, config: Config, layout: Blueprint | None = None
    ) -> Iterator[OpenRecording]:
        """Open a recording with these outputs, and print their addresses.

        Args:
            scene: names of the sensors.
            config: configuration of the run.
            layout: layout of the viewer; None: that of ``--blueprint``.
        """
        from bevviz.recording.sinks import open_recording

        with open_recording(
            scene,
            config,
            save=self.save,
            serve=self.serve,
            bind=self.bind,
            connect=self.connect,
            spawn=self.viewer,
            blueprint=self.blueprint if layout is None else layout,
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
    from bevviz.support.numba_cache import CACHED

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
STDOUT = Path("-")
FORM_VERSION = 1  # of the format of every command


def json_option() -> Any:
    """Return the option ``--json``."""
    text = "the result for programs, instead of the text; into a file: beside it"
    return option("FILE.json", text, const=STDOUT, file="written at the end")


def join_json_option(arguments: Iterable[str]) -> list[str]:
    """Replace ``--json PATH`` by ``--json=- PATH``, unless PATH is a .json file."""
    joined: list[str] = []
    for argument in arguments:
        if joined and joined[-1] == OPTION and not argument.endswith(".json"):
            joined[-1] = f"{OPTION}={STDOUT}"
        joined.append(argument)
    return joined


def form_name(command: str) -> str:
    """Return the value of the key ``form`` in the JSON of a command."""
    return f"bevviz.{command}/{FORM_VERSION}"


def write_json(target: Path | None, form: str, result: object) -> None:
    """Print or write the result if ``--json`` is given.

    Args:
        target: value of ``--json``.
        form: name of the format, that of the command.
        result: a dataclass of that format.

    Raises:
        UserError: the file cannot be written.
    """
    if target is None:
        return
    import json

    from bevviz.support.files import save_text
    from bevviz.support.json_form import json_tree

    text = json.dumps({"form": form_name(form), **json_tree(result)}, indent=1, allow_nan=False)
    if target == STDOUT:
        print(text, flush=True)
    else:
        save_text(target, f"{text}\n", OPTION)


def print_result(target: Path | None, form: str, result: object, text: Callable[[], str]) -> None:
    """Print the result as text or as JSON, and write it as ``--json FILE`` says; see ``write_json``."""
    if target != STDOUT:
        print(text(), flush=True)
    write_json(target, form, result)


# --- the check that no output overwrites an input or another output ----------------------------


def check_outputs(options: object) -> None:
    """Check the output paths before the run starts.

    Raises:
        UserError: an output is one of the inputs, also by another name or link. Or two outputs are the same
            file. Or the folder of an output does not exist, where only the end of the run would tell.
    """
    if getattr(options, "check", False):  # It writes nothing.
        return
    files = [(bound, value) for bound, value in option_values(options) if bound.option.file]
    inputs = {
        identity: path
        for bound, value in files
        if bound.option.file == "read"
        for path in map(Path, value if isinstance(value, tuple) else [value] if value else [])
        for identity in _identities(path)
    }
    outputs: dict[Path, str] = {}
    for bound, target in files:
        name, use = bound.names[0], bound.option.file
        if use == "read" or not isinstance(target, Path) or target.is_dir() or target == STDOUT:
            continue
        other = outputs.setdefault(target.resolve(), name)
        if other != name and (target.is_file() or not target.exists()):
            raise UserError(f"{name} {target}: {other} writes that file; give another name")
        if use == "written at the end" and not target.parent.is_dir():
            raise UserError(f"{name} {target}: there is no folder {target.parent}")
        for identity in _identities(target):
            if identity in inputs:
                other_name = "" if inputs[identity] == target else f" ({inputs[identity]})"
                raise UserError(f"{name} {target}: is what is read{other_name}; give another name")


def _identities(path: Path) -> Iterator[tuple[int, int]]:
    """Yield device and inode of a file, or of each file in a folder."""
    with suppress(OSError, ValueError):
        for file in path.iterdir() if path.is_dir() else [path]:
            with suppress(OSError):
                status = file.stat()
                yield status.st_dev, status.st_ino
