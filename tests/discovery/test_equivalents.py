"""Effects that a recording cannot distinguish."""

from npdr_ppl.discovery.screening.equivalents import equivalents, irreducible
from npdr_ppl.models.effects import (
    AsymmetricCoulombFriction,
    CoulombFriction,
    InputDelay,
    candidate_effects,
)
from npdr_ppl.models.pendulum import Pendulum


def test_sums_of_effects_are_not_searched_beside_their_parts():
    every = candidate_effects(Pendulum())
    names = {effect.name for effect in irreducible(every)}
    assert "hinge.asymmetric_coulomb_friction" not in names
    alone = irreducible((AsymmetricCoulombFriction("hinge"), InputDelay("torque")))
    assert {effect.id for effect in alone} == {"asymmetric_coulomb_friction", "input_delay"}


def test_equivalents_name_sums_only_with_all_their_parts():
    without = equivalents(CoulombFriction("hinge"), ("hinge.coulomb_friction",))
    both = equivalents(CoulombFriction("hinge"), ("hinge.coulomb_friction", "hinge.bias"))
    assert "coulomb_friction + bias" not in without
    assert "coulomb_friction + bias" in both
