"""Plane-based metrical maps (S11 to S13): from sweeps of a tilting laser, or any cloud of points, to planes."""
