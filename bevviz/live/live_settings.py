"""Configuration of a live run: changed by users while it runs, and read again when its file changes."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence

from bevviz.config import Config
from bevviz.config.reloading import FIXED_KEYS, ReloadableConfig
from bevviz.errors import UserError
from bevviz.live.status import Notes, set_nice
from bevviz.pipeline.session import Session


class LiveSettings:
    """Configuration in force in a session. Any thread may change it.

    Args:
        settings: the configuration and its origin.
        session: takes each new configuration.
        notes: takes a line for each change.
        follow: called with each new configuration, in the thread that changes it.
    """

    def __init__(
        self,
        settings: ReloadableConfig,
        session: Session,
        notes: Notes,
        follow: Callable[[Config], None],
    ) -> None:
        self._settings, self._session, self._notes, self._follow = settings, session, notes, follow
        self._changing = threading.Lock()
        self._set_nice(settings.config.live.nice)

    def update(self, settings: Sequence[str], without: Sequence[str] = ()) -> None:
        """Apply settings, ``key=value`` as after ``--set``.

        Args:
            settings: settings that override all earlier ones.
            without: settings of an earlier call to revert.

        Raises:
            UserError: a setting is wrong. Nothing is changed then.
        """
        with self._changing:
            self._apply(self._settings.read(settings, without))
            self._settings.keep(self._settings.config, settings, without)

    def look(self) -> None:
        """Read the configuration file again if it has changed. If it is wrong, all stays as it was."""
        if not self._settings.changed():
            return
        try:
            with self._changing:
                self._apply(self._settings.read())
        except UserError as error:
            self._notes.warn(f"{error}; the configuration stays as it was")

    def _apply(self, config: Config) -> None:
        """Apply a configuration and report what changed."""
        nice = self._session.config.live.nice
        changed = self._session.configure(config)
        self._settings.keep(config)
        self._follow(config)
        if config.live.nice != nice:
            self._set_nice(config.live.nice)
        for key, change in changed.items():
            if ".params." in key and "absent" in (change.before, change.after):
                continue  # the change of the method is reported instead
            late = "; takes effect at the next start" if key.startswith(FIXED_KEYS) else ""
            self._notes.info(f"configuration: {key} {change}{late}")

    def _set_nice(self, nice: int) -> None:
        """Set the priority of the process, or warn if that is not permitted."""
        try:
            set_nice(nice)
        except PermissionError:
            self._notes.warn(f"live.nice={nice}: only root may take priority back")
