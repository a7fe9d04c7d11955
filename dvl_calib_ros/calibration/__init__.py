"""The calibration core: numpy and scipy only, no ROS, no files, no clock.

Data flows one way::

    samples -> streams (order, jumps) -> pairing -> bank of models -> selection -> Estimate

`calibrator.Calibrator` wires these together; the node, the replay and the evaluator all use it.
"""
