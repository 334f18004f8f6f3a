"""Choices that the library and the recipes share; like all settings, they need no PyTorch."""

from __future__ import annotations

from typing import Literal

Padding = Literal["same", "constant"]
"""Padding before an episode's first step: its first observation ("same") or zeros ("constant")."""

ImageLayout = Literal["auto", "HWC", "CHW"]
"""Where a task's images have their channels; "auto" infers it from their shape."""

VectorizationMode = Literal["sync", "async"]
"""Whether copies of a task are stepped one after the other, or in parallel in processes."""
Gaps = Literal["error", "cut"]
"""Where a next observation is not that of the next row: an error, or the episode ends."""
