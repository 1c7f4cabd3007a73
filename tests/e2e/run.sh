#!/usr/bin/env bash
# Tests the dashboard in a real browser. Without one, the tests are skipped; with CI=true, they fail.
set -euo pipefail
cd "$(dirname "$0")/../.."

missing=()
command -v node >/dev/null || missing+=(nodejs)
command -v npm >/dev/null || missing+=(npm)
CHROMIUM=${CHROMIUM:-$(command -v chromium || command -v chromium-browser || true)}
[ -n "$CHROMIUM" ] || missing+=(chromium)
if [ ${#missing[@]} -gt 0 ]; then
    if [ "${CI:-}" = true ]; then
        echo "e2e: failed, because CI=true and ${missing[*]} is missing: apt-get install ${missing[*]}" >&2
        exit 1
    fi
    echo "e2e: skipped, because ${missing[*]} is missing: apt-get install ${missing[*]}"
    exit 0
fi
export CHROMIUM ORT_DYLIB_PATH=${ORT_DYLIB_PATH:-$PWD/runtime/libonnxruntime.so}

# Builds the test, which builds the same program as `make test`.
${CARGO:-cargo} test --no-run --quiet --test service
target=$(${CARGO:-cargo} metadata --format-version 1 --no-deps | node -p 'JSON.parse(require("fs").readFileSync(0)).target_directory')
(cd tests/e2e && npm ci --silent --no-audit --no-fund)
exec node tests/e2e/run.mjs "$target/debug/sci-recon"
