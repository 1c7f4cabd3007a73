#!/usr/bin/env bash
# Checks the contract with linters and client generators: none may warn. Needs node, npm and Python 3.
#
#   tests/judges/clients/run.sh FOLDER     FOLDER keeps the tools for the next run, and the clients in FOLDER/generated
set -euo pipefail
here=$(cd "$(dirname "$0")" && pwd)
contract=$here/../../../openapi.yaml
mkdir -p "$1"
tools=$(cd "$1" && pwd)
cp "$here/package.json" "$tools/"
(cd "$tools" && npm install --silent --no-audit --no-fund >npm.log 2>&1) || { cat "$tools/npm.log" >&2; exit 1; }
[ -x "$tools/python/bin/python" ] || python3 -m venv "$tools/python"
"$tools/python/bin/python" -m pip install --quiet --requirement "$here/requirements.txt"
export PATH=$tools/node_modules/.bin:$tools/python/bin:$PATH
# Below the tools, where the scripts find their modules.
out=$tools/generated
rm -rf "$out" && mkdir "$out"

redocly lint --config "$here/redocly.yaml" --format summary "$contract" 2>&1 | tee "$out/redocly.log"
if grep -q 'You have' "$out/redocly.log"; then exit 1; fi
spectral lint --fail-severity warn --ruleset "$here/spectral.yaml" "$contract"
# A field with a default may be left out.
openapi-typescript --default-non-nullable false "$contract" --output "$out/api.d.ts" 2>&1 | tee "$out/typescript.log"
if grep -qi warn "$out/typescript.log"; then exit 1; fi
cp "$here"/round_trip.* "$out/"
(cd "$out" && tsc --strict --module nodenext --target es2022 --types node round_trip.mts api.d.ts)
openapi-python-client generate --path "$contract" --config "$here/openapi-python-client.yaml" \
  --output-path "$out/client" --fail-on-warning
python -m compileall -q "$out/client"
echo '{"clients": "generated without a warning", "linters": "no warning"}'
