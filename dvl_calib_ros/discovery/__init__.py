"""What is in a bag: which topics the calibration needs, where the sensors sit, and in which frames they measure."""
