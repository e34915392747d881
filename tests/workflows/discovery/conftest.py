"""Hidden rigs, whose recordings come from equations and integrators of their own."""

import sys
from pathlib import Path

sys.path.append(str(Path(__file__).parents[3] / "benchmarks"))
