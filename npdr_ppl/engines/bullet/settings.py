"""Settings of the engine; they are part of the model, so they are fixed and recorded."""

from dataclasses import dataclass

from npdr_ppl.errors import ModelError

__all__ = ["BulletSettings"]


@dataclass(frozen=True)
class BulletSettings:
    """How Bullet integrates and resolves contacts; ``None`` stands for Bullet's own default.

    Attributes:
        time_step: Seconds per step, unless the inputs of a simulation specify another value.
        substeps: Integration steps per time step; run time is proportional to it.
        gravity: Acceleration of gravity (x, y, z), in m/s².
        solver_iterations: Iterations of the contact and motor solver.
        contact_breaking_threshold: Distance in metres below which contacts are kept. Bullet's
            0.02 m lets small bodies collide before they touch, which reduces restitution: use 1e-5
            for a ball of a few centimetres.
        contact_erp: Fraction of a contact's penetration that a step corrects; it adds energy.
        restitution_velocity_threshold: Speed in m/s below which contacts do not bounce.
        damping: Linear and angular damping of every body, in 1/s. Bullet's default of 0.04 would
            add unwanted friction.
    """

    time_step: float = 0.01
    substeps: int = 1
    gravity: tuple[float, float, float] = (0.0, 0.0, -9.81)
    solver_iterations: int = 50
    contact_breaking_threshold: float = 0.02
    contact_erp: float | None = None
    restitution_velocity_threshold: float | None = None
    damping: float = 0.0

    def __post_init__(self) -> None:
        """Checks the ranges.

        Raises:
            ModelError: A setting is outside its range.
        """
        if self.time_step <= 0 or self.substeps < 1 or self.solver_iterations < 1:
            raise ModelError(
                "Bullet needs a positive time step and at least one substep and solver iteration, "
                f"got {self.time_step=}, {self.substeps=}, {self.solver_iterations=}."
            )

    def engine_parameters(self) -> dict[str, float]:
        """Returns the arguments of ``setPhysicsEngineParameter`` after a reset.

        The contact-breaking threshold is always included: it belongs to the process, not to the
        simulation, and a reset does not restore it.
        """
        chosen = {
            "numSolverIterations": self.solver_iterations,
            "contactBreakingThreshold": self.contact_breaking_threshold,
            "contactERP": self.contact_erp,
            "restitutionVelocityThreshold": self.restitution_velocity_threshold,
            "deterministicOverlappingPairs": 1,
        }
        return {name: value for name, value in chosen.items() if value is not None}
