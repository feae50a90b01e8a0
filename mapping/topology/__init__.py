"""Topological maps: nodes and edges instead of coordinates (S41 to S43)."""
