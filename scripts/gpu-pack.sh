#!/usr/bin/env bash
# Pack what scripts/gpu-check.sh needs into two archives of at most 30 MB, for a machine with a GPU and no network.
#
#   scripts/gpu-pack.sh PROGRAM LIBRARY [FOLDER]
#
# PROGRAM is a build with `cargo build --release --features gpu`, LIBRARY the libonnxruntime.so of `scripts/fetch-onnxruntime.sh --gpu`. FOLDER (default
# gpu-check) receives program.tar.xz and library.tar. On that machine, extract both into one folder with
# `python3 -m tarfile -e ARCHIVE FOLDER`, and run FOLDER/gpu-check.sh.
set -euo pipefail
program=${1:?the release build of sci-recon} library=${2:?the libonnxruntime.so with WebGPU} folder=${3:-gpu-check}
if "$program" devices --kernels 16 2>&1 | grep -q -e '--features gpu'; then
  echo "gpu-pack: $program has no kernels for a GPU: build it with --features gpu" >&2
  exit 1
fi
limit=30000000
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
mkdir -p "$folder" "$work/vulkan"
# The networks are part of the program.
strip -o "$work/sci-recon" "$program"
cp "$(dirname "$0")/gpu-check.sh" "$work/"
loader=$(ldconfig -p | awk '/libvulkan\.so\.1 .*x86-64/ { print $NF; exit }')
[ -n "$loader" ] || { echo "gpu-pack: the Vulkan loader is missing: apt-get install libvulkan1" >&2; exit 1; }
cp -L "$loader" "$work/vulkan/libvulkan.so.1"
tar -C "$work" -cf - sci-recon gpu-check.sh vulkan | xz -9 >"$folder/program.tar.xz"
xz -9 -c "$library" >"$work/libonnxruntime.so.xz"
tar -C "$work" -cf "$folder/library.tar" libonnxruntime.so.xz
for archive in "$folder/program.tar.xz" "$folder/library.tar"; do
  size=$(stat -c %s "$archive")
  echo "$archive: $size bytes"
  [ "$size" -le "$limit" ] || { echo "gpu-pack: $archive exceeds $limit bytes" >&2; exit 1; }
done
