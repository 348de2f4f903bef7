"""The calls of POSIX and of Windows have the same names and arguments."""

from __future__ import annotations

import inspect
from typing import Any

from engine.job import system
from engine.job.system import posix, windows


def functions(module: Any) -> dict[str, list[str]]:
    return {
        name: list(inspect.signature(function).parameters)
        for name, function in inspect.getmembers(module, inspect.isfunction)
        if function.__module__ == module.__name__
    }


def test_both_systems_have_the_same_functions() -> None:
    assert functions(posix) == functions(windows)
    for name in (*functions(posix), "OPEN_FILES_KEEP_NAMES"):
        assert getattr(system, name) is getattr(system.system, name), "the engine has it by its name"
