#!/bin/sh
# Half an hour of one CUDA GPU, from the committed weights to better ones. The same command again continues an interrupted run.
#   training/run_gpu.sh DATA OUT [TOTAL_MINUTES] [MINUTES_OF_THIS_CALL]
# Leaves OUT/loop.pt (checkpoint), OUT/fastdvdnet-gray/*.onnx, their 8-bit twin in OUT/fastdvdnet-gray-int8 and OUT/evaluation-loop.json. PYTHON names the interpreter;
# NETWORK=ffdnet trains the small network instead, for which five minutes are much.
set -eu
data=$1 out=$2 total=${3:-28} now=${4:-$total}
here=$(cd "$(dirname "$0")" && pwd)
python=${PYTHON:-python3}
workers=$(($(nproc) > 4 ? ($(nproc) - 2) / 2 : 1))
case ${NETWORK:-fastdvdnet} in
    fastdvdnet) stage=loop name=fastdvdnet-gray ;;
    ffdnet) stage=ffdnet-loop name=ffdnet-gray ;;
    *) echo "NETWORK=$NETWORK: fastdvdnet or ffdnet" >&2; exit 2 ;;
esac
mkdir -p "$out"
"$python" "$here/train.py" --data "$data" --out "$out/$stage.pt" --stage "$stage" --init "$here/../models/$name" \
    --minutes "$total" --run-minutes "$now" --crop 96 --frames "${FRAMES:-256}" --lr 3e-4 --workers "$workers" --runs 24 --every 8 ${EXTRA:-}
"$python" "$here/export.py" "$out/$stage.pt" "$out/$name"
[ "$stage" != loop ] || "$python" "$here/quantize.py" --data "$data" "$out/$name" "$out/$name-int8"   # weights and twin go together
"$python" "$here/evaluate.py" --data "$data" "$here/../models/$name" "$out/$name" | tee "$out/evaluation-$stage.json"
