"""Former names of public modules, accepted for one version."""

from __future__ import annotations

import importlib
import warnings
from importlib.abc import Loader
from importlib.machinery import ModuleSpec
from types import ModuleType

FORMER = {
    "bevviz.frame": "bevviz.model.frame",
    "bevviz.geometry": "bevviz.model.geometry",
    "bevviz.logging": "bevviz.recording",
    "bevviz.results": "bevviz.model.results",
    "bevviz.run": "bevviz.pipeline.run",
}


class FormerNameLoader(Loader):
    """Loader that imports a module under its present name."""

    def create_module(self, spec: ModuleSpec) -> ModuleType:
        """Import the module that ``spec.origin`` names, and warn."""
        assert spec.origin is not None
        warnings.warn(f"{spec.name} is called {spec.origin} now", FutureWarning, stacklevel=2)
        module = importlib.import_module(spec.origin)
        spec.loader_state = module.__spec__
        return module

    def exec_module(self, module: ModuleType) -> None:
        """Give the module its own spec back, which the import system has replaced."""
        if module.__spec__ is not None and module.__spec__.loader is self:
            module.__spec__ = module.__spec__.loader_state


def spec_of(name: str) -> ModuleSpec | None:
    """Return the import spec of a former name, None for any other name."""
    former = next((old for old in FORMER if f"{name}.".startswith(f"{old}.")), "")
    if not former:
        return None
    return ModuleSpec(name, FormerNameLoader(), origin=FORMER[former] + name.removeprefix(former))
