"""Measure how many planted errors of the code the tests find: mutation testing by cosmic-ray.

``python -m benchmarks.mutants FOLDER --sample 100`` clones the checkout to FOLDER, draws mutants of stages,
explanations, evaluation and synchronisation, changes the clone by one at a time, and runs the files of tests
that name the changed module until one fails. It prints the share of killed mutants with its 95 % interval
(Wilson 1927), and names the survivors. ``--seed`` draws others. Run again with the same FOLDER, it goes on.
It needs ``pip install cosmic-ray``.
"""

from __future__ import annotations

import argparse
import math
import os
import random
import re
import shlex
import shutil
import sqlite3
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("stages", "why", "evaluate", "sync")
SECONDS = 1200.0  # a mutant whose tests run longer than this hangs: it is killed
# Annotations are full of these, and are not run.
ANNOTATIONS = "core/ReplaceBinaryOperator_BitOr_"


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path, help="for the clone and the state of the run")
    parser.add_argument("--sample", type=int, default=100, help="mutants in all (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=1, help="of the draw (default: %(default)s)")
    options = parser.parse_args()
    folder = options.folder.resolve()
    clone = folder / "clone"
    if not clone.exists():
        subprocess.run(["git", "clone", "--quiet", "--no-hardlinks", str(ROOT), str(clone)], check=True)
    killed = total = 0
    for package in PACKAGES:
        listed = folder / f"{package}.sqlite"
        if not listed.exists():
            _list(package, clone, listed)
        for module, jobs in _draw(
            listed, options.sample // len(PACKAGES), f"{options.seed} {package}"
        ).items():
            session = folder / f"{module.replace('/', '.')}.{options.seed}.sqlite"
            config = _config(module, clone, session)
            if not session.exists():
                _keep(listed, session, jobs)
            _cosmic_ray(clone, "exec", config, session)
            outcomes = _outcomes(session)
            survived = [place for place, outcome in outcomes if outcome == "SURVIVED"]
            killed, total = killed + len(outcomes) - len(survived), total + len(outcomes)
            print(f"{module}: {len(outcomes) - len(survived)} of {len(outcomes)} killed", flush=True)
            for place in survived:
                print(f"  survived: {place}", flush=True)
    low, high = _interval(killed, total)
    print(f"{killed} of {total} killed: {killed / total:.0%} ({low:.0%} to {high:.0%})")
    return 0


def _config(module: str, clone: Path, session: Path) -> Path:
    """Write the configuration of cosmic-ray for one module or package and return its path."""
    dotted = module.removesuffix(".py").replace("/", ".")
    name = re.compile(
        rf"{re.escape(dotted)}\b|{re.escape(dotted.rpartition('.')[0])} import .*\b{Path(module).stem}\b"
    )
    tests = [path for path in sorted((clone / "tests").rglob("test_*.py")) if name.search(path.read_text())]
    tests = sorted(tests, key=lambda path: path.stat().st_size) or [clone / "tests/test_perceive.py"]
    command = shlex.join([sys.executable, "-m", "pytest", "-q", "-x", "-m", "not long", *map(str, tests)])
    path = session.with_suffix(".toml")
    path.write_text(
        f'[cosmic-ray]\nmodule-path = "{module}"\ntimeout = {SECONDS}\nexcluded-modules = []\n'
        f"test-command = '''{command}'''\n[cosmic-ray.distributor]\nname = \"local\"\n",
        encoding="utf-8",
    )
    return path


def _list(package: str, clone: Path, listed: Path) -> None:
    """List all mutants of a package."""
    unfinished = listed.with_suffix(".all")
    _cosmic_ray(clone, "init", _config(f"bevviz/{package}", clone, unfinished), unfinished)
    unfinished.rename(listed)


def _draw(listed: Path, count: int, seed: str) -> dict[str, list[str]]:
    """Draw mutants at random. Return their jobs by module."""
    with sqlite3.connect(listed) as base:
        rows = base.execute(
            "SELECT module_path, job_id, operator_name FROM mutation_specs "
            "ORDER BY module_path, start_pos_row, start_pos_col, operator_name, occurrence"
        )
        jobs = [(module, job) for module, job, operator in rows if not operator.startswith(ANNOTATIONS)]
    drawn = dict[str, list[str]]()
    for module, job in random.Random(seed).sample(jobs, min(count, len(jobs))):
        drawn.setdefault(module, []).append(job)
    return dict(sorted(drawn.items()))


def _keep(listed: Path, session: Path, jobs: list[str]) -> None:
    """Copy the list of mutants and keep these."""
    shutil.copy(listed, session)
    marks = ",".join("?" * len(jobs))
    with sqlite3.connect(session) as base:
        for table in ("mutation_specs", "work_items"):
            base.execute(f"DELETE FROM {table} WHERE job_id NOT IN ({marks})", jobs)


def _cosmic_ray(clone: Path, command: str, *files: Path) -> None:
    environment = {**os.environ, "PYTHONPATH": str(clone), "PYTHONDONTWRITEBYTECODE": "1", "CI": "1"}
    arguments = [command, *(str(file.resolve()) for file in files)]
    subprocess.run(
        [sys.executable, "-m", "cosmic_ray.cli", *arguments], cwd=clone, env=environment, check=True
    )


def _outcomes(session: Path) -> list[tuple[str, str]]:
    """Return place and outcome of each mutant."""
    query = """SELECT start_pos_row, operator_name, occurrence, test_outcome, output
        FROM mutation_specs JOIN work_results USING (job_id) ORDER BY start_pos_row"""
    with sqlite3.connect(session) as base:
        rows = [*base.execute(query)]
    if any("no tests ran" in str(row[-1]) for row in rows):
        raise SystemExit(f"{session}: the tests cannot be run: {rows[0][-1][-500:]}")
    return [(f"line {row}: {name.removeprefix('core/')} {n}", str(end)) for row, name, n, end, _ in rows]


def _interval(killed: int, total: int) -> tuple[float, float]:
    """Return the 95 % interval of a share."""
    share, z = killed / total, 1.96
    centre = share + z * z / (2 * total)
    spread = z * math.sqrt(share * (1 - share) / total + z * z / (4 * total * total))
    return (centre - spread) / (1 + z * z / total), (centre + spread) / (1 + z * z / total)


if __name__ == "__main__":
    sys.exit(main())
