"""Feature maps (S14 to S25): what a scan looks like, and where it was seen before."""
