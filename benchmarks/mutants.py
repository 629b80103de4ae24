"""Measure how many planted errors of the code the tests find: mutation testing by cosmic-ray.

``python -m benchmarks.mutants FOLDER --sample 100`` clones the checkout to FOLDER, draws mutants of stages,
explanations, evaluation and synchronisation, changes the clone by one at a time, and runs the tests that
belong to its package until one fails. It prints the share of killed mutants with its 95 % interval (Wilson
1927), and names the survivors. ``--seed`` draws others. Run again with the same FOLDER, it
goes on. It needs ``pip install cosmic-ray``.
"""

from __future__ import annotations

import argparse
import math
import os
import random
import shlex
import sqlite3
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
TESTS = {  # package: words of the names of its tests' files
    "stages": "ground clustering packed_cells compiled_loops voxel frustum fusion bev tracking detector "
    "detector_references onnx_providers instance_masks odometry user_stages pillars perceive",
    "why": "why_sentences why_stages why_hints why explain robot_chain why_kitti",
    "evaluate": "evaluate kitti marks unusable_labels",
    "sync": "sync tf lidar_mounting video surroundings",
}
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
    clone = options.folder.resolve() / "clone"
    if not clone.exists():
        subprocess.run(["git", "clone", "--quiet", "--no-hardlinks", str(ROOT), str(clone)], check=True)
    killed = total = 0
    for package in TESTS:
        session = options.folder / f"{package}.sqlite"
        if not session.exists():
            _cosmic_ray(
                clone, "baseline", _config(package, clone, session)
            )  # raises if a test fails unchanged
            _draw(package, clone, session, options.sample // len(TESTS), options.seed)
        _cosmic_ray(clone, "exec", _config(package, clone, session), session)
        outcomes = _outcomes(session)
        survived = [place for place, outcome in outcomes if outcome == "SURVIVED"]
        killed, total = killed + len(outcomes) - len(survived), total + len(outcomes)
        print(f"{package}: {len(outcomes) - len(survived)} of {len(outcomes)} killed", flush=True)
        for place in survived:
            print(f"  survived: {place}", flush=True)
    low, high = _interval(killed, total)
    print(f"{killed} of {total} killed: {killed / total:.0%} ({low:.0%} to {high:.0%})")
    return 0


def _config(package: str, clone: Path, session: Path) -> Path:
    """Write the configuration of cosmic-ray for one package and return its path."""
    tests = [f"tests/test_{name}.py" for name in TESTS[package].split()]
    present = [test for test in tests if (clone / test).exists()]
    command = shlex.join([sys.executable, "-m", "pytest", "-q", "-x", "-m", "not long", *present])
    path = session.with_suffix(".toml")
    path.write_text(
        f'[cosmic-ray]\nmodule-path = "bevviz/{package}"\ntimeout = {SECONDS}\nexcluded-modules = []\n'
        f"test-command = '''{command}'''\n[cosmic-ray.distributor]\nname = \"local\"\n",
        encoding="utf-8",
    )
    return path


def _draw(package: str, clone: Path, session: Path, count: int, seed: int) -> None:
    """List the mutants of a package and leave ``count`` of them, drawn at random."""
    listed = session.with_suffix(".all")
    _cosmic_ray(clone, "init", _config(package, clone, session), listed)
    with sqlite3.connect(listed) as base:
        rows = base.execute(
            "SELECT job_id, operator_name FROM mutation_specs "
            "ORDER BY module_path, start_pos_row, start_pos_col, operator_name, occurrence"
        )
        jobs = [job for job, operator in rows if not operator.startswith(ANNOTATIONS)]
        chosen = random.Random(f"{seed} {package}").sample(jobs, min(count, len(jobs)))
        marks = ",".join("?" * len(chosen))
        for table in ("mutation_specs", "work_items"):
            base.execute(f"DELETE FROM {table} WHERE job_id NOT IN ({marks})", chosen)
    listed.rename(session)


def _cosmic_ray(clone: Path, command: str, *files: Path) -> None:
    environment = {**os.environ, "PYTHONPATH": str(clone), "PYTHONDONTWRITEBYTECODE": "1", "CI": "1"}
    arguments = [command, *(str(file.resolve()) for file in files)]
    subprocess.run(
        [sys.executable, "-m", "cosmic_ray.cli", *arguments], cwd=clone, env=environment, check=True
    )


def _outcomes(session: Path) -> list[tuple[str, str]]:
    """Return place and outcome of each mutant."""
    query = """SELECT module_path, start_pos_row, operator_name, occurrence, test_outcome
        FROM mutation_specs JOIN work_results USING (job_id) ORDER BY module_path, start_pos_row"""
    with sqlite3.connect(session) as base:
        return [
            (f"{path}:{row} {operator.removeprefix('core/')} {occurrence}", str(outcome))
            for path, row, operator, occurrence, outcome in base.execute(query)
        ]


def _interval(killed: int, total: int) -> tuple[float, float]:
    """Return the 95 % interval of a share."""
    share, z = killed / total, 1.96
    centre = share + z * z / (2 * total)
    spread = z * math.sqrt(share * (1 - share) / total + z * z / (4 * total * total))
    return (centre - spread) / (1 + z * z / total), (centre + spread) / (1 + z * z / total)


if __name__ == "__main__":
    sys.exit(main())
