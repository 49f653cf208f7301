"""Hand-eye robot calibration with three points."""
