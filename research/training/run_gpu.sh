#!/bin/sh
# Improves the committed weights in a quarter of an hour on one CUDA GPU. The same command continues an interrupted run.
#   research/training/run_gpu.sh DATA OUT [TOTAL_MINUTES] [MINUTES_OF_THIS_CALL]
# Writes OUT/loop.pt (checkpoint) and OUT/fastdvdnet-gray/*.onnx, a third of its size, from which training can also
# continue. The next steps need no GPU: quantize.py, evaluate.py. PYTHON names the interpreter. NETWORK=ffdnet trains the
# small network, for which five minutes are enough.
set -eu
data=$1 out=$2 total=${3:-12} now=${4:-$total}
here=$(cd "$(dirname "$0")" && pwd)
python=${PYTHON:-python3}
workers=$(($(nproc) > 4 ? ($(nproc) - 2) / 2 : 1))
case ${NETWORK:-fastdvdnet} in
    fastdvdnet) stage=loop name=fastdvdnet-gray ;;
    ffdnet) stage=ffdnet-loop name=ffdnet-gray ;;
    *) echo "NETWORK=$NETWORK: fastdvdnet or ffdnet" >&2; exit 2 ;;
esac
mkdir -p "$out"
"$python" "$here/train.py" --data "$data" --out "$out/$stage.pt" --stage "$stage" --init "$here/../../models/$name" \
    --minutes "$total" --run-minutes "$now" --crop 96 --frames "${FRAMES:-128}" --lr "${LR:-8e-4}" --workers "$workers" --runs 24 --every 0 ${EXTRA:-}
"$python" "$here/export.py" "$out/$stage.pt" "$out/$name"
