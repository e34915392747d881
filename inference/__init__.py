"""The inference backends, one file per method; what methods share is in ``parts``.

May import: language, rollouts, embeddings. Start reading at ``base.py`` (the protocol), then
``snpe_c.py`` (the default method).
"""
