"""Grid maps (S26 to S33)."""
