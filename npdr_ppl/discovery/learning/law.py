"""A learned law: terms at a port with their coefficients."""

import re
import zlib
from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from itertools import count

from npdr_ppl.discovery.learning.term import Term, symbol_of
from npdr_ppl.language.channels import Port

__all__ = ["Constant", "Law"]


@dataclass(frozen=True)
class Constant:
    """A parameter of a learned effect.

    Attributes:
        name: Its name.
        unit: Its unit.
        value: Its fitted value, in ``unit``.
        spread: Standard deviation of its normal prior; of a positive shape constant, that of the
            log.
        text: What it is.
        is_shape: Whether it is a shape constant, with a log-normal prior about ``value``.
    """

    name: str
    unit: str
    value: float
    spread: float
    text: str
    is_shape: bool = False


@dataclass(frozen=True)
class Law:
    """A sum of terms at a port.

    Attributes:
        port: The port.
        terms: The terms.
        coefficients: Coefficient of each column of each term.
        spreads: Standard deviation of the prior of each coefficient.
        ranges: Least and greatest value of each variable that was visited.
        units: Units of the variables.
        number: Tells it from other learned effects at ports of this name.
        others: Ports of the other joints on which it may depend, in the order of their numbers.
    """

    port: Port
    terms: tuple[Term, ...]
    coefficients: tuple[float, ...]
    spreads: tuple[float, ...]
    ranges: Mapping[str, tuple[float, float]]
    units: Mapping[str, str]
    number: int = 1
    others: tuple[str, ...] = ()

    @property
    def class_name(self) -> str:
        """Name of its class; another one at every port."""
        name = _identifier(self.port.name)
        words = re.sub(r"(?:^|_)([A-Za-z])", lambda m: m[1].upper(), name)
        return f"Learned{words}{self._end}"

    @property
    def id(self) -> str:
        """Its id as an effect."""
        return f"learned_{_identifier(self.port.name)}{self._end}"

    @property
    def _end(self) -> str:
        # No port's name has two of these signs after another.
        return "" if self.number == 1 else f"__{self.number}"

    def apart_from(self, ids: Collection[str]) -> "Law":
        """Returns the law with an id that is none of others.

        Args:
            ids: Ids of other effects.
        """
        numbered = (replace(self, number=number) for number in count(1))
        return next(law for law in numbered if law.id not in ids)

    @property
    def uses(self) -> frozenset[str]:
        """Symbols of the variables that it depends on."""
        return frozenset(symbol for term in self.terms for symbol in term.uses)

    @property
    def letters(self) -> dict[str, str]:
        """What the letters of states and of other joints in its formula mean."""
        found = {
            self.marked(term.memory.letter, number): term.memory.about
            for number, term in enumerate(self.terms, 1)
            if term.memory is not None
        }
        for variable, part, port in self.of_other_joints:
            found[symbol_of(variable)] = f"the {('position', 'velocity')[part]} at {port}"
        return found

    @property
    def of_other_joints(self) -> list[tuple[str, int, str]]:
        """Its variables of other joints, their places among position and velocity, and ports."""
        parts = [(variable, *variable.partition("_")[::2]) for variable in sorted(self.uses)]
        return [
            (variable, "qv".index(symbol), self.others[int(number) - 1])
            for variable, symbol, number in parts
            if number
        ]

    @property
    def constants(self) -> list[Constant]:
        """Its parameters: the coefficients, then the shape constants."""
        found: list[Constant] = []
        flat = iter(zip(self.coefficients, self.spreads, strict=True))
        for number, term in enumerate(self.terms, 1):
            for formula, unit in zip(term.formulas, term.units, strict=True):
                value, spread = next(flat)
                name = f"c{len(found) + 1}"
                sign = "minus the coefficient" if term.is_dry else "coefficient"
                text = f"{sign} of {self.marked(formula, number)}"
                found.append(Constant(name, _per(self.port.unit, unit), value, spread, text))
        for number, term in enumerate(self.terms, 1):
            for shape in term.shapes:
                text = f"in {self.marked(term.formulas[0], number)}"
                if term.memory is not None and term.memory.equation:
                    text = f"{LETTERS[shape.name]} in {self.marked(term.memory.equation, number)}"
                name = self.own_name(shape.name, number)
                found.append(Constant(name, shape.unit, shape.value, 0.1, text, True))
        return found

    def own_name(self, name: str, number: int) -> str:
        """Returns the name of a shape constant or of a state of one of the terms.

        Args:
            name: Its name in the term.
            number: The term's number, from 1 on.
        """
        return name if len(self.terms) == 1 else f"{name}_{number}"

    def marked(self, formula: str, number: int) -> str:
        """Returns a formula with the term's number at its state, if other terms have states.

        Args:
            formula: A formula of the term.
            number: The term's number, from 1 on.
        """
        memory = self.terms[number - 1].memory
        several = sum(term.memory is not None for term in self.terms) > 1
        if memory is None or not memory.equation or not several:
            return formula
        return _letter_replaced(formula, memory.letter, memory.letter + _subscript(number))

    @property
    def formula(self) -> str:
        """The law in one line, with letters for the coefficients."""
        parts, count_so_far = [], 0
        for number, term in enumerate(self.terms, 1):
            if term.is_spline:
                count_so_far += len(term.columns)
                parts.append(term.key)
                continue
            for formula in term.formulas:
                count_so_far += 1
                sign = "−" if term.is_dry else "+"
                text = "" if formula == "1" else f" {self.marked(formula, number)}"
                parts.append(f"{sign} c{_subscript(count_so_far)}{text}")
        text = " ".join(parts).removeprefix("+ ")
        return ", ".join([text, *(self.marked(e, n) for n, e in self._equations)])

    @property
    def formula_with_numbers(self) -> str:
        """The law in one line, with the fitted coefficients."""
        parts, flat = [], iter(self.coefficients)
        for number, term in enumerate(self.terms, 1):
            if term.is_spline:
                for _ in term.columns:
                    next(flat)
                parts.append(f"+ {term.key}")
                continue
            for formula in term.formulas:
                value = next(flat) * (-1.0 if term.is_dry else 1.0)
                formula = self.marked(_with_numbers(formula, term), number)
                text = "" if formula == "1" else f" {formula}"
                parts.append(f"{'−' if value < 0 else '+'} {abs(value):.4g}{text}")
        text = " ".join(parts).removeprefix("+ ")
        equations = (
            self.marked(_with_numbers(e, self.terms[n - 1]), n) for n, e in self._equations
        )
        return ", ".join([text, *equations])

    @property
    def _equations(self) -> list[tuple[int, str]]:
        """Equations of the states, with the numbers of their terms."""
        return [
            (number, term.memory.equation)
            for number, term in enumerate(self.terms, 1)
            if term.memory is not None and term.memory.equation
        ]


