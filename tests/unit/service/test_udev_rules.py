"""udev rules from what the system knows of ports."""

from __future__ import annotations

from service.udev_rules import UsbPort, rules

CHIP = UsbPort("/dev/ttyUSB0", 0x0403, 0x6001, "A10K2", "pci-0000:00:14.0-usb-0:1:1.0-port0")
TWIN1 = UsbPort("/dev/ttyUSB1", 0x10C4, 0xEA60, "0001", "pci-0000:00:14.0-usb-0:2:1.0-port0")
TWIN2 = UsbPort("/dev/ttyUSB2", 0x10C4, 0xEA60, "0001", "pci-0000:00:14.0-usb-0:3:1.0-port0")
LINE2 = UsbPort("/dev/ttyUSB3", 0x0403, 0x6001, None, "platform-soc")
EVIL = UsbPort("/dev/ttyUSB4", 1, 2, 'x", RUN+="/bin/sh', "")


def only_rules(text: str) -> list[str]:
    return [line for line in text.splitlines() if line and not line.startswith("#")]


def test_by_serial_number_where_it_is_unique_else_by_socket() -> None:
    wanted = {"front": "/dev/ttyUSB0", "left": "/dev/ttyUSB1", "right": "/dev/ttyUSB2", "rear": "/dev/ttyUSB3"}
    text, troubles = rules(wanted, [CHIP, TWIN1, TWIN2, LINE2])
    assert troubles == []
    front, left, rear, right = only_rules(text)
    assert 'ATTRS{idVendor}=="0403", ATTRS{idProduct}=="6001", ATTRS{serial}=="A10K2"' in front
    assert front.endswith('SYMLINK+="umfeld/front"')
    assert 'ENV{ID_PATH}=="pci-0000:00:14.0-usb-0:2:1.0"' in left
    assert 'ENV{ID_PATH}=="pci-0000:00:14.0-usb-0:3:1.0"' in right
    assert 'ENV{ID_PATH}=="platform-soc"' in rear
    assert text.count("keep it plugged in there") == 3


def test_what_cannot_be_named_is_told_and_no_text_of_a_chip_becomes_a_command() -> None:
    text, troubles = rules({"a": "/dev/ttyUSB9", "b": "/dev/ttyUSB4"}, [CHIP, EVIL])
    assert only_rules(text) == []
    assert "RUN" not in text
    assert [line.split(":")[0] for line in troubles] == ["a", "b"]
