# The two commands that matter: `make demo` and `make test`. Both fetch what they need.

CARGO ?= cargo
PYTHON ?= python3
JUDGES := .venv/judges

.PHONY: demo test e2e runtime judges fmt lint docs serve clean

demo: runtime ## reconstruct a real clip through the real HTTP service
	$(CARGO) run --release --quiet -- demo

test: runtime judges ## all tests
	SCI_RECON_JUDGES=$(abspath $(JUDGES))/bin/python $(CARGO) test --release

e2e: runtime ## the dashboard in a real browser; ends with one line of JSON
	@tests/e2e/run.sh

serve: runtime ## the service on 127.0.0.1:8080, data in ./data
	$(CARGO) run --release --quiet -- serve --data data

runtime: ## libonnxruntime into ./runtime, from its pinned PyPI wheel
	@scripts/fetch-onnxruntime.sh

judges: $(JUDGES)/.stamp ## third-party readers that the tests use
$(JUDGES)/.stamp: tests/judges/requirements.txt
	$(PYTHON) -m venv $(JUDGES)
	$(JUDGES)/bin/python -m pip install --quiet --requirement $<
	touch $@

fmt:
	$(CARGO) fmt --check

lint:
	$(CARGO) clippy --release --all-targets -- -D warnings

docs:
	RUSTDOCFLAGS="-D warnings" $(CARGO) doc --release --no-deps --document-private-items

clean:
	$(CARGO) clean
	rm -rf runtime .venv demo-output e2e-output tests/e2e/node_modules
