"""Domain parameters of a MuJoCo model and the numbers of the file that they set."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from npdr_ppl.engines.mujoco.fields import Field, find_field
from npdr_ppl.errors import ModelError, ShapeError
from npdr_ppl.language.channels import Parameter
from npdr_ppl.registry import hint

__all__ = ["Assignments", "Binding", "Bindings", "Derivation", "Scale", "present"]

Derivation = Callable[[Mapping[str, Tensor]], Tensor]
"""Maps all parameters by name, each of the batch shape or a number, to a field's value."""

Assignments = dict[tuple[str, int], Tensor]
"""Values by array and place in it, each ``(N,)`` or a number."""


def present(model: Any, array: str, place: int, assignments: Assignments) -> Tensor:
    """Returns a number of a model after assignments.

    Args:
        model: A ``mujoco.MjModel``.
        array: Name of its array, ``"opt.…"`` for options.
        place: Its index in the flat array.
        assignments: What is written into the model.
    """
    if (array, place) in assignments:
        return assignments[array, place]
    option = array.removeprefix("opt.")
    values = getattr(model if array == option else model.opt, option)
    return torch.tensor(float(values.reshape(-1)[place]), dtype=torch.float64)


@dataclass(frozen=True, init=False)
class Scale:
    """A factor on the nominal values of one or more fields: ``Scale("body hand mass", …)``.

    A factor can apply to fields with different values. For example, a change of density at
    constant shape is ``Scale("body hand mass", "body hand inertia")``.

    Attributes:
        fields: Names of the fields.
    """

    fields: tuple[str, ...]

    def __init__(self, *fields: str) -> None:
        object.__setattr__(self, "fields", fields)


Binding = str | Sequence[str] | Scale | Parameter
"""Target of a parameter: a field, several fields of equal nominal value, a factor on fields, or
none (a :class:`~npdr_ppl.language.channels.Parameter` that only derived fields use)."""


class Bindings:
    """All parameters of a model and the fields that they set.

    Args:
        model: A ``mujoco.MjModel``.
        parameters: The target of each parameter, by its name.
        derived: Fields that are functions of the parameters, by the field's name.

    Attributes:
        parameters: The parameters with their units; nominal values are those of the file.
        arrays: Names of the model's arrays that the bindings change.

    Raises:
        ModelError: A field does not exist, or a binding is invalid.
    """

    def __init__(
        self, model: Any, parameters: Mapping[str, Binding], derived: Mapping[str, Derivation]
    ) -> None:
        declared = []
        self._set: dict[str, tuple[Field, ...]] = {}
        self._scaled: dict[str, tuple[Field, ...]] = {}
        for name, binding in parameters.items():
            if isinstance(binding, Parameter):
                if binding.name != name:
                    raise ModelError(f"Parameter {name!r} is declared as {binding.name!r}.")
                declared.append(binding)
                continue
            texts = _texts(binding)
            if not texts:
                raise ModelError(f"Parameter {name!r} sets no field.")
            fields = tuple(find_field(model, text) for text in texts)
            if isinstance(binding, Scale):
                self._scaled[name] = fields
                declared.append(Parameter(name, "1", 1.0, f"factor on {', '.join(texts)}"))
            else:
                self._set[name] = fields
                unit, nominal = _common(name, fields)
                declared.append(Parameter(name, unit, nominal, ", ".join(texts)))
        self.parameters = tuple(declared)
        self._derived = {find_field(model, text): rule for text, rule in derived.items()}
        self._check_targets()

    @property
    def places(self) -> set[tuple[str, int]]:
        """Arrays and places of the numbers that the bindings set."""
        groups = (*self._set.values(), *self._scaled.values(), tuple(self._derived))
        return {(e.array, e.place) for fields in groups for field in fields for e in field.entries}

    @property
    def arrays(self) -> set[str]:
        """Names of the model's arrays that the bindings change."""
        return {array for array, _ in self.places}

    def names_setting(self, arrays: set[str]) -> set[str]:
        """Returns the parameters that set a number in one of these arrays directly."""
        return {
            name
            for name, fields in {**self._set, **self._scaled}.items()
            if any(entry.array in arrays for field in fields for entry in field.entries)
        }

    def assignments(
        self, given: Mapping[str, Tensor], parameters: Mapping[str, Tensor]
    ) -> Assignments:
        """Returns the values to write into the model.

        Args:
            given: Values of the given parameters, ``(N,)`` or numbers.
            parameters: All parameters, nominal where not given.

        Raises:
            ModelError: A derivation uses a parameter that does not exist.
            ShapeError: A derivation returned a value of the wrong shape.
        """
        result: Assignments = {}
        nominal = {parameter.name: parameter.nominal for parameter in self.parameters}
        for name, value in given.items():
            for field in self._set.get(name, ()):
                for entry in field.entries:
                    # The nominal value gives exactly the file's number, without rounding errors.
                    result[entry.array, entry.place] = torch.where(
                        value == nominal[name], entry.nominal, entry.number(value)
                    )
            for field in self._scaled.get(name, ()):
                for entry in field.entries:
                    own = entry.nominal - entry.offset
                    result[entry.array, entry.place] = entry.offset + value * own
        sizes = {value.numel() for value in parameters.values()} | {1}
        for field, rule in self._derived.items():
            try:
                value = torch.as_tensor(rule(parameters), dtype=torch.float64)
            except KeyError as error:
                raise ModelError(
                    f"The derivation of {field.text!r} asks for a parameter that does not exist: "
                    f"no parameter {error}; {hint(str(error), parameters)}"
                ) from error
            if value.ndim > 1 or value.numel() not in sizes:
                raise ShapeError(
                    f"The derivation of {field.text!r} should return one value per simulation, "
                    f"got {value.shape=}."
                )
            for entry in field.entries:
                result[entry.array, entry.place] = entry.number(value)
        return result

    def _check_targets(self) -> None:
        """Raises a ModelError if two bindings set the same number."""
        owners: dict[tuple[str, int], str] = {}
        groups = [
            *((name, fields) for name, fields in {**self._set, **self._scaled}.items()),
            *((field.text, (field,)) for field in self._derived),
        ]
        for owner, fields in groups:
            for key in {(e.array, e.place) for field in fields for e in field.entries}:
                if key in owners:
                    raise ModelError(
                        f"{owners[key]!r} and {owner!r} both set {key[0]}[{key[1]}]; "
                        "express one by the other as a derived field."
                    )
                owners[key] = owner


def _texts(binding: str | Sequence[str] | Scale) -> tuple[str, ...]:
    if isinstance(binding, str):
        return (binding,)
    return binding.fields if isinstance(binding, Scale) else tuple(binding)


def _common(name: str, fields: tuple[Field, ...]) -> tuple[str, float]:
    """Returns the unit and the nominal value that all fields share."""
    units, values = {field.unit for field in fields}, [field.nominal for field in fields]
    if len(units) > 1:
        raise ModelError(f"Parameter {name!r} sets fields in {', '.join(sorted(units))}.")
    first = values[0]
    if first is None or any(v is None or abs(v - first) > 1e-9 * abs(first) for v in values):
        raise ModelError(
            f"Parameter {name!r} sets numbers that differ in the file "
            f"({', '.join(field.text for field in fields)}); name one of them, or scale them all "
            "with Scale(...)."
        )
    return units.pop(), first
