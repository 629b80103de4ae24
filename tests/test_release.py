"""What runs in other people's CI: the GitHub Action, and the files that workflows and containers name."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest
from ruamel.yaml import YAML

from bevviz.cli import main
from bevviz.support.version import install_command

ROOT = Path(__file__).parents[1]


def yaml(name: str) -> dict[str, Any]:
    loaded: dict[str, Any] = YAML(typ="safe").load(ROOT / name)
    return loaded


def run_action(folder: Path, **inputs: str) -> tuple[int, str, dict[str, str]]:
    """Run the script of the action. Return its status, the summary of the job, and its outputs."""
    summary, outputs = folder / "step_summary.md", folder / "outputs.txt"
    environment = {
        **os.environ,
        "PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}",
        "GITHUB_STEP_SUMMARY": str(summary),
        "GITHUB_OUTPUT": str(outputs),
        "OUTPUT": "runs",
        **inputs,
    }
    script = ["bash", str(ROOT / "tools" / "run_action.sh")]
    done = subprocess.run(script, cwd=folder, env=environment, capture_output=True, text=True, check=False)
    named = dict(line.split("=", 1) for line in outputs.read_text().splitlines())
    return done.returncode, summary.read_text(), named


@pytest.mark.long
def test_the_action_holds_bags_to_limits(tmp_path: Path) -> None:
    assert main(["demo", "--frames", "3", "-o", str(tmp_path / "drive.mcap")]) == 0
    status, summary, named = run_action(
        tmp_path, BAGS="*.mcap", MODEL="demo", TRUTH="own", MINIMA="recall=0.01", MAXIMA="false_per_frame=0"
    )
    tests = ElementTree.parse(tmp_path / named["junit"]).getroot()
    limits = {case.get("name"): case.find("failure") is None for case in tests.iter("testcase")}
    assert len(limits) == 2 and limits["recall >= 0.01"]
    assert (status == 0) == all(limits.values())
    assert summary.startswith("### bevviz: passed" if status == 0 else "### bevviz: failed")
    assert (tmp_path / named["page"]).read_text().startswith("<!")


@pytest.mark.long
def test_the_action_says_why_a_bag_failed(tmp_path: Path) -> None:
    (tmp_path / "broken.mcap").write_bytes(b"no bag")
    status, summary, _ = run_action(tmp_path, BAGS="broken.mcap", TRUTH="")
    assert status == 1 and summary.startswith("### bevviz: failed (exit status 1)")
    assert "    " in summary and "broken" in summary and "Traceback" not in summary


def test_the_actions_inputs_reach_its_script_by_variables() -> None:
    steps = yaml("action.yml")["runs"]["steps"]
    assert [step["run"] for step in steps if "${{" in step.get("run", "")] == []
    (run,) = (step for step in steps if step.get("id") == "run")
    script = (ROOT / "tools" / "run_action.sh").read_text()
    assert [name for name in run["env"] if f"${{{name}" not in script and f"${name}" not in script] == []
    named = set(re.findall(r"inputs\.([\w-]+)", (ROOT / "action.yml").read_text()))
    assert named == set(yaml("action.yml")["inputs"])


def test_actions_are_pinned_by_commit() -> None:
    """A tag or a branch of an action can be moved to other code. The comment names the release for people."""
    files = [*(ROOT / ".github" / "workflows").glob("*.yml"), ROOT / "action.yml"]
    used = [line for file in files for line in file.read_text().splitlines() if re.search(r"\buses:", line)]
    assert len(used) > 10
    pinned = re.compile(r"uses: [\w-]+/[\w./-]+@[0-9a-f]{40}  # v\d+\.\d+\.\d+$")
    assert [line for line in used if not pinned.search(line)] == []


@pytest.mark.parametrize("name", ["ci", "docs", "release"])
def test_workflows_name_files_and_targets_that_exist(name: str) -> None:
    jobs = yaml(f".github/workflows/{name}.yml")["jobs"].values()
    commands = "\n".join(step.get("run", "") for job in jobs for step in job["steps"])
    files = re.findall(r"(?:python |^)((?:tools/|\.ci/)[\w./]+)", commands, re.MULTILINE)
    targets = re.findall(r"make (\w+)", commands)
    assert files + targets and [file for file in files if not (ROOT / file).is_file()] == []
    assert [
        t for t in targets if not re.search(rf"^{t}:", (ROOT / "Makefile").read_text(), re.MULTILINE)
    ] == []


@pytest.mark.parametrize(
    ("number", "command"),
    [
        ("1.2.3", "pip install 'bevviz[ros]==1.2.3'"),
        ("0.0.1.dev975+g95284471b.d20261126", "git checkout 95284471b && pip install '.[ros]'"),
        ("0+unknown", "pip install '.[ros]'"),
    ],
)
def test_the_command_to_install_fits_the_version(number: str, command: str) -> None:
    told = install_command("ros", number)
    assert told.partition("  #")[0] == command and (number == "1.2.3" or number in told)
