"""Simulators that take one draw at a time, run on workers.

May import: engines.common, engines.workers, language. Start reading at ``pool_simulator.py``.
"""
