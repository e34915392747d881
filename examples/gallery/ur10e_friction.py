"""Friction of every joint of a UR10e, from one motion of all joints.

Arguments: the robot's file, the mapping, and the log.
"""

import sys

import npdr_ppl as npdr
from npdr_ppl.engines.mujoco.joint_friction import identify_friction


def main(robot: str, mapping: str, log: str) -> None:
    """Prints dry and viscous friction of each joint, and what dry friction explains."""
    rollouts = npdr.Rollouts.load(log, mapping=mapping)
    print("joint                dry   in the halves   viscous   in the halves   share")
    for name, found in identify_friction(robot, rollouts).items():
        dry, viscous = ("{:6.2f} {:6.2f}".format(*h) for h in (found.half_dry, found.half_viscous))
        print(
            f"{name:20s} {found.dry:5.2f}  {dry}  {found.viscous:8.2f}  {viscous}  "
            f"{found.share:6.0%}"
        )


if __name__ == "__main__":
    main(*sys.argv[1:])
