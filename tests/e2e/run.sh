#!/usr/bin/env bash
# Drives the dashboard in a real browser. Skipped, with a message, where there is none.
set -euo pipefail
cd "$(dirname "$0")/../.."

missing=()
command -v node >/dev/null || missing+=(nodejs)
command -v npm >/dev/null || missing+=(npm)
CHROMIUM=${CHROMIUM:-$(command -v chromium || command -v chromium-browser || true)}
[ -n "$CHROMIUM" ] || missing+=(chromium)
if [ ${#missing[@]} -gt 0 ]; then
    echo "e2e: skipped, because there is no ${missing[*]} here (apt-get install ${missing[*]})"
    exit 0
fi
export CHROMIUM ORT_DYLIB_PATH=${ORT_DYLIB_PATH:-$PWD/runtime/libonnxruntime.so}

# With the test, so that it is the program that `make test` has built.
${CARGO:-cargo} test --no-run --quiet --test service
target=$(${CARGO:-cargo} metadata --format-version 1 --no-deps | node -p 'JSON.parse(require("fs").readFileSync(0)).target_directory')
(cd tests/e2e && npm ci --silent --no-audit --no-fund)
exec node tests/e2e/run.mjs "$target/debug/sci-recon"
