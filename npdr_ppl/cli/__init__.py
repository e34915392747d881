"""The command line ``npdr``: a file per command, thin wrappers of the Python functions.

May import: everything. Start reading at ``main.py``.
"""
