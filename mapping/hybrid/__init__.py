"""Maps that join geometry and topology: rooms and ways on a grid (S44)."""
