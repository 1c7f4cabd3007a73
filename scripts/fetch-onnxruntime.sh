#!/usr/bin/env bash
# Install libonnxruntime.so from the pinned PyPI wheel into runtime/ or another folder.
#
#   scripts/fetch-onnxruntime.sh [--gpu | --cuda] [FOLDER]
#
# --gpu installs the library with the WebGPU provider (any GPU), --cuda the one for NVIDIA's CUDA and cuDNN.
# pip checks the wheel's hash. A stamp file makes a second run a no-op.
set -euo pipefail
package=onnxruntime
version=1.31.1
case "${1:-}" in
  --gpu) package=onnxruntime_webgpu version=1.27.0; shift ;;
  --cuda) package=onnxruntime_gpu; shift ;;
esac
system=$(uname -sm)
case "$package $system" in
  "onnxruntime Linux x86_64")
    platform=manylinux_2_28_x86_64
    sha256=5752bd508126ae7c49894d3b9d2e83f0c3d487319246d04c444b393308d7ad7f ;;
  "onnxruntime Linux aarch64")
    platform=manylinux_2_28_aarch64
    sha256=da05378364c44d4407e463982d2bf8d5e4cfea873283757e48beeb41df97b7f3 ;;
  "onnxruntime_gpu Linux x86_64")
    platform=manylinux_2_28_x86_64
    sha256=e26c475fe361b2015f45b4b824bd13f0bb20204e59b62814e6f0acd5f3d491a6 ;;
  "onnxruntime_webgpu Linux x86_64")
    platform=manylinux_2_28_x86_64
    sha256=142eb8bdb803c58117bf64164d201f43180bc87229cac14b590aa4ea79e0f70b ;;
  *)
    echo "fetch-onnxruntime: no wheel of $package is pinned for $system;" \
         "put a libonnxruntime 1.24 or later into the folder runtime by hand" >&2
    exit 1 ;;
esac
folder=${1:-$(cd "$(dirname "$0")/.." && pwd)/runtime}
stamp=$folder/.$package-$version-$sha256
[ -e "$stamp" ] && exit 0

temporary=$(mktemp -d)
trap 'rm -rf "$temporary"' EXIT
echo "$package==$version --hash=sha256:$sha256" >"$temporary/requirements.txt"
python3 -m pip download --quiet --require-hashes --no-deps --only-binary=:all: \
  --python-version 3.11 --platform "$platform" \
  --dest "$temporary" --requirement "$temporary/requirements.txt"
mkdir -p "$folder"
python3 - "$temporary" "$folder" <<'PY'
import glob, os, re, shutil, sys, zipfile

source, folder = sys.argv[1:]
with zipfile.ZipFile(glob.glob(source + "/*.whl")[0]) as wheel:
    for name in wheel.namelist():
        base = os.path.basename(name)
        # The loader's file name has no version; the providers of the GPU wheel keep their names.
        if name.startswith("onnxruntime/capi/lib") and ".so" in base:
            target = re.sub(r"^(libonnxruntime\.so).*", r"\1", base)
            with wheel.open(name) as data, open(os.path.join(folder, target), "wb") as out:
                shutil.copyfileobj(data, out)
        if base in ("LICENSE", "ThirdPartyNotices.txt"):
            with wheel.open(name) as data, open(os.path.join(folder, "onnxruntime-" + base), "wb") as out:
                shutil.copyfileobj(data, out)
PY
[ -s "$folder/libonnxruntime.so" ] || { echo "fetch-onnxruntime: the wheel held no libonnxruntime" >&2; exit 1; }
rm -f "$folder"/.onnxruntime*
touch "$stamp"
echo "libonnxruntime $version is in $folder"
