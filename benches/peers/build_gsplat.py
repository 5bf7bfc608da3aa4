"""Compiles gsplat's CUDA extension for forward passes of 3, 4 and 32 channels only (a fifth of the
compile time; 24 channels are padded to 32 by gsplat itself) and copies it to a folder.

    python build_gsplat.py SITE OUT

SITE holds the unpacked wheel of gsplat; it is changed in place. With OUT/gsplat_cuda.so there
already, that file is put where gsplat looks for it instead."""

import pathlib
import re
import shutil
import sys

site, out = (pathlib.Path(p).resolve() for p in sys.argv[1:3])
csrc = site / "gsplat" / "cuda"
for path in [*csrc.glob("csrc/*.cu"), *csrc.glob("csrc/*.cpp")]:
    text = path.read_text()
    kept = re.sub(
        r"^(\s*)(__INS__|__LAUNCH_KERNEL__)\((\d+)\)\s*$",
        lambda m: m[0] if m[3] in ("3", "4", "32") else "",
        text,
        flags=re.M,
    )
    if kept != text:
        path.write_text(kept)
built = out / "gsplat_cuda.so"
shim = site / "gsplat" / "csrc.py"
sys.path.insert(0, str(site))
if not built.exists():
    from torch.utils.cpp_extension import _get_build_directory

    folder = pathlib.Path(_get_build_directory("gsplat_cuda", verbose=False))
    from gsplat.cuda._backend import _C

    assert _C is not None, "gsplat found no CUDA toolkit"
    out.mkdir(parents=True, exist_ok=True)
    shutil.copy(folder / "gsplat_cuda.so", built)
# gsplat looks for a compiled gsplat.csrc before it compiles anything.
shim.write_text(
    f"""import importlib.util, sys
spec = importlib.util.spec_from_file_location("gsplat_cuda", {str(built)!r})
module = importlib.util.module_from_spec(spec)
spec.loader.exec_module(module)
sys.modules[__name__] = module
"""
)
print("gsplat extension:", built, built.stat().st_size)
