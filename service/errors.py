"""Trouble that a person can repair; the command line prints it as it stands, without a traceback."""

from __future__ import annotations

from collections.abc import Sequence


class Trouble(Exception):  # noqa: N818 - the name says what it is for the person who reads it
    """One or more lines, each naming what is wrong and the repair. exit_code: 1 a problem found, 2 wrong usage."""

    exit_code = 1

    def __init__(self, *lines: str) -> None:
        super().__init__("\n".join(lines))
        self.lines: Sequence[str] = lines


class WrongUsage(Trouble):
    """The call or the configuration is wrong: exit code 2."""

    exit_code = 2
