#!/usr/bin/env bash
# One long run on N GPUs as a daemon that outlives the calling command:
#   . models/training/geometry/setup_gpu.sh; models/training/geometry/launch.sh N SECONDS [OPTIONS of train.py]
# .pack holds what prepare.py wrote, and at will start.pt, captures/ and scenes/ for --init, --data, --scenes.
cd "$(dirname "$0")" || exit 1
python3 -c "import gsplat; from gsplat.cuda._backend import _C" >/tmp/gsplat.log 2>&1 &
python3 -c "import train; train.extension()" >/tmp/raycast.log 2>&1
wait
mkdir -p /tmp/run && cp -r ../../../.pack /tmp/pack && cp ./*.py ./*.cu ./*.h /tmp/run/ && cd /tmp/run || exit 1
setsid python3 -m torch.distributed.run --standalone --nproc-per-node "$1" train.py --pack /tmp/pack \
  --out /tmp/run/out --seconds "$2" "${@:3}" >/tmp/run/stdout 2>&1 </dev/null &
