"""Formats of exports, from the server's table: `UPDATE_DOCS=1 cargo test --test it formats` writes
it.

ply: Standard 3DGS PLY with `semantic_index` as an extra attribute and, after the vertices, the
    semantics where they are made.
compressed_ply: The compressed PLY of `PlayCanvas` and `SuperSplat`: 16 bytes a Gaussian.
spz: SPZ, version 3: under 16 bytes a Gaussian.
spz4: SPZ, version 4, which fewer programs read.
sog: SOG, the bundle of pictures of `PlayCanvas`, without harmonics over degree 0.
glb: Binary glTF with `KHR_gaussian_splatting`, the entries of the bank and the semantics.
splat: `.splat`: 32 bytes a Gaussian.
npz: The semantics as `NumPy` arrays: the bank, the row of each mask, the entry of each Gaussian and
    of each cell of the photos.
packed: The scene as the page draws it: 32 bytes a Gaussian, those that cover most first.
html: The page with the scene in it, as one file for a disk. It shows the texts of `text`, one a
    line, and needs no server.
sog_lod: Streamed SOG, the levels of detail of `PlayCanvas`, in a zip: `lod-meta.json` and SOG
    bundles by place and level, which a program loads as it looks at them.
colmap: A folder as COLMAP has it, in a zip: photos, cameras, points and depth maps.
nerfstudio: The same as nerfstudio has it.
coco: What each line of `text` selects in each photo as COCO's annotations, in a zip.
labelme: The same as a JSON with polygons for `LabelMe` beside each photo.
"""

from typing import Literal, TypeAlias

#: Formats of `export`.
ExportFormat: TypeAlias = Literal[
    "ply",
    "compressed_ply",
    "spz",
    "spz4",
    "sog",
    "glb",
    "splat",
    "npz",
    "packed",
    "html",
    "sog_lod",
    "colmap",
    "nerfstudio",
    "coco",
    "labelme",
]
#: Their endings, without the first dot.
ENDINGS: dict[ExportFormat, str] = {
    "ply": "ply",
    "compressed_ply": "compressed.ply",
    "spz": "spz",
    "spz4": "v4.spz",
    "sog": "sog",
    "glb": "glb",
    "splat": "splat",
    "npz": "npz",
    "packed": "segsplat",
    "html": "html",
    "sog_lod": "sog.zip",
    "colmap": "colmap.zip",
    "nerfstudio": "nerfstudio.zip",
    "coco": "coco.zip",
    "labelme": "labelme.zip",
}
#: Last parts of the names of files of Gaussians.
SPLATS = (
    ".glb",
    ".ply",
    ".sog",
    ".splat",
    ".spz",
)
