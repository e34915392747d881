"""What is hidden in a rig: an effect by name, with its true parameters."""

from collections.abc import Mapping
from dataclasses import dataclass, field

__all__ = ["CONSTANTS", "Hidden"]

CONSTANTS = ("order",)
"""Names of true values that are constants of the catalogue's law and no parameters."""


@dataclass(frozen=True)
class Hidden:
    """An effect in a rig.

    Attributes:
        port: The port of the model under test where a finder should see it.
        effect_id: Its id: the catalogue's, or one that the catalogue does not have.
        parameters: True values by the catalogue's short names, in the catalogue's units; of
            cogging, also the number of periods per turn, ``order``.
    """

    port: str
    effect_id: str
    parameters: Mapping[str, float] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """``"<port>.<effect>"``."""
        return f"{self.port}.{self.effect_id}"

    @property
    def sites(self) -> dict[str, float]:
        """True values by the names that sample sites would have."""
        own = self.parameters.items()
        return {f"{self.name}.{name}": value for name, value in own if name not in CONSTANTS}
