"""A rollout of the Furuta pendulum as an animation."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.animation import PillowWriter
from matplotlib.figure import Figure
from numpy.typing import NDArray

from npdr_ppl.drawing.theme import COLORS, theme
from npdr_ppl.errors import DataError
from npdr_ppl.models.furuta import Furuta
from npdr_ppl.rollouts import Rollouts

__all__ = ["check_animated", "furuta_points", "write_furuta_animation"]

CHANNELS = ("arm_angle", "pole_angle")

FRAMES_PER_SECOND = 20

MAX_FRAMES = 160
"""Maximum number of frames, about 10 kB each; longer rollouts are shown faster than real time."""

SIZE = 3.6
"""Width and height in inches."""

DOTS_PER_INCH = 100

TRAIL = 0.6
"""Time in s for which the path of the pole's tip remains visible."""


def check_animated(channel_names: Sequence[str]) -> None:
    """Raises a DataError unless the channels are those of a Furuta pendulum."""
    missing = [name for name in CHANNELS if name not in channel_names]
    if missing:
        raise DataError(
            f"Only the Furuta pendulum can be animated: there is no channel {', '.join(missing)}."
        )


def furuta_points(
    arm_angle: NDArray[np.float64],
    pole_angle: NDArray[np.float64],
    *,
    arm_length: float,
    pole_length: float,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Returns the end positions of arm and pole, ``(T, 3)`` each, in m, z up.

    Args:
        arm_angle: In rad, ``(T,)``.
        pole_angle: In rad, ``(T,)``; 0 is hanging.
        arm_length: In m.
        pole_length: In m.
    """
    zero = np.zeros_like(arm_angle)
    radial = np.stack([np.cos(arm_angle), np.sin(arm_angle), zero], -1)
    tangent = np.stack([-np.sin(arm_angle), np.cos(arm_angle), zero], -1)
    down = np.stack([zero, zero, -np.cos(pole_angle)], -1)
    pivot = arm_length * radial
    return pivot, pivot + pole_length * (np.sin(pole_angle)[:, None] * tangent + down)


def write_furuta_animation(
    rollout: Rollouts, path: Path, *, domain: Mapping[str, float] | None = None
) -> Path:
    """Writes a GIF of the first rollout, and returns its path.

    Args:
        rollout: Rollouts with the angles of a Furuta pendulum.
        path: The file.
        domain: Parameters with the lengths of arm and pole; missing ones are nominal.

    Raises:
        DataError: The angles were not recorded.
    """
    check_animated(rollout.channel_names)
    lengths = {p.name: p.nominal for p in Furuta.parameters} | dict(domain or {})
    angles = rollout.select(CHANNELS).readings[0]
    pivot, tip = furuta_points(
        angles[:, 0],
        angles[:, 1],
        arm_length=lengths["arm_length"],
        pole_length=lengths["pole_length"],
    )
    duration = (len(tip) - 1) * rollout.time_step
    count = min(MAX_FRAMES, math.ceil(duration * FRAMES_PER_SECOND) + 1)
    frames = np.linspace(0, len(tip) - 1, count).round().astype(int)
    trail = math.ceil(TRAIL / rollout.time_step)
    commands = rollout.actions[0]
    path.parent.mkdir(parents=True, exist_ok=True)
    with theme():
        figure = Figure(figsize=(SIZE, SIZE))
        drawn = _draw_rig(figure, lengths["arm_length"], lengths["pole_length"])
        writer = PillowWriter(fps=FRAMES_PER_SECOND)
        with writer.saving(figure, str(path), dpi=DOTS_PER_INCH):
            for frame in frames:
                drawn["arm"].set_data_3d(*np.stack([np.zeros(3), pivot[frame]], -1))
                drawn["pole"].set_data_3d(*np.stack([pivot[frame], tip[frame]], -1))
                drawn["tip"].set_data_3d(*tip[frame][:, None])
                drawn["trail"].set_data_3d(*tip[max(0, frame - trail) : frame + 1].T)
                command = commands[min(frame, len(commands) - 1)]
                drawn["text"].set_text(
                    f"{frame * rollout.time_step:.1f} s   "
                    + "  ".join(
                        f"{round(value, 1) + 0.0:+.1f} {unit}"  # + 0.0: never -0.0
                        for value, unit in zip(command, rollout.action_units, strict=True)
                    )
                )
                writer.grab_frame()
    return path


def _draw_rig(figure: Figure, arm_length: float, pole_length: float) -> dict[str, Any]:
    """Draws the fixed parts, and returns the moving parts by name."""
    # The axes exceed the frame, because matplotlib leaves space for tick labels.
    axis: Any = figure.add_axes((-0.08, -0.06, 1.16, 1.16), projection="3d")
    reach = arm_length + 0.3 * pole_length
    floor = -1.15 * pole_length
    axis.set(xlim=(-reach, reach), ylim=(-reach, reach), zlim=(floor, 1.1 * pole_length))
    axis.set_box_aspect((2.0 * reach, 2.0 * reach, 1.1 * pole_length - floor))
    axis.view_init(elev=18, azim=35)
    axis.set_axis_off()
    turn = np.linspace(0.0, 2.0 * math.pi, 60)
    circle = arm_length * np.stack([np.cos(turn), np.sin(turn)])
    axis.plot(*circle, floor, color="0.75", lw=1)
    axis.plot(*circle, 0.0, color="0.85", lw=0.8, ls=":")
    axis.plot([0.0, 0.0], [0.0, 0.0], [floor, 0.0], color="0.7", lw=8, solid_capstyle="butt")
    look: Any = {"solid_capstyle": "round"}
    return {
        "trail": axis.plot([], [], [], color=COLORS["posterior"], lw=1.5, alpha=0.7)[0],
        "arm": axis.plot([], [], [], color=COLORS["measured"], lw=4, **look)[0],
        "pole": axis.plot([], [], [], color=COLORS["nominal"], lw=4, **look)[0],
        "tip": axis.plot([], [], [], "o", color=COLORS["nominal"], ms=7)[0],
        "text": figure.text(0.04, 0.94, "", fontsize=10),
    }
