"""Settings by the name of their observation."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from torchrl_tit.settings.frames import FrameSettings


class PerKey(Mapping[str, FrameSettings]):
    """Frame encoders by the name of the observation that they read, in any order.

    The mapping is immutable and hashable, like recipes.

    Args:
        frames: the frame encoders by name.

    Raises:
        ValueError: if a value is not a frame encoder's settings.

    Example:
        >>> from torchrl_tit.settings import Inner
        >>> PerKey({"image": Inner(patch_size=7)})["image"].patch_size
        7
        >>> PerKey({}) == {}, len({PerKey({}), PerKey({})})
        (True, 1)
    """

    def __init__(self, frames: Mapping[str, FrameSettings]) -> None:
        if not isinstance(frames, Mapping):
            raise ValueError(f"frames are settings by the name of an observation, not {frames!r}")
        for name, frame in frames.items():
            if not isinstance(name, str) or not isinstance(frame, FrameSettings):
                raise ValueError(
                    f"frames[{name!r}] must be the settings of a frame encoder, such as "
                    f"torchrl_tit.settings.Inner(), not {frame!r}"
                )
        self._frames = dict(frames)

    def __getitem__(self, name: str) -> FrameSettings:
        return self._frames[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._frames)

    def __len__(self) -> int:
        return len(self._frames)

    def __hash__(self) -> int:
        return hash(frozenset(self._frames.items()))

    def __repr__(self) -> str:
        return repr(self._frames)
