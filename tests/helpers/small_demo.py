"""Options that tell the demonstration's story in seconds, and say little by it."""

from npdr_ppl.discovery import DiscoveryOptions
from npdr_ppl.inference.registry import backend
from npdr_ppl.loop.loop_options import LoopOptions
from npdr_ppl.models.effects import CoulombFriction, SensorLowPass
from npdr_ppl.policies.search_registry import policy_search
from npdr_ppl.preparation.data_options import DataOptions

NUM_STEPS = 900

FILTER = SensorLowPass("arm_velocity,pole_velocity")

OPTIONS = DataOptions("all/10", 50, "recorded", "float32")

LOOP = LoopOptions(
    iterations=1,
    extra_rollouts=1,
    rounds=1,
    extra_rounds=0,
    num_simulations=50,
    backend=backend("snpe-c", transforms=1, hidden=(16,), epochs=3, members=2),
    search=policy_search("power", population=4, memory=3),
    search_iterations=1,
    num_domains=3,
    num_initial_states=1,
    least_success=0.0,
    discovers="after diagnosis",
    discovery=DiscoveryOptions((FILTER, CoulombFriction("arm")), max_effects=1),
)
