#!/usr/bin/env bash
# Tests the archive of `make dist` in an empty root that has only its documented requirements: Debian's packages of
# glibc and libstdc++. Runs the documented commands: first token, health, the default job, a lab's files, and the demo.
#
#   tests/judges/dist.sh dist/sci-recon-VERSION-x86_64-linux.tar.gz
#
# The folder of the archive has its list of components, the Python client and SHA256SUMS, too.
# Needs root (chroot), apt-get, curl and jq. The last line of the output is JSON.
set -euo pipefail
archive=$(realpath "$1")
[ "$(id -u)" = 0 ] || { echo "chroot is for root" >&2; exit 2; }
folder=$(dirname "$archive")
(cd "$folder" && sha256sum --check --strict --quiet SHA256SUMS)
for file in "$archive" "${archive%.tar.gz}.cdx.json" "$folder"/*.whl; do
  grep -q " $(basename "$file")\$" "$folder/SHA256SUMS" || { echo "SHA256SUMS lacks $file" >&2; exit 1; }
done
components=$(jq '[select(.bomFormat == "CycloneDX") | .components[] | select(.name and .version and .purl)] | length' \
  "${archive%.tar.gz}.cdx.json")
[ "$components" -gt 100 ] || { echo "the list of components has $components" >&2; exit 1; }
root=$(mktemp -d)
server=
trap 'kill $server 2>/dev/null && wait $server; umount -q "$root/proc" || true; rm -rf "$root"' EXIT

mkdir -p "$root"/{debs,proc,tmp,dev,opt,lab}
(cd "$root/debs" && apt-get --quiet=2 --option APT::Sandbox::User=root download libc6 libgcc-s1 libstdc++6 && for deb in *.deb; do dpkg-deb --extract "$deb" "$root"; done)
rm -r "$root/debs"
mount -t proc proc "$root/proc"
mknod -m 666 "$root/dev/null" c 1 3
mknod -m 444 "$root/dev/urandom" c 1 9
tar --extract --gzip --file "$archive" --directory "$root/opt" --strip-components 1 --one-top-level=sci-recon
for file in docs/OPERATIONS.md docs/CLUSTER.md deploy/systemd/sci-recon.service deploy/kubernetes/worker.yaml deploy/prometheus/prometheus.yml; do
  [ -s "$root/opt/sci-recon/$file" ] || { echo "the archive has no $file" >&2; exit 1; }
done
chroot=$(command -v chroot)
run() { env -i RUST_LOG=warn "$chroot" "$root" /opt/sci-recon/bin/sci-recon "$@"; }

start=$(date +%s%N)
version=$(run --version)
token=$(run token --data /data create --lab optics --new)
env -i RUST_LOG=warn "$chroot" "$root" /opt/sci-recon/bin/sci-recon serve --data /data --listen 127.0.0.1:0 --workers 2 \
  > "$root/announced" 2> "$root/serve.log" &
server=$!
until [ -s "$root/announced" ] && run health --data /data > /dev/null 2>&1; do
  kill -0 $server || { cat "$root/serve.log" >&2; exit 1; }
  sleep 0.1
done
up=$(( ($(date +%s%N) - start) / 1000000 ))
api=$(jq -r .url "$root/announced")
ask() { curl -sS --fail-with-body -H "Authorization: Bearer $token" "$@"; }
[ "$(curl -sS -o /dev/null -w '%{http_code}' "$api/v1/jobs")" = 401 ] || { echo "it is open without a token" >&2; exit 1; }
ready=$(curl -sS --fail-with-body "$api/readyz" | jq -c '{ready, degraded}')
[ "$ready" = '{"ready":true,"degraded":false}' ] || { echo "readyz says $ready" >&2; exit 1; }

start=$(date +%s%N)
job=$(ask "$api/v1/samples" --json '{}' | jq -r .job.id)
while state=$(ask "$api/v1/jobs/$job" -H "Prefer: wait=20" | jq -r .state); [ "$state" = queued ] || [ "$state" = running ]; do :; done
took=$(( ($(date +%s%N) - start) / 1000000 ))
ask "$api/v1/jobs/$job/snapshots/0/exports/npy" > "$root/lab/frames.npy"
[ "$state" = succeeded ] || { ask "$api/v1/jobs/$job" >&2; exit 1; }

# A lab machine: submit, watch and download a simulated measurement with the commands of the same archive.
cp -R "$(dirname "$0")/../../demo/clip" "$root/lab/"
lab() { env -i RUST_LOG=warn SCI_RECON_URL="$api" SCI_RECON_TOKEN="$token" "$chroot" "$root" /opt/sci-recon/bin/sci-recon "$@"; }
lab simulate --frames /lab/clip --compression-ratio 8 --out /lab/sim > /dev/null
own=$(lab submit /lab/sim/measurement.npy --masks /lab/sim/masks.npy --algorithm gap-tv)
case $(lab watch "$own") in "$own: "*"; finished"*) ;; *) exit 1 ;; esac
lab fetch "$own" --out /lab/out --file frames.npy > /dev/null
fetched=$(find "$root/lab/out" -name frames.npy -size +0 | wc -l)
[ "$fetched" = 1 ] || { echo "$fetched results were fetched" >&2; exit 1; }
kill $server && wait $server
server=

# The demo of the README starts another service.
demo=$(run demo --out /lab/demo --json | jq '.pnp_tv_fastdvdnet.psnr_db')
jq --exit-status --null-input --argjson demo "$demo" '$demo > 25' > /dev/null || { echo "the demo has $demo dB" >&2; exit 1; }
[ -s "$root/lab/demo/report.html" ] || { echo "the demo has no page" >&2; exit 1; }
jq --compact-output --null-input --arg version "$version" --argjson start_ms $up --argjson job_ms $took \
  --argjson components "$components" --argjson archive_bytes "$(stat -c %s "$archive")" --argjson frames_bytes "$(stat -c %s "$root/lab/frames.npy")" \
  --argjson demo_db "$demo" '{target: "dist", ok: true, $version, $start_ms, $job_ms, $demo_db, $components, $archive_bytes, $frames_bytes}'
