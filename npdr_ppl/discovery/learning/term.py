"""A term of a law: functions of the variables of a port, each with a coefficient."""

from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from npdr_ppl.discovery.learning.expressions import evaluated
from npdr_ppl.discovery.learning.memory import CommandMemory, Delay, Memory
from npdr_ppl.discovery.learning.recorded_motion import PortMotion

__all__ = ["HISTORY", "Shape", "Term", "symbol_of"]

SYMBOLS = {"q": "q", "v": "v", "tau": "τ", "u": "u", "y": "y", "t": "t"}
"""Variables as they are written in formulas, but for those of other joints."""


HISTORY = "history"
"""Stands for the past motion and commands, among the variables."""


def symbol_of(variable: str) -> str:
    """Returns a variable as it is written in formulas; the first other joint has ``q₁``."""
    name, _, number = variable.partition("_")
    return SYMBOLS[name] + number.translate(str.maketrans("0123456789", "₀₁₂₃₄₅₆₇₈₉"))


@dataclass(frozen=True)
class Shape:
    """A constant inside of a term.

    Attributes:
        name: Its name in expressions.
        value: Its value before it is fitted.
        unit: Its unit.
    """

    name: str
    value: float
    unit: str


@dataclass(frozen=True)
class Term:
    """One or more functions of the variables, each with a coefficient.

    Attributes:
        key: Unique name.
        columns: Expressions; the law is their sum, each times a coefficient.
        formulas: The same for people.
        units: Unit of each column.
        uses: Symbols of the variables that it depends on.
        shapes: Constants inside of the expressions.
        is_dry: Whether it is dry friction: the columns are the bound, times minus the direction
            of motion.
        is_spline: Whether the columns are the hats of a spline.
        memory: A state on which the columns depend.
        cost: Its complexity: coefficients, fitted constants and operations.
    """

    key: str
    columns: tuple[str, ...]
    formulas: tuple[str, ...]
    units: tuple[str, ...]
    uses: frozenset[str]
    shapes: tuple[Shape, ...] = ()
    is_dry: bool = False
    is_spline: bool = False
    memory: Memory | None = None
    cost: float = field(default=1.0)

    @property
    def is_late_command(self) -> bool:
        """Whether it stands for a command that arrives late: a delay, a lag or a resonance."""
        return isinstance(self.memory, CommandMemory | Delay)

    def depends_on(self, variable: str) -> bool:
        """Returns whether it depends on a variable, by symbol, or on the ``"history"``."""
        return self.memory is not None if variable == HISTORY else variable in self.uses

    def values(self, motion: PortMotion) -> Tensor:
        """Returns the columns along the motion, ``(S, K, k)``."""
        constants = {shape.name: shape.value for shape in self.shapes}
        known: dict[str, Any] = {**motion.values, **constants}
        if self.memory is not None:
            known[self.memory.symbol] = self.memory.along(motion, constants)
        some = motion.values["t"]
        columns = [
            torch.as_tensor(evaluated(column, known), dtype=torch.float64).expand_as(some)
            for column in self.columns
        ]
        values = torch.stack(columns, dim=-1)
        return -values * motion.values["v"].sign()[..., None] if self.is_dry else values
