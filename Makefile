# PLGS for Blender. `make demo` and `make test` set up what they need; README.md says the rest.
#
#   make demo [SCENE=folder] [OUT=folder] [PRESET=preview|standard|paper]
#   make extension
#   make test, make test-slow, make test-window, make test-blender-next, make lint, make clean
#
# TORCH_INDEX=<url> names an index of CPU builds of torch for the set-up, if pip does not know one already.

SCENE ?= sample/room
OUT ?= lifts/demo
PRESET ?= preview

PYTHON := .venv/bin/python
PYTEST := -m pytest --durations=5
# A test that takes longer than pyproject.toml's faulthandler_timeout hangs: none of `make test` takes a minute.
ENDING := -o faulthandler_exit_on_timeout=true
# The parts that mypy reads, if they exist.
TYPED := $(addprefix -p plgs.,$(wildcard engine plgs_blender operators ui)) $(if $(wildcard run_plgs.py),-m plgs.run_plgs)
# Tests of what runs in Blender's own Python. They run on the next Blender, too.
NEXT_TESTS := $(wildcard tests/scene tests/job tests/plgs_blender tests/operators tests/ui tests/test_register.py \
	tests/test_extension.py)

.PHONY: demo extension test test-slow test-window test-blender-next lint set-up set-up-next clean
.NOTPARALLEL:

# A demo that was stopped goes on where it was. A finished one is left as it is.
demo: set-up
	$(PYTHON) run_plgs.py $(SCENE) -o $(OUT) --preset $(PRESET) --resume

test: lint set-up-next
	$(PYTHON) $(PYTEST) $(ENDING) -m "not slow"
	@if [ -e .venv-next/complete ]; then set -x; .venv-next/bin/python $(PYTEST) $(ENDING) -m "not slow" $(NEXT_TESTS); fi

test-slow: set-up-next extension
	$(PYTHON) $(PYTEST)
	@if [ -e .venv-next/complete ]; then set -x; .venv-next/bin/python $(PYTEST) $(NEXT_TESTS); fi
	@$(PYTHON) set_up/blender_window.py trixie
	PLGS_WINDOW_TREE=build/blender-trixie $(PYTHON) $(PYTEST) tests/window

# The extension's zip, built and validated by Blender's own tool.
extension: set-up
	@$(PYTHON) set_up/extension.py build

# The zip in a real Blender's window, under a virtual screen, with real mouse and keys: in Debian's Blender 4.3, and in 5.2.
test-window: extension
	@$(PYTHON) set_up/blender_window.py trixie
	PLGS_WINDOW_TREE=build/blender-trixie $(PYTHON) $(PYTEST) $(ENDING) -m "not slow" tests/window

test-blender-next: extension
	@$(PYTHON) set_up/blender_window.py sid
	PLGS_WINDOW_TREE=build/blender-sid $(PYTHON) $(PYTEST) $(ENDING) -m "not slow" tests/window

# mypy sees the repository as the package plgs, the name under which relative imports between its parts resolve. research/
# runs from the repository alone and imports the engine by its own name, so mypy reads it in a second call.
lint: set-up
	@$(PYTHON) -m ruff check .
	@mkdir -p build/types && ln -sfn ../.. build/types/plgs
	@$(PYTHON) -m mypy $(TYPED)
	@$(PYTHON) -m mypy --follow-imports=silent -p research

set-up:
	@sh set_up/set_up.sh .venv

set-up-next: set-up
	@sh set_up/set_up.sh .venv-next

# Lifts stay: they are yours.
clean:
	rm -rf .venv .venv-next build .pytest_cache .mypy_cache .ruff_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
