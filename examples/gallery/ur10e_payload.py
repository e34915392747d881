"""The load of a UR10e, from one motion without it and the same motion with it.

Arguments: the robot's file, the mapping, the log without load, the log with it, and the figure.
"""

import sys

import numpy as np
from matplotlib.figure import Figure

import npdr_ppl as npdr
from npdr_ppl.drawing.theme import theme
from npdr_ppl.engines.mujoco.payload import identify_payload

LINKS = ("shoulder", "upper_arm", "forearm", "wrist_1", "wrist_2", "wrist_3")
LABELS = ("without load", "with load, none in the model", "with load, load in the model")


def main(robot: str, mapping: str, without: str, loaded: str, figure: str) -> None:
    """Prints the load for each link that may carry it, and draws the errors of the last."""
    rollouts = [npdr.Rollouts.load(log, mapping=mapping) for log in (without, loaded)]
    print("link        mass  first half  second half  centre [m]              error left")
    for link in LINKS[2:]:
        load = identify_payload(robot, *rollouts, f"{link}_link")
        bare, ignored, known = np.array(list(load.errors.values())).T
        # Mean over the joints of the squared error that the load causes.
        left = np.mean((known**2 - bare**2) / ignored**2)
        centre = " ".join(f"{c:7.3f}" for c in load.centre)
        halves = "  ".join(f"{mass:8.3f} kg" for mass in load.half_masses)
        print(f"{link:10s} {load.mass:5.2f}  {halves}  {centre}  {left:8.0%}")
    with theme():
        drawing = Figure(figsize=(6.5, 2.6), layout="constrained")
        axes = drawing.subplots()
        for k, (label, errors) in enumerate(zip(LABELS, (bare, ignored, known), strict=True)):
            axes.bar(np.arange(6) + 0.27 * (k - 1), errors, 0.25, label=label)
        axes.set_xticks(range(6), [f"joint {k}" for k in range(1, 7)])
        axes.set_ylabel("RMS error of torque [N m]")
        axes.legend()
        drawing.savefig(figure, dpi=150)


if __name__ == "__main__":
    main(*sys.argv[1:])
