"""Names of the parts of a floating body's pose and velocity, as logs write them."""

import re
from collections.abc import Collection

__all__ = ["FRAMES", "pose_part", "pose_parts"]

FRAMES = {
    "position": "in the world's frame",
    "orientation": "from the body's frame to the world's",
    "velocity": "in the world's frame",
    "spin": "about the body's own axes",
}
"""How a MuJoCo model reads each part of a floating body's pose and velocity."""

_PARTS = (
    ("orientation", r"(.*[^a-z])?(q|quat|quaternion|orientation|att)[^a-z]*([wxyz])"),
    (
        "spin",
        r"(.*[^a-z])?(gyro|gyroscope|angular|angular_(velocity|rate)|omega|spin|rates?)[^a-z]*([xyz])",
    ),
    ("spin", r"(.*[^a-z])?([xyz])_spin"),
    ("velocity", r"(.*[^a-z])?(v|vel|velocity|linear|linear_velocity)[^a-z]*([xyz])"),
    ("velocity", r"(.*[^a-z])?([xyz])_velocity"),
    (
        "position",
        r"(.*[^a-z])?(p|pos|position|translation|mocap|vicon|base|body|root)[^a-z]*([xyz])",
    ),
    ("position", r"([xyz])"),
)
"""Each part with what its names look like; the last letter that is captured is the axis."""


def pose_part(name: str) -> tuple[str, str] | None:
    """Returns which part of a floating body's pose a name says, and its axis; ``None`` if none.

    Example: ``pose.orientation.w`` is ``("orientation", "w")``, and ``gyro_x`` is
    ``("spin", "x")``.

    Args:
        name: The name of a signal, or of a model's column.
    """
    word = re.sub(r"(?<=[a-z])(?=[A-Z])", "_", name).lower()
    for part, pattern in _PARTS:
        if found := re.fullmatch(pattern, word):
            return part, found.groups()[-1]
    return None


def pose_parts(names: Collection[str]) -> dict[str, tuple[str, str]]:
    """Returns the parts that a model's columns are, by name, with their axes.

    ``hull_qw`` tells that the body ``hull`` floats, and that ``hull_x`` is its position, whatever
    the body is called.

    Args:
        names: Names of the model's columns.
    """
    own = sorted((name[:-3] for name in names if name.endswith("_qw")), key=len, reverse=True)
    result = {}
    for name in names:
        short = next((name[len(body) :] for body in own if name.startswith(f"{body}_")), None)
        part = pose_part(name if short is None else short.lstrip("_"))
        if part is not None:
            result[name] = part
    return result
