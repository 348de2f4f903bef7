"""What is attacked, read from the tests themselves: `python -m tests.trust_page` writes docs/trust.md.

A module's first sentence is what is promised, a test's name is what is tried. Its decorators say how often.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
PAGE = ROOT / "docs" / "trust.md"
MODULES = (
    "scene/test_limits", "scene/test_bombs", "scene/test_fuzz", "diagnosis/test_fuzz", "model/test_checking",
    "corrections/test_fuzz", "job/test_fuzz", "plgs_blender/test_fuzz_files", "scene/test_splat_file",
    "gates/test_texts", "batch/test_plan", "set_up/test_adding", "test_kill_and_resume",
)  # fmt: skip
"""Below tests/. Each is about nothing but an attack."""
_HEAD = """# What was attacked

`python -m tests.trust_page` writes this page from the tests. A heading is what is promised, a row what is tried, and
how often in one run: examples that hypothesis makes, or cases. Rows with "slow" are left out by `make test`.
`PLGS_FUZZ=100` makes a hundred times as many examples.
[SECURITY.md](../SECURITY.md) says what all of it amounts to.
"""


def page() -> str:
    """The text of docs/trust.md."""
    return "\n".join([_HEAD, *(line for module in MODULES for line in _section(ROOT / "tests" / f"{module}.py"))])


def _section(path: Path) -> Iterator[str]:
    tree = ast.parse(path.read_text(encoding="utf-8"))
    promise = (ast.get_docstring(tree) or "").split("\n\n")[0].replace("\n", " ").removesuffix(".")
    yield f"## {promise}\n\n`tests/{path.relative_to(ROOT / 'tests').as_posix()}`\n"
    yield "| tried | how often |\n|---|---|"
    named = {
        target.id: node.value
        for node in tree.body
        if isinstance(node, ast.Assign)
        for target in node.targets
        if isinstance(target, ast.Name)
    }
    for node in tree.body:
        if isinstance(node, ast.FunctionDef) and node.name.startswith("test_"):
            yield f"| {node.name.removeprefix('test_').replace('_', ' ')} | {_times(node, named)} |"
    yield ""


def _times(test: ast.FunctionDef, named: dict[str, ast.expr]) -> str:
    """Such as "60 examples", "2 x 3 cases", "once (slow)"."""
    cases, examples = list[str](), ""
    for decorator in test.decorator_list:
        call = named.get(decorator.id) if isinstance(decorator, ast.Name) else decorator
        if not isinstance(call, ast.Call):
            continue
        match ast.unparse(call.func):
            case "examples":
                examples = f"{ast.unparse(call.args[0])} examples"
            case "pytest.mark.parametrize":
                values = call.args[1]
                values = named.get(values.id, values) if isinstance(values, ast.Name) else values
                is_list = isinstance(values, ast.List | ast.Tuple)
                is_counted = is_list and not any(isinstance(each, ast.Starred) for each in values.elts)
                cases.append(str(len(values.elts)) if is_counted else "several")
    told = f"{' x '.join(cases)} cases" if cases else ""
    slow = any(ast.unparse(decorator) == "pytest.mark.slow" for decorator in test.decorator_list)
    return (", ".join(part for part in (told, examples) if part) or "once") + (" (slow)" if slow else "")


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8", newline="\n")
