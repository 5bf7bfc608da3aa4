#!/usr/bin/env bash
# Sets up a bare GPU machine (wheels in .whl, data in .pack) and leaves PYTHONPATH right.
# Source it from the repository root: . models/training/geometry/setup_gpu.sh
python3 -m pip install -q --no-index --no-deps --no-compile --no-cache-dir --upgrade --target /tmp/site .whl/*.whl
export PYTHONPATH=/tmp/site:$PWD/models/training/geometry PATH=$PATH:/tmp/site/bin TORCH_CUDA_ARCH_LIST=9.0
export PYTHONUNBUFFERED=1 OMP_NUM_THREADS=4 MAX_JOBS=32 NCCL_NVLS_ENABLE=0
