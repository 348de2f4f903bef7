# PLGS for Blender. `make demo` and `make test` set up what they need; README.md says the rest.
#
#   make demo [SCENE=folder] [OUT=folder] [PRESET=draft|preview|standard|paper]
#   make extension
#   make test, make behaviours, make search [SEED=number] [PLGS_FUZZ=factor], make lint, make clean
#   make test-slow, make test-window, make test-blender-next, make test-failing-calls [PLGS_FAULTS=number]
#
# TORCH_INDEX=<url> names an index of CPU builds of torch for the set-up, if uv or pip is not configured for one.

SCENE ?= sample/room
OUT ?= lifts/demo
PRESET ?= preview

# Where it is set, each worker and each engine that a test starts would compile all modules anew: minutes of a core.
unexport PYTHONDONTWRITEBYTECODE

PYTHON := .venv/bin/python
PYTEST := -m pytest --durations=10
# One process of tests for each core, and memory for four at most.
PARALLEL := -n logical --maxprocesses=4 --dist=worksteal
# Two Blenders, each on a screen of its own and with test files of its own.
WINDOWS := -n 2 --dist=loadfile
# A test that takes longer than pyproject.toml's faulthandler_timeout hangs: on two cores none of `make test` takes two minutes.
ENDING := -o faulthandler_exit_on_timeout=true
# mypy sees the repository as the package plgs, the name under which relative imports between its parts resolve.
LINT := $(PYTHON) -m ruff check . && mkdir -p build/types && ln -sfn ../.. build/types/plgs && \
	$(PYTHON) -m mypy $(addprefix -p plgs.,engine plgs_blender operators ui) -m plgs.run_plgs -p research
# Tests of what runs in the next Blender's own Python, and those of them whose work Blender itself does.
NEXT_TESTS := tests/plgs_blender tests/operators tests/ui tests/test_register.py tests/test_extension.py tests/posed \
	tests/job/test_folder.py tests/job/test_events.py
NEXT_QUICK := $(addprefix tests/plgs_blender/test_,lift_scene.py passes.py cameras.py meshes.py splats.py \
	panoptic_group.py shots.py viewport.py) tests/plgs_blender/inspecting tests/ui tests/test_register.py \
	tests/test_extension.py $(addprefix tests/operators/test_,startup_file.py scene.py lift.py export.py passes.py)
# Which examples `make search` tries first, and how many times as many as `make test`.
SEED := $(or $(SEED),$(shell od -An -N3 -tu4 /dev/urandom | tr -d ' '))
PLGS_FUZZ ?= 25
# How many faults each command meets in `make test-failing-calls`.
PLGS_FAULTS ?= 30

.PHONY: demo extension test test-slow test-window test-blender-next test-failing-calls behaviours search lint set-up set-up-next clean
.NOTPARALLEL:

# A demo that was stopped goes on where it was. A finished one is left as it is.
demo: set-up
	$(PYTHON) run_plgs.py $(SCENE) -o $(OUT) --preset $(PRESET) --resume

# mypy and the making of .venv-next take one core beside the first tests, and are heard when those have ended.
test: set-up
	@mkdir -p build; { $(LINT) && sh set_up/set_up.sh .venv-next; } >build/beside-tests.log 2>&1 & \
	$(PYTHON) -m engine warm-up && $(PYTHON) $(PYTEST) $(ENDING) $(PARALLEL) -m "not slow"; tests=$$?; \
	wait $$! && beside=0 || beside=1; cat build/beside-tests.log; exit $$((tests + beside))
	@if [ -e .venv-next/complete ]; then set -x; .venv-next/bin/python $(PYTEST) $(ENDING) $(PARALLEL) -m "not slow" $(NEXT_QUICK); fi

# What users see, from end to end: the tests that tests/behaviours.py names.
behaviours: set-up
	$(PYTHON) $(PYTEST) $(ENDING) $(PARALLEL) $$($(PYTHON) tests/behaviours.py)

# Other examples than those of `make test`, each time.
search: set-up
	@PLGS_FUZZ=$(PLGS_FUZZ) $(PYTHON) $(PYTEST) $(PARALLEL) -m hypothesis --hypothesis-profile=search --hypothesis-seed=$(SEED) || \
	{ echo "To repeat it: make search SEED=$(SEED) PLGS_FUZZ=$(PLGS_FUZZ)"; exit 1; }

test-slow: set-up-next extension
	$(PYTHON) $(PYTEST) $(PARALLEL)
	@if [ -e .venv-next/complete ]; then set -x; .venv-next/bin/python $(PYTEST) $(PARALLEL) $(NEXT_TESTS); fi
	@$(PYTHON) set_up/blender_window.py trixie
	PLGS_WINDOW_TREE=build/blender-trixie $(PYTHON) $(PYTEST) tests/window

# Each command while one of its calls to the file system fails (docs/trust.md); 0 faults are all of them.
test-failing-calls: set-up
	PLGS_FAULTS=$(PLGS_FAULTS) $(PYTHON) $(PYTEST) -m slow tests/test_failing_calls.py

# The extension's zip, built and validated by Blender's own tool.
extension: set-up
	@$(PYTHON) set_up/extension.py build

# The zip in a real Blender's window, under a virtual screen, with real mouse and keys: in Debian's Blender 4.3, and in 5.2.
test-window: extension
	@$(PYTHON) set_up/blender_window.py trixie
	PLGS_WINDOW_TREE=build/blender-trixie $(PYTHON) $(PYTEST) $(ENDING) $(WINDOWS) -m "not slow" tests/window

test-blender-next: extension
	@$(PYTHON) set_up/blender_window.py sid
	PLGS_WINDOW_TREE=build/blender-sid $(PYTHON) $(PYTEST) $(ENDING) $(WINDOWS) -m "not slow" tests/window

lint: set-up
	@$(LINT)

set-up:
	@sh set_up/set_up.sh .venv

set-up-next: set-up
	@sh set_up/set_up.sh .venv-next

# Lifts stay: they are yours.
clean:
	rm -rf .venv .venv-next build .pytest_cache .mypy_cache .ruff_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
