"""Former names of public modules and of options, accepted for one version."""

from __future__ import annotations

import importlib
import warnings
from collections.abc import Sequence
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

FORMER_OPTIONS = {  # (command, former option) -> present option
    ("batch", "--dataset"): "--catalog-name",
    ("demo", "--bag"): "--output",
    ("export", "--out"): "--output",
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


def present_options(command_line: Sequence[str]) -> tuple[list[str], list[str]]:
    """Return a command line with the present names of options, and a line for each former name."""
    command, lines, present = command_line[0] if command_line else "", [], []
    for argument in command_line:
        name, equals, value = argument.partition("=")
        option = FORMER_OPTIONS.get((command, name), name)
        if option != name:
            lines.append(f"bevviz {command} {name} is called {option} now")
        present.append(f"{option}{equals}{value}")
    return present, lines


def spec_of(name: str) -> ModuleSpec | None:
    """Return the import spec of a former name, None for any other name."""
    former = next((old for old in FORMER if f"{name}.".startswith(f"{old}.")), "")
    if not former:
        return None
    return ModuleSpec(name, FormerNameLoader(), origin=FORMER[former] + name.removeprefix(former))
