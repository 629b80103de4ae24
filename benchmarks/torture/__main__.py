"""Torture: damaged bags and fuzzed messages, beside what other readers make of them, and killed processes.

Prints a table for each part and what went wrong in it, and ends with status 1 where anything did: a
traceback, a hang, a loss without a word, fewer messages than 99.5 % of what the best other reader gives, a
false result after a signal, a process or a file that is left, or one that cannot be read after a kill.
"""

from __future__ import annotations

import argparse
import random
import sys
from collections.abc import Callable, Mapping

from benchmarks.torture import damage, folders, fuzz, kill, messages, models
from tests.support.bag_formats import FORMATS

EXAMPLES = 40  # of what went wrong that are printed
SHARE = 0.995  # of the messages that the best other reader gives

Part = Callable[[argparse.Namespace], bool]
"""A part of the torture: prints its figures, returns whether all was well."""


def damaged_bags(options: argparse.Namespace) -> bool:
    names = [name for name in FORMATS if options.format is None or options.format in name]
    if not names:
        raise SystemExit(f"--format {options.format}: none of {'; '.join(FORMATS)}")
    total = damage.Tally()
    print(f"\nDamaged bags, seed {options.seed}\n\n{damage.HEAD}")
    for name, tally in damage.run(options.seed, options.bags, names):
        print(damage.row(name, tally), flush=True)
        total += tally
    print(damage.row("all", total))
    _print_examples(total.examples)
    return total.share >= SHARE and not (total.tracebacks or total.hangs or total.silent)


def fuzzed_messages(options: argparse.Namespace) -> bool:
    (total,) = fuzz.run(options.seed, options.messages)
    print(f"\nFuzzed messages, seed {options.seed}\n\n{fuzz.HEAD}\n{fuzz.row(total)}")
    _print_examples(total.examples)
    return not (total.tracebacks or total.broken or total.hangs)


def changed_models(options: argparse.Namespace) -> bool:
    (total,) = models.run(options.seed, options.models)
    print(f"\nHostile and broken ONNX files, seed {options.seed}\n\n{models.HEAD}\n{models.row(total)}")
    _print_examples(total.examples)
    return total.well


def messages_of_all_kinds(options: argparse.Namespace) -> bool:
    names = [name for name in messages.KINDS if options.kind is None or options.kind in name]
    if not names:
        raise SystemExit(f"--kind {options.kind}: none of {'; '.join(messages.KINDS)}")
    total = messages.Tally()
    print(f"\nMessages of all kinds, seed {options.seed}\n\n{messages.HEAD}")
    for name, tally in messages.run(options.seed, options.each, names):
        print(messages.row(name, tally), flush=True)
        total += tally
    print(messages.row("all", total))
    _print_examples(total.examples)
    return total.well


def killed_processes(options: argparse.Namespace) -> bool:
    print(f"\nSignals at any time, seed {options.seed}\n\n{kill.HEAD}")
    well, examples = True, list[str]()
    wanted = (options.commands or ",".join(kill.COMMANDS)).split(",")
    if unknown := set(wanted) - set(kill.COMMANDS):
        raise SystemExit(f"--commands {', '.join(sorted(unknown))}: none of {', '.join(kill.COMMANDS)}")
    for name, tally in kill.run(options.seed, options.signals, wanted):
        print(kill.row(name, tally), flush=True)
        well &= tally.well
        examples += tally.examples
    _print_examples(examples)
    return well


def strange_folders(options: argparse.Namespace) -> bool:
    total = folders.Tally()
    print(f"\nData set folders and configuration files of strangers, seed {options.seed}\n\n{folders.HEAD}")
    names = [name for name in (*folders.FOLDERS, "project") if (options.kind or "") in name]
    if not names:
        raise SystemExit(f"--kind {options.kind}: none of {', '.join(folders.FOLDERS)}, project")
    for name, tally in folders.run(options.seed, options.folders, names):
        print(folders.row(name, tally), flush=True)
        total += tally
    print(folders.row("all", total))
    _print_examples(total.examples)
    return total.well


def _print_examples(examples: list[str]) -> None:
    for example in examples[:EXAMPLES]:
        print(f"- {example}")
    if len(examples) > EXAMPLES:
        print(f"- and {len(examples) - EXAMPLES} more")


PARTS: Mapping[str, Part] = {
    "damage": damaged_bags,
    "fuzz": fuzzed_messages,
    "messages": messages_of_all_kinds,
    "models": changed_models,
    "folders": strange_folders,
    "kill": killed_processes,
}


def _seed(text: str) -> int:
    return random.randrange(1 << 32) if text == "random" else int(text)


def main() -> int:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.torture",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("parts", nargs="*", metavar="PART", help=f"{', '.join(PARTS)} (default: all of them)")
    parser.add_argument(
        "--seed", type=_seed, default=0, help="number, or 'random' for another one each time (default: 0)"
    )
    parser.add_argument("--bags", type=int, default=900, help="damaged bags (default: 900)")
    parser.add_argument("--format", metavar="NAME", help="only the formats whose name has this in it")
    parser.add_argument("--messages", type=int, default=2000, help="fuzzed messages (default: 2000)")
    parser.add_argument("--each", type=int, default=500, help="messages of each kind (default: 500)")
    parser.add_argument("--models", type=int, default=600, help="changed ONNX files (default: 600)")
    parser.add_argument(
        "--folders", type=int, default=560, help="data set folders, and as many project files (default: 560)"
    )
    parser.add_argument(
        "--kind", metavar="NAME", help="only folders or messages whose kind has this in its name"
    )
    parser.add_argument(
        "--signals", type=int, default=280, help="signals, shared among the commands (default: 280)"
    )
    parser.add_argument(
        "--commands", metavar="NAME,...", help=f"that are sent signals: {', '.join(kill.COMMANDS)}"
    )
    options = parser.parse_args()
    if unknown := set(options.parts) - set(PARTS):
        parser.error(f"{', '.join(sorted(unknown))}: no such part; there are {', '.join(PARTS)}")
    failed = [name for name in options.parts or PARTS if not PARTS[name](options)]
    return int(bool(failed))


if __name__ == "__main__":
    sys.exit(main())
