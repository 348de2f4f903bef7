from collections.abc import Iterator
from types import ModuleType

import bpy
import pytest


@pytest.fixture
def extension(plgs: ModuleType) -> Iterator[None]:
    """The extension in an empty file."""
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    plgs.register()
    yield
    plgs.unregister()
