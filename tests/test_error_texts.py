"""errors.golden.txt lists the wording of every PlgsError by key. `python tests/test_error_texts.py` writes it anew."""

import ast
import re
import sys
from collections.abc import Iterator, Sequence
from functools import cache
from itertools import groupby
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parent.parent
GOLDEN = ROOT / "tests" / "errors.golden.txt"
CODE = ("engine", "operators", "plgs_blender", "research", "sample", "ui", "run_plgs.py")

Texts = dict[str, str]
"""What names stand for, with all that they may stand for in one text."""


class Error(NamedTuple):
    """An error that some line makes."""

    key: str
    module: str
    what: str
    where: str
    fix: str

    @property
    def text(self) -> str:
        """As a command says it."""
        from engine.errors import problem_of  # below, as this file is also run by its path

        return problem_of(self.what, self.where and "WHERE") + (self.fix and f". {self.fix}")


class Maker(NamedTuple):
    """What makes an error: PlgsError, a subclass, or a function that is given ``what``."""

    parameters: list[str]
    key: str = ""
    fix: str = ""


def test_errors_golden_txt_lists_the_current_error_texts() -> None:
    told = "`python tests/test_error_texts.py` writes it: read the changes, and commit them"
    assert GOLDEN.read_text(encoding="utf-8") == golden(), told


def test_each_error_text_has_one_short_key() -> None:
    assert [one for one in all_errors() if not re.fullmatch(r"[a-z0-9]+(-[a-z0-9]+)*", one.key)] == []
    keys: dict[tuple[str, str], str] = {}
    for one in all_errors():
        assert keys.setdefault((one.what, one.fix), one.key) == one.key or "{" in one.what, one


def test_every_message_is_a_sentence_with_a_subject() -> None:
    assert [one for one in all_errors() if one.text.startswith(" ")] == []


def golden() -> str:
    """Each key, and below it where it is used and with what text."""
    told = ""
    for key, errors in groupby(all_errors(), lambda error: error.key):
        told += "\n".join([key, *(f"    {one.module}: {one.text}" for one in errors), ""])
    return told


@cache
def all_errors() -> list[Error]:
    """Sorted. What is raised again with the key of another error is none of its own."""
    files = [file for place in CODE for file in ([ROOT / place] if "." in place else (ROOT / place).rglob("*.py"))]
    trees = {file.relative_to(ROOT).as_posix(): ast.parse(file.read_text(encoding="utf-8")) for file in files}
    constants: Texts = {}
    for tree in trees.values():
        constants |= _after(tree.body, constants)
    makers = {"PlgsError": Maker(["key", "what", "where", "fix"])}
    for node in (each for tree in trees.values() for each in ast.walk(tree)):
        if isinstance(node, ast.ClassDef) and any(ast.unparse(base) == "PlgsError" for base in node.bases):
            makers[node.name] = makers["PlgsError"]
        elif isinstance(node, ast.FunctionDef) and node.returns and ast.unparse(node.returns) == "PlgsError":
            parameters = [each.arg for each in node.args.args]
            for call, texts in _calls(node, ["PlgsError"], constants) if "what" in parameters else ():
                key, fix = (_text(call.args[index], texts) for index in (0, 3))
                makers[node.name] = Maker(parameters, "" if "key" in parameters else key, fix)
    return sorted({error for module, tree in trees.items() for error in _errors(module, tree, makers, constants)})


def _errors(module: str, tree: ast.Module, makers: dict[str, Maker], constants: Texts) -> Iterator[Error]:
    for call, texts in _calls(tree, list(makers), constants | _after(tree.body, constants)):
        maker = makers[_name(call)]
        given = {name: _text(each, texts) for name, each in zip(maker.parameters, call.args, strict=False)}
        key = maker.key or given["key"]
        if given["what"] != "{what}" and not key.startswith("{"):
            where = given.get("where", "{where}") and "{where}"
            yield Error(key, module, given["what"], where, maker.fix or given["fix"])


def _calls(node: ast.AST, names: Sequence[str], known: Texts) -> Iterator[tuple[ast.Call, Texts]]:
    """The calls of these names, with what other names stand for there."""
    if isinstance(node, ast.Call) and _name(node) in names:
        yield node, known
    for _, field in ast.iter_fields(node):
        texts = known
        for each in field if isinstance(field, list) else [field]:
            if isinstance(each, ast.AST):
                yield from _calls(each, names, texts)
                texts = _after([each], texts) if isinstance(each, ast.stmt) else texts


def _after(block: Sequence[ast.AST], known: Texts) -> Texts:
    """What names stand for after these statements."""
    assignments = [*_assignments(block)]
    texts = dict(known) if assignments else known
    for node in assignments:
        target, value = node.targets[0], node.value
        is_pair = isinstance(target, ast.Tuple) and isinstance(value, ast.Tuple)
        for name, given in zip(target.elts, value.elts, strict=False) if is_pair else [(target, value)]:
            text = _text(given, texts)
            if isinstance(name, ast.Name) and not re.fullmatch(r"\{[^{}]*\}", text):
                before = f"{texts[name.id]} | " if name.id in texts and node not in block else ""
                texts[name.id] = before + text
    return texts


def _assignments(block: Sequence[ast.AST]) -> Iterator[ast.Assign]:
    """Those that are made when the statements are over: not a function's own, nor those before it ends."""
    for node in block if block and not isinstance(block[-1], ast.Return | ast.Raise) else ():
        if isinstance(node, ast.Assign):
            yield node
        elif not isinstance(node, ast.FunctionDef | ast.ClassDef):
            for _, field in ast.iter_fields(node):
                yield from _assignments(
                    [each for each in field if isinstance(each, ast.AST) and not isinstance(each, ast.expr)]
                    if isinstance(field, list) else []
                )  # fmt: skip


def _text(node: ast.AST, texts: Texts) -> str:
    """What an expression reads as; what is only known when it runs stands in braces."""
    match node:
        case ast.Constant(value=str(text)):
            return text
        case ast.JoinedStr(values=values):
            return "".join(_text(each, texts) for each in values)
        case ast.IfExp(body=body, orelse=orelse):
            return f"{_text(body, texts)} | {_text(orelse, texts)}"
        case ast.FormattedValue(value=value) | ast.Subscript(value=ast.JoinedStr() as value):
            return _text(value, texts)
        case ast.Name(id=name) if name in texts:
            return texts[name]
    return f"{{{ast.unparse(node)}}}"


def _name(call: ast.Call) -> str:
    return call.func.id if isinstance(call.func, ast.Name) else ""


if __name__ == "__main__":
    sys.path.insert(0, str(ROOT))
    GOLDEN.write_text(golden(), encoding="utf-8")
