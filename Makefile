# What a newcomer runs: `make demo` and `make test`. Both begin with `make setup`, which needs Python 3.11 and the package
# registries, and says which system libraries are missing (as root it installs them).

PYTHON := $(shell for python in python3.11 python3 python; do \
	$$python -c 'import sys; sys.exit(sys.version_info[:2] != (3, 11))' 2>/dev/null && echo $$python && break; done)
PYTHON_BPY52 := $(shell for python in python3.13 $(PYENV_ROOT)/versions/3.13*/bin/python; do \
	$$python -c 'import sys; sys.exit(sys.version_info[:2] != (3, 13))' 2>/dev/null && echo $$python && break; done)
RUN := .venv/bin/python
TORCH ?= any

.PHONY: setup demo test test-gui manual kernels lint extension fetch lock venv52 clean

## .venv: Blender 4.5 LTS as a Python module, the engine's packages and the test tools, from wheels/lock.toml
setup:
ifeq ($(PYTHON),)
	$(error CT2Hair needs Python 3.11, as Blender 4.5 does, and found none as python3.11 or python3)
endif
	@$(PYTHON) wheels/environment.py --folder .venv --torch $(TORCH)

## out/demo/: a hairstyle made into a scan, reconstructed through the extension: .blend, .abc, .usda, render.png, report.html
demo: setup
	$(RUN) tests/demo.py out/demo

## all tests, a file at a time on each of up to four cores
test: setup
	$(RUN) -m pytest -n auto --maxprocesses 4 --dist loadfile

## the extension in a real window under Xvfb (Debian sid's Blender in out/gui/debian; root and debootstrap); pictures in out/gui
test-gui: setup
	CT2HAIR_GUI=1 $(RUN) -m pytest tests/gui -s

## docs/settings.md, anew from ct2hair_addon/settings.py
manual: setup
	$(RUN) docs/settings_table.py

## ct2hair_addon/kernels.txt, anew from what each command compiles: after a kernel came, went, or changed its arguments
kernels: setup
	$(RUN) tests/kernels_list.py

## the style, the layers of the house (import-linter), and Blender's own validation of the manifest
lint: setup
	$(RUN) -m ruff check .
	$(RUN) -m ruff format --check .
	$(RUN) tests/packaging/layers.py
	$(RUN) wheels/extension.py --validate

## dist/ct2hair-VERSION-PLATFORM.zip; for others: make extension OPTIONS="--platform all --python 3.11 --python 3.13"
extension: setup
	$(RUN) wheels/extension.py $(OPTIONS)

## the wheels of the zip alone: make fetch OPTIONS="--platform windows-x64 --python 3.13"
fetch: setup
	$(RUN) wheels/fetch.py $(OPTIONS)

## wheels/lock.toml and the manifest's wheels, anew from wheels/pins.toml
lock:
	$(PYTHON) wheels/lock.py

## .venv52: the same for Blender 5.2 LTS, where a Python 3.13 is on the machine; `make test` then uses it
venv52:
ifeq ($(PYTHON_BPY52),)
	$(error Blender 5.2 needs Python 3.13, and none was found as python3.13 or under PYENV_ROOT)
endif
	@$(PYTHON_BPY52) wheels/environment.py --folder .venv52 --torch $(TORCH)

clean:
	rm -rf .venv .venv52 out dist wheels/*.whl .hypothesis .pytest_cache .ruff_cache
	find . -name __pycache__ -prune -exec rm -rf {} +
