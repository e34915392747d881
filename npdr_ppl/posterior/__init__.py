"""From a bound model to a posterior: prepare, infer, check, export, diagnose.

``comparison`` sets backends side by side; ``calibration`` tests coverage. May import: discovery
(its first fit and its alarm), preparation, inference. Start reading at ``infer.py``.
"""
