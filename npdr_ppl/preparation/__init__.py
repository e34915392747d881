"""Bind a model to a recording: data options, segments, initial states, likelihood, closest fit.

Also draws of the exact posterior, which discovery and the estimator check share. May import:
inference, engines, rollouts, language. Start reading at ``binding.py``, then ``segment_model.py``
(a model along a recording) and ``closest_fit.py`` (the best parameters). The caller is
``posterior/prepare.py``.
"""
