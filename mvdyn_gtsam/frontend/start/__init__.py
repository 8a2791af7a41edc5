"""The wide-baseline start: every camera's place in one world (paper, "Wide-baseline Initialization").

Read ``wide_baseline`` first. Each camera gets a map of its own (``camera_maps``, ``single_camera``,
``dense_map``); matches between maps propose placements (``placement``, ``lifted_points``), which are mended
(``trial``) and judged by dense warping (``verification``); what is believed connects cameras (``groups``) and
is adjusted together (``joint_adjustment``). Focal lengths that are not known are found on the way (``focal``,
``bundle``). Cameras that stand still go their own way (``still_view``,
``still_cameras``).
"""
