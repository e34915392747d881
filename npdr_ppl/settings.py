"""Validation of the settings objects in which each stage keeps its numbers."""

__all__ = ["check_range"]


def check_range(settings: object, low: float, high: float, *names: str) -> None:
    """Checks that attributes lie within a range.

    Args:
        settings: The object.
        low: Smallest valid value.
        high: Greatest valid value.
        names: Names of the attributes; tuples, also nested ones, are checked element by element.

    Raises:
        ValueError: A value is out of range.
    """
    for name in names:
        for value in _flat(getattr(settings, name)):
            if not low <= value <= high:
                raise ValueError(
                    f"{type(settings).__name__}.{name} must lie in [{low:g}, {high:g}]; "
                    f"got {value:g}."
                )


def _flat(value: object) -> list[float]:
    if isinstance(value, tuple):
        return [number for part in value for number in _flat(part)]
    assert isinstance(value, (int, float))
    return [value]
