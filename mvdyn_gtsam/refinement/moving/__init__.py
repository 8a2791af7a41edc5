"""What moves: where (``motion``, ``free_space``, ``outline``), how far away (``region_depth``, ``growth``,
``ground``, ``over_time``) and of what shape (``pixel_sweep``, ``slanted_patches``, ``shape``, ``relief``)."""