def _identifier(name: str) -> str:
    """Returns a name of ASCII letters and digits, separated by ``_``.

    A name that has other characters ends with a checksum, so that ``"knee-1"`` and ``"knee_1"``
    stay apart.
    """
    if re.fullmatch("[a-z0-9]+(_[a-z0-9]+)*", name):
        return name
    words = re.findall("[A-Za-z0-9]+", name)
    return "_".join([*words, f"{zlib.crc32(name.encode()):08x}"])


LETTERS = {
    "wave_number": "k",
    "speed": "vₛ",
    "edge": "e",
    "time_constant": "T",
    "frequency": "f",
    "width": "w",
    "asymmetry": "β",
    "delay": "d",
    "damping": "ζ",
}
"""Letters of the shape constants in formulas."""


def _with_numbers(formula: str, term: Term) -> str:
    """Returns a formula of a term with the values of its constants."""
    for shape in term.shapes:
        formula = _letter_replaced(formula, LETTERS[shape.name], f"{shape.value:.4g}")
    return formula


def _letter_replaced(formula: str, letter: str, new: str) -> str:
    return re.sub(rf"(?<!\w){letter}(?!\w)", new, formula)


def _subscript(number: int) -> str:
    return str(number).translate(str.maketrans("0123456789", "₀₁₂₃₄₅₆₇₈₉"))


def _per(unit: str, other: str) -> str:
    """Returns the unit of a coefficient: a unit per another one."""
    if other in ("1", ""):
        return unit
    is_one = all(c.isalnum() for c in other) or (other[0] == "(" and other.count("(") == 1)
    if unit == other:
        return "1"
    return f"{unit}/{other}" if is_one else f"{unit}/({other})"
