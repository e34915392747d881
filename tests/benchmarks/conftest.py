"""Lets tests import what the scripts in benchmarks/ import."""

import sys
from pathlib import Path

sys.path.append(str(Path(__file__).parents[2] / "benchmarks"))
