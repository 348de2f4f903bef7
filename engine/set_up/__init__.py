"""Make the engine's own Python environment. Standard library only: any Python that PLGS supports can run it."""

from __future__ import annotations

from .adding import Addition
from .environments import remove_environments
from .steps import SetUp, SetUpRequest
