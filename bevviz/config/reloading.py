"""The configuration while it runs: read again when its file changes, and open to settings from outside."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from bevviz.config import Config, Layer, Preset, load, received
from bevviz.config.trust import MESSAGE

AT_START = (
    "source.",
    "sync.",
    "live.log_queue",
    "live.output_queue",
    "live.held",
    "live.viewer_memory",
    "live.viewer_rate",
    "live.split_",
)  # fixed once it runs


class Settings:
    """Preset, project, file and ``key=value`` settings, later ones winning; what ``update`` brings wins.

    Functions run where the user has named them here, or trusts the file that does. Those that run may go on
    after an edit of the file. Settings that come later are messages of other programs: they name none anew.

    Raises:
        UserError: as ``bevviz.config.load``.
    """

    def __init__(
        self,
        file: Path | None = None,
        settings: Sequence[str | Layer] = (),
        preset: Preset | None = None,
        layers: Sequence[Layer] = (),
    ) -> None:
        self.file = file
        self._settings: list[str | Layer] = list(settings)
        self._preset = preset
        self._layers = layers
        self._version = self._stat()
        self.config = load(file, settings, preset, layers=layers)

    def changed(self) -> bool:
        """Whether the file was saved since the last call."""
        version = self._stat()
        if version == self._version:
            return False
        self._version = version
        return version is not None

    def read(self, more: Sequence[str] = (), without: Sequence[str] = ()) -> Config:
        """The configuration as it is now; ``keep`` makes it last.

        Args:
            more: further settings.
            without: those of before that are taken back.

        Raises:
            UserError: as ``bevviz.config.load``.
        """
        settings = self._with(more, without)
        return load(self.file, settings, self._preset, layers=self._layers, in_force=self.config)

    def take(self, more: Sequence[str]) -> None:
        """More settings, before anything runs with them.

        Raises:
            UserError: one of them is wrong; nothing is changed.
        """
        self.keep(self.read(more), more)

    def keep(self, config: Config, more: Sequence[str] = (), without: Sequence[str] = ()) -> None:
        self.config = config
        self._settings = self._with(more, without)

    def _with(self, more: Sequence[str], without: Sequence[str]) -> list[str | Layer]:
        newest_first = self._settings[::-1]
        for setting in received(without, trust=MESSAGE):
            newest_first.remove(setting)
        return [*newest_first[::-1], *received(more, trust=MESSAGE)]

    def _stat(self) -> tuple[int, int, int] | None:
        """Editors write in place or put another file there; None while it is missing."""
        try:
            found = self.file.stat() if self.file else None
        except OSError:
            return None
        return (found.st_mtime_ns, found.st_size, found.st_ino) if found else None
