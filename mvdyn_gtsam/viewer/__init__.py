"""LOOK: a reconstruction in 3D in the browser, or written to one file that a browser opens.

``scene``, ``frames``, ``pictures`` and ``views`` say what is seen, as values; ``stage``, ``controls``,
``session``, ``server`` and ``recording`` show it and need viser, an extra.
"""
