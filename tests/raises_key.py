"""Errors that a user can mend, by their key: how they are worded is the business of test_error_texts alone."""

import re
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest


@contextmanager
def raises_key(told: str) -> Iterator[pytest.ExceptionInfo[Exception]]:
    """Assert that a PlgsError is raised, of the engine or of the extension's engine. ``told`` is its key, and then the
    names that its text must have, such as "no-frame 0003 poses.txt". "|" separates several keys, and "*" is any."""
    keys, *names = told.split()
    modules = [sys.modules[name] for name in ("engine.errors", "plgs.engine.errors") if name in sys.modules]
    with pytest.raises(tuple(module.PlgsError for module in modules)) as raised:
        yield raised
    assert keys == "*" or raised.value.key in keys.split("|"), f"{raised.value.key}: {raised.value}"
    assert [name for name in names if name not in str(raised.value)] == [], str(raised.value)


def worded(told: str) -> re.Pattern[str]:
    """What a command or the panel says of such an error, in any wording that its key has in errors.golden.txt."""
    key, *names = told.split()
    golden = Path(__file__).with_name("errors.golden.txt").read_text(encoding="utf-8")
    found = re.search(rf"^{key}\n((?:    .*\n)+)", golden, re.MULTILINE)
    assert found is not None, f"no error has the key {key}"
    told_by = [line.partition(": ")[2].removeprefix("WHERE ") for line in found[1].splitlines()]
    lines = [re.split(r": WHERE|\. ", text)[0] for text in told_by]
    parts = [re.split(r"\{(?:[^{}]|\{[^{}]*\})*\}", text) for line in lines for text in line.split(" | ")]
    wordings = "|".join(".*".join(map(re.escape, each)) for each in parts if any(each))
    return re.compile(rf"(?is)\A{''.join(f'(?=.*{re.escape(name)})' for name in names)}.*(?:{wordings})")
