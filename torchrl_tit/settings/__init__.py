"""Settings: dataclasses with checks that import neither torch nor the modules they build.

Listing recipes only needs names, defaults and docstrings, so settings are kept apart from modules.
Each part names its implementation, which is imported when the part is built
(:meth:`~torchrl_tit.settings.parts.Part.build`).
"""

from torchrl_tit.settings import encoders
from torchrl_tit.settings.encoders import *  # noqa: F403
from torchrl_tit.settings.imports import resolve
from torchrl_tit.settings.networks import NETWORKS, Head, Network
from torchrl_tit.settings.parts import Part

__all__ = [*encoders.__all__, "NETWORKS", "Head", "Network", "Part", "resolve"]
