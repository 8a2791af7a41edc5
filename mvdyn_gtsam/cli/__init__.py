"""The verbs of ``mvdyn``."""
