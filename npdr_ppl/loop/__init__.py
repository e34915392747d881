"""The NPDR loop (Muratore et al., CoRL 2021): infer, train, check, deploy, discover, repeat.

May import: posterior, discovery, policies, targets. Start reading at ``npdr_loop.py``.
"""
