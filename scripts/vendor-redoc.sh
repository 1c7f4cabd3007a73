#!/usr/bin/env bash
# Fetch the renderer of the API reference from npm into src/http/reference/.
#
#   scripts/vendor-redoc.sh
#
# The script is compressed. It differs from the published one in one address: the image of a content delivery network is
# replaced by an empty image, because pages of the service load nothing from elsewhere.
set -euo pipefail
version=2.5.4
integrity=sha512-M6jWhG1qoBnH6TFmzJnstyCZ87HmOY/UzDm78mHiYihEdlV/YcS9ogOo1NlElnJMeLsyxHFe2yFc4sNjHTrABQ==
folder=$(cd "$(dirname "$0")/.." && pwd)/src/http/reference
temporary=$(mktemp -d)
trap 'rm -r "$temporary"' EXIT
cd "$temporary"

npm pack --silent "redoc@$version" >/dev/null
actual=sha512-$(openssl dgst -sha512 -binary "redoc-$version.tgz" | base64 -w0)
[ "$actual" = "$integrity" ] || { echo "redoc-$version.tgz has the hash $actual, not $integrity" >&2; exit 1; }
tar -xzf "redoc-$version.tgz"

image=https://cdn.redoc.ly/redoc/logo-mini.svg
empty="data:image/svg+xml,%3Csvg xmlns='http://www.w3.org/2000/svg'/%3E"
grep -q "\"$image\"" package/bundles/redoc.standalone.js || { echo "$image is not in the script" >&2; exit 1; }
sed "s|\"$image\"|\"$empty\"|" package/bundles/redoc.standalone.js | gzip -9 --no-name >"$folder/redoc.js.gz"
{
  echo "redoc.js is the standalone script of Redoc $version (https://github.com/Redocly/redoc), without an image from a content delivery network."
  echo
  cat package/LICENSE
  echo
  echo "Parts of the script:"
  echo
  cat package/bundles/redoc.standalone.js.LICENSE.txt package/bundles/*.worker.js.LICENSE.txt
} >"$folder/LICENSE.txt"
