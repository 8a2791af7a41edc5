"""Depth of single images, from files or networks, at the scale of the start (paper, prior alignment).

``depth_prior`` is the interface. ``depth_files`` reads what others wrote; ``onnx_depth`` runs a network that
``depth_models`` knows or a description names; ``aligned_prior`` finds the scale.
"""
