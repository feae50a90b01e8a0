"""Drivers: bytes and CAN frames on a wire in, readings out (see docs/architecture.md)."""
