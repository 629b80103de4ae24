"""Configuration of a live run: read again when its file changes, and changed by messages."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from pathlib import Path

from bevviz.config import Config, Layer, Preset, load, untrusted_layers
from bevviz.config.trust import MESSAGE

FIXED_KEYS = (
    "source.",
    "sync.",
    "live.log_queue",
    "live.output_queue",
    "live.held",
    "live.viewer_memory",
    "live.viewer_rate",
    "live.split_",
)  # Keys that stay fixed while the program runs.


class ReloadableConfig:
    """Sources of a live configuration: preset, project, file, and ``key=value`` settings. Later ones win.

    Functions run if the user has named them here, or has trusted the file that names them. Functions that
    run may go on after an edit of the file. Later settings are messages of other programs, and new functions
    in them do not run.

    Attributes:
        config: configuration in force.
        apply: called with each new configuration before it is in force. A UserError of it prevents that.

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
        self._changing = threading.Lock()
        self.config = load(file, settings, preset, layers=layers)
        self.apply: Callable[[Config], None] = lambda config: None

    def changed(self) -> bool:
        """Return whether the file was saved since the last call."""
        version = self._stat()
        if version == self._version:
            return False
        self._version = version
        return version is not None

    def read(self, more: Sequence[str] = (), without: Sequence[str] = ()) -> Config:
        """Return the configuration of the file as it is now. ``take`` puts it in force.

        Args:
            more: additional settings.
            without: earlier settings to take back.

        Raises:
            UserError: as ``bevviz.config.load``.
        """
        settings = self._settings_with(more, without)
        return load(self.file, settings, self._preset, layers=self._layers, in_force=self.config)

    def take(self, more: Sequence[str] = (), without: Sequence[str] = ()) -> None:
        """Put the configuration from ``read`` in force. Any thread may call it.

        Raises:
            UserError: a setting is wrong, or cannot be applied. Nothing is changed.
        """
        with self._changing:
            config = self.read(more, without)
            self.apply(config)
            self.config = config
            self._settings = self._settings_with(more, without)

    def _settings_with(self, more: Sequence[str], without: Sequence[str]) -> list[str | Layer]:
        """Return the settings with some added and some taken back."""
        newest_first = self._settings[::-1]
        for setting in untrusted_layers(without, trust=MESSAGE):
            newest_first.remove(setting)
        return [*newest_first[::-1], *untrusted_layers(more, trust=MESSAGE)]

    def _stat(self) -> tuple[int, int, int] | None:
        """Return time, size and inode of the file, or None while it is missing.

        Editors write in place or replace the file. The inode shows the second case.
        """
        try:
            status = self.file.stat() if self.file else None
        except OSError:
            return None
        return (status.st_mtime_ns, status.st_size, status.st_ino) if status else None
