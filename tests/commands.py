"""Commands as the tests of `engine` and `research` run them."""

import json
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest

from engine.command_line.main import main


def exit_code(main: Callable[[Sequence[str]], int], *arguments: str | Path) -> int:
    """What ``main`` answers, also where argparse ends it."""
    try:
        return int(main([str(argument) for argument in arguments]))
    except SystemExit as error:
        assert isinstance(error.code, int)
        return error.code


def answer_of(capsys: pytest.CaptureFixture[str], *arguments: object) -> Any:
    """What a command of the engine answers with --json."""
    capsys.readouterr()
    assert main([*map(str, arguments), "--json"]) == 0, capsys.readouterr().err
    return json.loads(capsys.readouterr().out.splitlines()[-1])


def refuse_heavy_help(root: Path, module: str, command: Sequence[str]) -> None:
    """Fail unless ``command --help`` of the ``main`` in ``module`` answers without importing what is heavy."""
    code = (
        "import sys\n"
        f"from {module} import main\n"
        "try: main(sys.argv[1:])\n"
        "finally: print('HEAVY', {'torch', 'numpy', 'cv2', 'numba'} & set(sys.modules))"
    )
    said = subprocess.run(
        [sys.executable, "-c", code, *command, "--help"], cwd=root, capture_output=True, text=True, timeout=120
    )
    assert said.returncode == 0 and "HEAVY set()" in said.stdout and "usage:" in said.stdout
