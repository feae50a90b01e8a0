"""The errors of this package.

DriverError
├── FrameError          bytes that are not a valid message; carries a short `reason` that names its counter
├── PortError           a wire that cannot be opened or was lost
│   ├── PortAbsent          nothing there under that name
│   ├── PortDenied          it is there, but we may not open it
│   └── PortBusy            another program holds it
└── DeviceRefused       the device understood and said no
"""


class DriverError(Exception):
    """Any trouble with a device or its wire."""


class FrameError(DriverError):
    """A message that is not valid. `reason` is a counter's name: lower case words joined by underscores."""

    def __init__(self, reason: str, detail: str = "") -> None:
        super().__init__(f"{reason}: {detail}" if detail else reason)
        self.reason = reason


class PortError(DriverError):
    """A wire that cannot be opened or was lost; the text names the port and the repair."""


class PortAbsent(PortError):  # noqa: N818 - the family's names say the state
    """Nothing is there under that name."""


class PortDenied(PortError):  # noqa: N818
    """The port is there, but this user may not open it."""


class PortBusy(PortError):  # noqa: N818
    """Another program holds the port."""


class DeviceRefused(DriverError):  # noqa: N818
    """The device understood the request and refused it."""
