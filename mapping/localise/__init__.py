"""Where the robot is, and how sure: scan matching, closing of loops, the pose graph, simultaneous mapping."""
