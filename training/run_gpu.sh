#!/bin/sh
# Half an hour of one CUDA GPU, from the committed weights to better ones. The same command again continues an interrupted run.
#   training/run_gpu.sh DATA OUT [TOTAL_MINUTES] [MINUTES_OF_THIS_CALL]
# Leaves OUT/loop.pt (checkpoint), OUT/fastdvdnet-gray/*.onnx and OUT/evaluation.json. PYTHON names the interpreter.
set -eu
data=$1 out=$2 total=${3:-28} now=${4:-$total}
here=$(cd "$(dirname "$0")" && pwd)
python=${PYTHON:-python3}
workers=$(($(nproc) > 4 ? ($(nproc) - 2) / 2 : 1))
mkdir -p "$out"
"$python" "$here/train.py" --data "$data" --out "$out/loop.pt" --stage loop --init "$here/../models/fastdvdnet-gray" \
    --minutes "$total" --run-minutes "$now" --crop 96 --frames "${FRAMES:-256}" --lr 3e-4 --workers "$workers" --runs 24 --every 8 ${EXTRA:-}
"$python" "$here/export.py" "$out/loop.pt" "$out/fastdvdnet-gray"
"$python" "$here/evaluate.py" --data "$data" "$here/../models/fastdvdnet-gray" "$out/fastdvdnet-gray" | tee "$out/evaluation.json"
