"""Maps: pure functions and classes over arrays. No I/O, thread, clock, socket or configuration file in here."""
