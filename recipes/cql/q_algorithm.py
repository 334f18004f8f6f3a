"""The base class of conservative Q-learning with continuous and with discrete actions."""

from __future__ import annotations

from typing import ClassVar, TypeVar

from ..compilation import check_compiler, should_compile
from ..transition_algorithm import TransitionAlgorithm
from .settings import QRecipe

RecipeT = TypeVar("RecipeT", bound=QRecipe)


class QAlgorithm(TransitionAlgorithm[RecipeT]):
    """An algorithm whose losses may run through ``torch.compile``.

    Args:
        recipe: the settings.
    """

    compiles_on: ClassVar[tuple[str, ...]]
    """Types of device on which compiling pays off."""

    def should_compile(self) -> bool:
        """Whether losses run through ``torch.compile``."""
        setting = self.recipe.compile
        if self.recipe.slice_length > 1:  # their number of frames varies
            return False
        pays = setting == "on" or self.device.type in self.compiles_on
        return pays and should_compile(setting, self.recipe.total_updates)

    def check(self) -> None:
        """As :meth:`DatasetAlgorithm.check`; also checks that there is a compiler if requested."""
        check_compiler(self.recipe.compile)
        super().check()
