"""Plain functions of batches as simulators.

May import: engines.common, language. Start reading at ``function_simulator.py``.
"""

from npdr_ppl.engines.functions.function_simulator import FunctionSimulator

__all__ = ["FunctionSimulator"]
