#!/usr/bin/env bash
# Both towers once more on one GPU, from the weights of an earlier run in PACK (words.pt, space.pt, text.pt):
#   models/training/semantics/again.sh PACK SECONDS BACK
here=$(cd "$(dirname "$0")" && pwd)
export TORCH_CUDA_ARCH_LIST=9.0 PYTHONUNBUFFERED=1 OMP_NUM_THREADS=8 MAX_JOBS=16
mkdir -p /tmp/out /tmp/run && cp -r "$here/../geometry" "$here" /tmp/run/ && cd /tmp/run/semantics || exit 1
setsid python3 train_text.py --pack "$1" --out /tmp/out --seconds 0 --init "$1/text.pt" --space "$1/space.pt" --more "$2" --lr 1.2e-3 \
  >/tmp/out/text.log 2>&1 </dev/null &
python3 -c "import views; views.extension()" >/tmp/out/raycast.log 2>&1 || { cat /tmp/out/raycast.log; exit 1; }
setsid python3 -m torch.distributed.run --nproc-per-node 1 train_words.py --pack "$1" --out /tmp/out --seconds $(($2 - 60)) --lr 2e-4 \
  --init "$1/words.pt" --space "$1/space.pt" --back "$3" >/tmp/out/words.log 2>&1 </dev/null &
