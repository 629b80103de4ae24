"""Commands from typed functions: a frozen dataclass states the options, and its instance holds their values.

A field ``at: str | None = option("TIME", "the scan nearest to this time")`` is the option ``--at TIME``. A
field whose type is a dataclass holds further options. A field of neither kind is no option.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import MISSING, dataclass, field, fields, is_dataclass, make_dataclass
from functools import cache
from operator import attrgetter
from types import ModuleType, NoneType, UnionType
from typing import (
    Any,
    Generic,
    Literal,
    ParamSpec,
    TypeVar,
    Union,
    cast,
    get_args,
    get_origin,
    get_type_hints,
)

from bevviz.support.extensions import Kind, load_all

# Keys of the metadata of a field.
OPTION = "option"
EXTENSION = "extension"

P = ParamSpec("P")
T = TypeVar("T")


@dataclass(frozen=True)
class Option:
    """Appearance of a field on the command line.

    Attributes:
        metavar: name of the value in help texts. A flag has none.
        help: what the option does. ``%(default)s`` stands for its default.
        names: strings that select it; empty: ``--`` and the name of the field.
        positional: whether its place selects it, not a name.
        parse: makes the value of a text. None: the type of the field does.
        nargs: number of texts, as argparse states it. None: one.
        choices: returns the allowed values, where the type of the field does not state them.
        const: value of the option without a text. None: it needs one.
        repeat: whether it may come several times; the field is a tuple.
        one_of: name of a set of options of which only one may come.
        required: whether it must come, or one of its set.
        default: value without the option.
        key: parameter of the configuration that it sets.
        file: what the command does with the file of that path: read it, write it, or write it at the end.
    """

    metavar: str | None = None
    help: str | None = None
    names: tuple[str, ...] = ()
    positional: bool = False
    parse: Callable[[str], Any] | None = None
    nargs: str | None = None
    choices: Callable[[], Sequence[str]] | None = None
    const: Any = None
    repeat: bool = False
    one_of: str = ""
    required: bool = False
    default: Any = None
    key: str = ""
    file: Literal["read", "written", "written at the end"] | None = None


def _field_of(make: Callable[P, Option]) -> Callable[P, Any]:
    """Return a function that makes the field of an option from the arguments of ``make``."""

    def make_field(*arguments: P.args, **keywords: P.kwargs) -> Any:
        made = make(*arguments, **keywords)
        default = () if made.repeat and made.default is None else made.default
        if made.required and not made.one_of:
            default = MISSING
        return field(default=default, metadata={OPTION: made})

    return make_field


def _flag(help: str, *, default: bool = False, names: tuple[str, ...] = (), one_of: str = "") -> Option:
    """Return an option without a value. It turns the default over."""
    return Option(help=help, default=default, names=names, one_of=one_of)


option, flag = _field_of(Option), _field_of(_flag)


@dataclass(frozen=True)
class Group:
    """Group of options in a help text: the attribute ``group`` of their class. Equal titles share one."""

    title: str
    description: str | None = None
    epilog: str = ""  # end of the help text


@dataclass(frozen=True)
class BoundOption:
    """Option of a class: its ``Option``, and what its field tells.

    Attributes:
        path: attributes that lead to its value, with dots between.
        option: its appearance.
        type: type of a value without None; of a tuple its items'.
        default: value without the option; MISSING: there has to be one.
        group: its group in the help text. None: it has none.
    """

    path: str
    option: Option
    type: Any
    default: Any
    group: Group | None

    @property
    def names(self) -> tuple[str, ...]:
        """Strings that select the option."""
        return self.option.names or (f"--{self.path.rpartition('.')[2].replace('_', '-')}",)

    def add_to(self, container: argparse._ActionsContainer) -> None:
        """Add the option to a parser or a group."""
        option = self.option
        keywords: dict[str, Any] = {"help": option.help}
        if self.type is bool:
            keywords["action"] = "store_false" if self.default else "store_true"
        else:
            keywords |= {
                "metavar": option.metavar,
                "default": None if self.default is MISSING else self.default,
            }
            if option.choices is not None or get_origin(self.type) is Literal:
                keywords["choices"] = get_args(self.type) if option.choices is None else option.choices()
            elif option.parse is not None or self.type is not str:
                keywords["type"] = option.parse or self.type
            if option.repeat:
                keywords |= {"action": "append", "default": []}
            elif option.const is not None:
                keywords |= {"nargs": "?", "const": option.const}
        if option.nargs is not None:
            keywords["nargs"] = option.nargs
        if option.positional:
            container.add_argument(self.path, **keywords)
        else:
            required = self.default is MISSING
            container.add_argument(*self.names, dest=self.path, required=required, **keywords)


@cache
def options_of(options: type, prefix: str = "") -> tuple[BoundOption, ...]:
    """Return the options of a dataclass and of the dataclasses in it, in the order of the help text."""
    bound = list[BoundOption]()
    hints = get_type_hints(options)
    for member in fields(options):
        hint, path = hints[member.name], f"{prefix}{member.name}"
        if is_dataclass(hint):
            bound += options_of(cast("type", hint), f"{path}.")
        elif OPTION in member.metadata:
            if get_origin(hint) in (Union, UnionType):
                (hint,) = (each for each in get_args(hint) if each is not NoneType)
            if get_origin(hint) is tuple:
                hint = get_args(hint)[0]
            group = getattr(options, "group", None)
            bound.append(BoundOption(path, member.metadata[OPTION], hint, member.default, group))
    return tuple(bound)


def option_values(options: Any) -> Iterator[tuple[BoundOption, Any]]:
    """Yield the options of a command with their values."""
    options_class: Any = type(options)
    for bound in options_of(options_class):
        yield bound, attrgetter(bound.path)(options)


def extensions(options: Any) -> Iterator[tuple[Any, Any]]:
    """Yield the extensions of a command with their options."""
    for member in fields(options):
        if EXTENSION in member.metadata:
            yield member.metadata[EXTENSION], getattr(options, member.name)


def make_options(options: type[T], values: Mapping[str, Any], prefix: str = "") -> T:
    """Return the dataclass with the values that argparse stored by the paths of the options."""
    hints, arguments = get_type_hints(options), dict[str, Any]()
    for member in fields(cast("Any", options)):
        path, hint = f"{prefix}{member.name}", hints[member.name]
        if is_dataclass(hint):
            arguments[member.name] = make_options(cast("type", hint), values, f"{path}.")
        elif path in values:
            value = values[path]
            arguments[member.name] = tuple(value) if isinstance(value, list) else value
    return options(**arguments)


@dataclass(frozen=True)
class Command(Generic[T]):
    """Command of the program.

    Attributes:
        name: its name.
        run: runs it with its options, and returns the exit status.
        help: its line in the list of commands; ``bevviz.cli`` has those of the core.
        description: the text above its options.
        epilog: the text below them, printed as it is.
        extended_by: group of extensions whose options it has, too: a dataclass ``OPTIONS`` of each.
        forms: classes of what it writes with ``--json``, as ``module:Class``; of several, the base first.
            ``docs/schemas`` has their schemas.
    """

    name: str
    run: Callable[[T], int]
    help: str
    description: str
    epilog: str
    extended_by: Kind | None
    forms: tuple[str, ...]

    def options(self, tell: Callable[[str], object]) -> Any:
        """Return the dataclass of its options: the type of the argument of ``run``, and what extends it.

        ``tell`` gets a sentence about each extension that cannot be imported.
        """
        own = next(iter(get_type_hints(self.run).values()))
        if self.extended_by is None:
            return own
        extensions = load_all(self.extended_by, tell)
        further = [
            (f"extension_{i}", extension.OPTIONS, field(metadata={EXTENSION: extension}))
            for i, extension in enumerate(extensions)
        ]
        return make_dataclass(own.__name__, further, bases=(own,), frozen=True, kw_only=True)

    def fill(self, parser: argparse.ArgumentParser, tell: Callable[[str], object]) -> None:
        """Add description and options to the parser of the command; for ``tell`` see ``options``."""
        parser.description = self.description
        options = self.options(tell)
        parser.set_defaults(command=self, options=options)
        containers: dict[str, argparse._ActionsContainer] = {}
        epilogs = dict.fromkeys([self.epilog])
        for bound in options_of(options):
            container: argparse._ActionsContainer = parser
            if (group := bound.group) is not None and not bound.option.positional:
                if group.title not in containers:
                    containers[group.title] = parser.add_argument_group(group.title, group.description)
                container = containers[group.title]
            epilogs |= dict.fromkeys([group.epilog] if group is not None else [])
            if name := bound.option.one_of:
                if name not in containers:
                    required = bound.option.required
                    containers[name] = container.add_mutually_exclusive_group(required=required)
                container = containers[name]
            bound.add_to(container)
        if any(epilogs):
            parser.formatter_class = argparse.RawDescriptionHelpFormatter
            parser.epilog = "\n\n".join(filter(None, epilogs))


def command(
    name: str,
    *,
    description: str,
    help: str = "",
    epilog: str = "",
    extended_by: Kind | None = None,
    forms: tuple[str, ...] = (),
) -> Callable[[Callable[[T], int]], Command[T]]:
    """Return a decorator that makes a command of a function; see ``Command``."""
    return lambda run: Command(name, run, help, description, epilog, extended_by, forms)


def commands_in(module: ModuleType) -> list[Command[Any]]:
    """Return the commands of a module."""
    return [value for value in vars(module).values() if isinstance(value, Command)]
