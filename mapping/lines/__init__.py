"""Line-based metrical maps (S03 to S10): from the beams of a scan to the walls of a building."""
