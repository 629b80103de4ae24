"""Install a wheel of bevviz into fresh environments, and run the demo there.

    python tools/check_wheel.py dist/bevviz-*.whl --python python3.11 python3.12 python3.13 --arm

Each environment gets the wheel and what pip chooses for it, nothing else. The extras are resolved, not
installed. ``--arm`` also resolves the wheel for Linux on aarch64 (Jetson). The table goes to standard output.
The exit status is 1 if a demo fails. An extra that does not resolve is a row of the table.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import zipfile
from email.parser import Parser
from pathlib import Path

ARM = ["manylinux_2_17_aarch64", "manylinux_2_28_aarch64", "manylinux_2_31_aarch64", "manylinux_2_35_aarch64"]
DEMO = ["demo", "--frames", "8", "--save", "demo.rrd"]


def extras_of(wheel: Path) -> list[str]:
    """Return the names of the extras of a wheel."""
    with zipfile.ZipFile(wheel) as archive:
        (name,) = (n for n in archive.namelist() if n.endswith(".dist-info/METADATA"))
        return Parser().parsestr(archive.read(name).decode()).get_all("Provides-Extra", [])


def run(command: list[str], folder: Path) -> tuple[bool, str]:
    """Run a command in a folder. Return whether it succeeded, and its last line."""
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    lines = [line for line in (done.stdout + done.stderr).splitlines() if line.strip()]
    errors = [line for line in lines if line.startswith("ERROR")]
    return done.returncode == 0, (errors or lines or [""])[-1]


def resolves(python: Path, wheel: Path, extra: str, folder: Path, arm: str | None = None) -> tuple[bool, str]:
    """Return whether pip finds all packages of a wheel with an extra, and its last line.

    Args:
        python: the interpreter whose pip resolves.
        wheel: the wheel.
        extra: an extra, or an empty string.
        folder: a folder for what pip asks for.
        arm: version of Python, such as "3.12", to resolve for aarch64 instead of this machine.
    """
    command = [str(python), "-m", "pip", "install", "--dry-run", "--quiet"]
    if arm is not None:
        command += ["--target", str(folder / "none"), "--only-binary", ":all:", "--python-version", arm]
        command += [part for platform in ARM for part in ("--platform", platform)]
    return run([*command, f"{wheel}[{extra}]" if extra else str(wheel)], folder)


def megabytes(folder: Path) -> float:
    """Return the size of all files below a folder in MB."""
    return sum(f.stat().st_size for f in folder.rglob("*") if f.is_file() and not f.is_symlink()) * 1e-6


def check(wheel: Path, interpreter: str, arm: bool, folder: Path) -> bool:
    """Check the wheel with one interpreter, and print its rows. Return whether the demo ran."""
    subprocess.run([interpreter, "-m", "venv", folder / "venv"], check=True)
    python = folder / "venv" / "bin" / "python"
    subprocess.run([python, "-m", "pip", "install", "--quiet", "--upgrade", "pip>=25.1"], check=True)
    version = run([str(python), "-c", "import sys; print('%d.%d' % sys.version_info[:2])"], folder)[1]
    empty = megabytes(folder / "venv")
    installed, line = run([str(python), "-m", "pip", "install", "--quiet", str(wheel)], folder)
    print(f"| {version} | install | {'ok' if installed else line} |", flush=True)
    if not installed:
        return False
    print(f"| {version} | size | {megabytes(folder / 'venv') - empty:.0f} MB |")
    works, line = run([str(python.with_name("bevviz")), *DEMO], folder)
    works = works and (folder / "demo.rrd").stat().st_size > 0
    print(f"| {version} | demo | {'ok' if works else line} |", flush=True)
    for extra in extras_of(wheel):
        found, line = resolves(python, wheel, extra, folder)
        print(f"| {version} | extra {extra} | {'resolves' if found else line} |", flush=True)
    for extra in ["", *extras_of(wheel)] if arm else []:
        found, line = resolves(python, wheel, extra, folder, version)
        print(f"| {version} | aarch64 {extra} | {'resolves' if found else line} |", flush=True)
    return works


def main() -> int:
    """Check the wheel with each interpreter."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("wheel", type=Path)
    parser.add_argument("--python", nargs="+", default=[sys.executable], metavar="PYTHON")
    parser.add_argument("--arm", action="store_true", help="resolve for aarch64, too")
    options = parser.parse_args()
    wheel = options.wheel.resolve()
    print("| Python | what | result |\n| --- | --- | --- |")
    works = []
    for interpreter in options.python:
        with tempfile.TemporaryDirectory() as folder:
            works.append(check(wheel, interpreter, options.arm, Path(folder)))
    return 0 if all(works) else 1


if __name__ == "__main__":
    sys.exit(main())
