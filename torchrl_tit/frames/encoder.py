"""The contract of frame encoders."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

from torch import Tensor, nn

from torchrl_tit.frames.observation import Kind, check_observation_shape
from torchrl_tit.layers.attention import attention_maps


class FrameEncoder(nn.Module):
    """Maps one observation to tokens, in the same way at every step.

    A frame's tokens depend on that frame alone. So while acting, and in training on consecutive
    steps, each frame is encoded once, however many histories contain it.

    A subclass is built as ``Encoder(settings, observation_shape)``, calls ``super().__init__`` with
    the shapes of its input and output, and implements ``forward``. An encoder that reads categories
    lists "categories" in ``kinds``, and gets the number of values of each entry as the keyword
    argument ``categories``.

    Args:
        observation_shape: (D,) for arrays and categories, (H, W) or (C, H, W) for images.
        num_tokens: number L of tokens per observation.
        width: width D of a token.

    Raises:
        ValueError: if the observation is neither an array nor an image.

    Example:
        >>> import torch
        >>> class Scaled(FrameEncoder):
        ...     kinds = ("array",)
        ...
        ...     def __init__(self, settings, observation_shape):
        ...         super().__init__(observation_shape, num_tokens=1, width=observation_shape[0])
        ...         self.scale = nn.Parameter(torch.ones(self.width))
        ...
        ...     def forward(self, observation):
        ...         return (self.scale * observation).unsqueeze(-2)
        >>> Scaled(None, (4,))(torch.zeros(8, 3, 4)).shape
        torch.Size([8, 3, 1, 4])
    """

    kinds: ClassVar[tuple[Kind, ...]] = ("array", "image")
    """Kinds of observations that it reads: any of "array", "image" and "categories"."""
    reads_entities: bool = False
    """Whether an observation is a set: rows of entities, and of padding, as their last entry says
    (:class:`~torchrl_tit.frames.entities.EntityTransformer`)."""
    num_tokens: int
    """Number L of tokens per observation."""
    width: int
    """Width D of a token."""

    def __init__(self, observation_shape: Sequence[int], *, num_tokens: int, width: int) -> None:
        super().__init__()
        self.observation_shape = check_observation_shape(observation_shape)
        self.num_tokens = num_tokens
        self.width = width

    def forward(self, observation: Tensor) -> Tensor:
        """Encodes observations.

        Args:
            observation: [..., *observation_shape], float, or uint8, which is scaled to 0..1; for
                categories, integers [..., D] from 0 to the number of values - 1.

        Returns:
            float [..., L, D].
        """
        raise NotImplementedError(
            "there is no forward, which maps [..., *observation_shape] to tokens [..., L, D]"
        )

    def clean(self, observation: Tensor) -> Tensor:
        """Replaces what is never read, such as the numbers in padding, by zeros.

        Args:
            observation: as in ``forward``.

        Returns:
            Observations of the same shape.
        """
        return observation

    def samples(self, observations: Tensor) -> Tensor:
        """Returns what statistics are computed of: by default the observations themselves.

        Args:
            observations: [N, *observation_shape].

        Returns:
            [M, *sample]; for sets, the rows of all entities.
        """
        return observations

    def attention_maps(self, observation: Tensor) -> list[Tensor]:
        """Returns the attention weights of each attention layer of this library in it.

        Args:
            observation: as in ``forward``.

        Returns:
            float [..., heads, S, S] of each layer, in the order of their calls. For an inner
            transformer S = 1 + patches: position 0 is the class token, patches follow row by row.
        """
        leading = observation.shape[: observation.ndim - len(self.observation_shape)]
        maps = attention_maps(self, observation)
        return [weights.reshape(*leading, *weights.shape[-3:]) for weights in maps]
