"""Pages and doors are tied: a page's tests run each command of its blocks, or UNTRIED names the reason why not."""

import ast
from pathlib import Path

import pytest

from tests.doors.terminal import PAGES, commands_of

FOLDER = Path(__file__).parent
UNTRIED = {
    "blender": "needs a Blender on PATH: tests/window runs its own",
    "sbatch": "needs a cluster: tests/batch runs its Slurm against a stand-in",
    "deadlinecommand": "needs Deadline, which nobody here has",
    ".venv/bin/python -m engine segment SCENE --download": "needs the hub: the tests run it with a network in a folder",
    "python3 -m engine set-up": "downloads 600 MB: tests/set_up runs it with an index of its own",
    "PYTHON -m engine add": "downloads packages: tests/set_up runs it with an index of its own",
    ".venv/bin/python -m engine add": "downloads packages: tests/set_up runs it with an index of its own",
    "curl": "needs Flamenco's manager: tests/farm runs the job type in a JavaScript engine",
}
"""The beginnings of commands that no test runs, and why."""


@pytest.mark.parametrize("page", PAGES)
def test_every_command_printed_on_a_page_of_the_docs_is_run_by_its_tests(page: str) -> None:
    printed = [line for line in commands_of(page) if not line.startswith((*UNTRIED,))]
    tests = FOLDER / f"test_{page.replace('-', '_')}.py"
    if not printed:
        return
    tree = ast.parse(tests.read_text(encoding="utf-8"))
    written = [node.value for node in ast.walk(tree) if isinstance(node, ast.Constant) and isinstance(node.value, str)]
    missing = [line for line in printed if not any(line in text for text in written)]
    assert not missing, f"docs/{page}.md has commands that {tests.name} does not run"
