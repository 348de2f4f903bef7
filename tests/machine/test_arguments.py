"""No kernel takes so many arguments that their order must be kept by hand."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

ENGINE = Path(__file__).resolve().parents[2] / "engine"
MOST = 8
DECORATORS = ("compiled", "contracted", "inlined", "parallel_kernel", "device_function", "njit")


def kernels_of(source: Path) -> dict[str, int]:
    """The number of arguments of each kernel in a file."""
    return {
        node.name: len(node.args.args)
        for node in ast.walk(ast.parse(source.read_text(encoding="utf-8")))
        if isinstance(node, ast.FunctionDef)
        if any(_name(own) in DECORATORS for own in node.decorator_list)
    }


def _name(decorator: ast.expr) -> str:
    called = decorator.func if isinstance(decorator, ast.Call) else decorator
    return called.id if isinstance(called, ast.Name) else ""


@pytest.mark.parametrize("folder", ["machine", "raster", "model", "train", "semantics", "passes"])
def test_kernels_take_eight_arguments_at_most(folder: str) -> None:
    found = {source: kernels_of(source) for source in sorted((ENGINE / folder).rglob("*.py"))}
    assert any(found.values())
    too_many = {
        f"{source.name}: {name}" for source, own in found.items() for name, count in own.items() if count > MOST
    }
    assert too_many == set()
