"""Sector maps: the nearest obstacle per direction, and what is known about it (S34 to S40)."""
