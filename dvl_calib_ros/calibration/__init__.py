"""The calibration core: numpy and scipy only, no ROS, no files, no clock.

Data flows one way::

    samples -> alignment (screening, order, pairing, gates) -> rows -> bank of models -> Estimate
                                                                  └-> selection

`calibrator.Calibrator` wires these together; the node, the replay and the evaluator all use it. See
docs/architecture.md.
"""
