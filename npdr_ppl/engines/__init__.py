"""Simulator engines: from a declared model to trajectories of whole batches.

``common`` holds what engines share, ``ode`` equations written in torch, ``mujoco`` MJCF files,
``bullet`` URDF scenes, ``gymnasium`` environments; ``pooled`` runs simulators that take one draw
at a time on ``workers``. May import: language, rollouts. Start reading at ``ode/simulator.py``.
"""
