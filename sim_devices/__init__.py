"""Emulators: the twin of each driver, a second reading of the same data sheet, moved by a simulated world or a log."""
