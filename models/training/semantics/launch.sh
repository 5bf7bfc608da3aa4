#!/usr/bin/env bash
# The three trainings side by side on four GPUs, as daemons that outlive the calling command:
#   models/training/semantics/launch.sh PACK SECONDS
# masks on two GPUs, the image tower on two, the text tower beside it on the last; all into /tmp/out.
here=$(cd "$(dirname "$0")" && pwd)
export TORCH_CUDA_ARCH_LIST=9.0 PYTHONUNBUFFERED=1 OMP_NUM_THREADS=8 MAX_JOBS=32 NCCL_NVLS_ENABLE=0
mkdir -p /tmp/out /tmp/run && cp -r "$here/../geometry" "$here" /tmp/run/ && cd /tmp/run/semantics || exit 1
python3 -c "import views; views.extension()" >/tmp/out/raycast.log 2>&1 || { cat /tmp/out/raycast.log; exit 1; }
start() { # GPUS PROCESSES PORT NAME ARGS
  CUDA_VISIBLE_DEVICES=$1 setsid python3 -m torch.distributed.run --master-port "$3" --nproc-per-node "$2" "train_$4.py" \
    --pack "$PACK" --out /tmp/out "${@:5}" >"/tmp/out/$4.log" 2>&1 </dev/null &
}
PACK=$1
start 0,1 2 29601 masks --seconds "$2" --look "$PACK/look"
start 2,3 2 29602 words --seconds $(($2 - 75))
CUDA_VISIBLE_DEVICES=3 setsid python3 train_text.py --pack "$PACK" --out /tmp/out --seconds 150 --space /tmp/out/space.pt --more 55 \
  >/tmp/out/text.log 2>&1 </dev/null &
