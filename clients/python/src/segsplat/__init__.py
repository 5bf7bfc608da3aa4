"""Client of SegSplat Server: photos in, views, depth and text masks out.

>>> import segsplat
>>> with segsplat.local() as client:    # or segsplat.Client(), of a server that runs
...     client.scene("photos/").view(from_=0, to=1, t=0.5).save("view.png")

Frames and units: the world is that of the uploaded cameras, in their units, or of those that the
server found, in its own. Cameras are OpenCV: x
right, y down, z forward. Arrays are [height, width]. The centre of the first pixel is (0.5, 0.5).
"""

from ._version import __version__
from .client import AsyncClient, AsyncScene, Client, Scene
from .errors import *  # noqa: F403
from .errors import __all__ as _errors
from .gaussians import Gaussians
from .server import AsyncLocalClient, LocalClient, local, local_async
from .types import (
    Box,
    Camera,
    Doubt,
    Event,
    Ground,
    Growth,
    KnownWord,
    Label,
    Match,
    Matches,
    Measured,
    Models,
    Photo,
    Picked,
    Refinement,
    Report,
    Scale,
    SceneStatus,
    Scoring,
    Semantics,
    Viewpoint,
)
from .view import View

__all__ = [
    "AsyncClient",
    "AsyncLocalClient",
    "AsyncScene",
    "Box",
    "Camera",
    "Client",
    "Doubt",
    "Event",
    "Gaussians",
    "Ground",
    "Growth",
    "KnownWord",
    "Label",
    "LocalClient",
    "Match",
    "Matches",
    "Measured",
    "Models",
    "Photo",
    "Picked",
    "Refinement",
    "Report",
    "Scale",
    "Scene",
    "SceneStatus",
    "Scoring",
    "Semantics",
    "View",
    "Viewpoint",
    "__version__",
    "local",
    "local_async",
]
__all__ += _errors
