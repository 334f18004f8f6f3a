"""Normalizes observations by their mean and standard deviation for a frame encoder."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from torchrl_tit.frames.encoder import FrameEncoder
from torchrl_tit.layers.images import bytes_to_floats
from torchrl_tit.layers.standardize import standardize

_IMAGES = 256
"""Images converted to floats at a time; floats take four times the memory of bytes."""


class NormalizedFrames(FrameEncoder):
    """A frame encoder that reads observations normalized by their mean and standard deviation.

    The statistics are running ones (:meth:`update`), or those of a data set
    (:meth:`set_statistics`). Until then, observations are read as they are. Each entry of an array
    and each pixel of an image, whose bytes are first scaled to 0..1, has its own mean and standard
    deviation, as in `VecNormalize` of Stable-Baselines3 and as in random network distillation
    (arXiv 1810.12894). Otherwise a network first sees what all images have in common. The entities
    of a set share their statistics: padding does not count, and the mask is not normalized. Results
    beyond +-``limit`` are clipped.

    The statistics are buffers of the network, so checkpoints, evaluation, copies and exports have
    them, and a frame's tokens stay the same while a batch is collected. TorchRL's `VecNormV2` is a
    transform of the environment: its statistics change with each step, so a history would hold
    frames of several scales, and without that environment, a network would read observations of an
    unknown scale.

    Args:
        encoder: the frame encoder.
        limit: bound to which normalized entries are clipped; infinite for none.
        eps: is added to the standard deviation; None adds 1e-8 to the variance, as `VecNormalize`
            does. It decides how entries are read that never changed so far.

    Example:
        >>> from torchrl_tit import settings
        >>> frames = NormalizedFrames(settings.Linear().build((4,)))
        >>> frames.update(torch.randn(64, 4) * 100)
        >>> frames(torch.randn(2, 8, 4)).shape
        torch.Size([2, 8, 1, 32])
    """

    count: Tensor
    mean: Tensor
    variance: Tensor

    def __init__(
        self, encoder: FrameEncoder, limit: float = 10.0, *, eps: float | None = None
    ) -> None:
        super().__init__(
            encoder.observation_shape, num_tokens=encoder.num_tokens, width=encoder.width
        )
        self.encoder = encoder
        self.limit = limit
        self.eps = eps
        shape = encoder.observation_shape
        self.reads_entities = encoder.reads_entities
        self.is_image = len(shape) > 1 and not self.reads_entities
        shape = shape if self.is_image else shape[-1:]
        self.register_buffer("count", torch.zeros(()))
        self.register_buffer("mean", torch.zeros(shape))
        self.register_buffer("variance", torch.ones(shape))

    @torch.no_grad()
    def set_statistics(self, mean: Tensor, std: Tensor, count: int) -> None:
        """Replaces the statistics by those of a data set's samples.

        Args:
            mean: float [*sample].
            std: population standard deviation, float [*sample].
            count: number of samples, which says how much they weigh in later updates.
        """
        self.mean.copy_(mean)
        self.variance.copy_(std.square())
        self.count.fill_(count)
        self._keep_mask()

    @torch.no_grad()
    def update(self, observations: Tensor) -> None:
        """Adds observations to the statistics, float or uint8 [N, *observation_shape].

        Networks that a TorchRL loss stacked or copied do not notice: see :func:`share_statistics`.
        """
        for part in observations.split(_IMAGES) if self.is_image else [observations]:
            self._add(bytes_to_floats(self.samples(part), self.mean.dtype))
        self._keep_mask()

    @torch.no_grad()
    def fix_constant(self) -> None:
        """Lets entries that never changed have a deviation of 1, once nothing is added anymore.

        Otherwise they are clipped to +-``limit`` as soon as they change.
        """
        rounding = (1e-6 * self.mean).square()
        self.variance.masked_fill_(self.variance <= rounding, 1.0)

    def _add(self, observations: Tensor) -> None:
        if not (size := observations.shape[0]):  # sets without entities
            return
        total = self.count + size
        shift = observations.mean(0) - self.mean
        variance = observations.var(0, unbiased=False)
        squares = self.variance * self.count + variance * size
        self.variance.copy_((squares + shift.square() * self.count * size / total) / total)
        self.mean.add_(shift * size / total)
        self.count.copy_(total)

    def _keep_mask(self) -> None:
        """Leaves the masks of entities as they are: 0, or 1 up to ``eps``."""
        if self.reads_entities:
            self.mean[-1], self.variance[-1] = 0, 1

    def clean(self, observation: Tensor) -> Tensor:
        """See :meth:`FrameEncoder.clean`."""
        return self.encoder.clean(observation)

    def samples(self, observations: Tensor) -> Tensor:
        """See :meth:`FrameEncoder.samples`."""
        return self.encoder.samples(observations)

    def normalize(self, observation: Tensor) -> Tensor:
        """Normalizes observations, float or uint8 [..., *observation_shape] -> float."""
        floats = bytes_to_floats(self.clean(observation), self.mean.dtype)
        root, eps = (1e-8, 0.0) if self.eps is None else (0.0, self.eps)
        normal = standardize(floats, self.mean, (self.variance + root).sqrt(), eps)
        return normal.clamp(-self.limit, self.limit)

    def forward(self, observation: Tensor) -> Tensor:
        """See :meth:`FrameEncoder.forward`."""
        return self.encoder(self.normalize(observation))


@torch.no_grad()
def share_statistics(frames: NormalizedFrames, loss: nn.Module) -> None:
    """Copies statistics to all networks of a TorchRL loss that normalize observations.

    A loss stacks the buffers of its critics and copies those of its targets, and a soft update
    moves weights only.

    Args:
        frames: the encoder whose statistics have changed, such as that of the policy.
        loss: a loss on networks that read the same observation.

    Example:
        >>> from tensordict.nn import TensorDictModule, TensorDictSequential
        >>> from torchrl.modules import QValueActor
        >>> from torchrl.objectives import DQNLoss
        >>> from torchrl_tit import Backbone, EnhancedTIT
        >>> tit = EnhancedTIT((4,), num_frames=2)
        >>> frames = tit.frame_encoders["observation"] = NormalizedFrames(tit.frames[0])
        >>> head = QValueActor(nn.Linear(64, 2), in_keys=["features"], action_space="categorical")
        >>> loss = DQNLoss(TensorDictSequential(Backbone(tit), head), action_space="categorical")
        >>> frames.update(torch.randn(100, 4) + 5)
        >>> share_statistics(frames, loss)
        >>> [value.mean().round().item() for name, value in loss.named_buffers() if "mean" in name]
        [5.0, 5.0]
    """
    statistics = dict(frames.named_buffers(recurse=False))
    buffers = dict(loss.named_buffers())
    for name, buffer in buffers.items():
        path, _, leaf = name.rpartition(".")
        if leaf in statistics and all(f"{path}.{own}" in buffers for own in statistics):
            buffer.copy_(statistics[leaf])
