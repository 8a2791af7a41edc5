"""The paper's "Multiple-view scene consistency refinement", on scipy; it knows nothing of GTSAM.

Read ``stage`` first: it is the whole refinement in order. ``tasks`` is the work on single frames, pairs and
windows that it hands out, ``workspace`` what they keep on disk, ``edges`` flow as they use it.

* A first depth, where the paper has a network: ``measurement``, ``initial``, ``other_times``.
* ``solve``: residuals and solvers of phase 1 (scales) and of phase 2 (depth and poses in turn).
* ``moving``: what moves, its outline, its depth and its shape.
* ``plain``: planes of what has no texture.
* ``finish``: what is handed out, at the input's resolution.
"""
