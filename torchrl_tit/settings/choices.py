"""Choices that the library and the recipes share; like all settings, they need no PyTorch."""

from __future__ import annotations

from typing import Annotated, Literal

from msgspec import Meta

Padding = Literal["same", "constant"]
"""Padding before an episode's first step: its first observation ("same") or zeros ("constant")."""

ImageLayout = Literal["auto", "HWC", "CHW"]
"""Where a task's images have their channels; "auto" infers it from their shape."""

VectorizationMode = Literal["sync", "async"]
"""Whether copies of a task are stepped one after the other, or in parallel in processes."""
Device = Annotated[
    str,
    Meta(
        pattern=r"^[a-z]+(:[0-9]+)?$",
        description="auto or a device of PyTorch, such as cpu, cuda:1 or mps",
    ),
]
"""A device by name; "auto" is the GPU if there is one."""
Gaps = Literal["error", "cut"]
"""Where a next observation is not that of the next row: an error, or the episode ends."""
