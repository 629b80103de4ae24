"""Users' modules in tests: what a new process knows of them."""

from __future__ import annotations

import sys

from bevviz.config import module_folder, plugins


def forget_modules(*packages: str) -> None:
    """Forget imported modules of these names and everything that was imported from a folder."""
    plugins.load_plugin.cache_clear()
    sys.path_hooks[:] = [hook for hook in sys.path_hooks if hook not in module_folder._hooks.values()]
    module_folder._hooks.clear()
    sys.path_importer_cache.clear()
    for name in [name for name in sys.modules if name.partition(".")[0] in packages]:
        del sys.modules[name]
