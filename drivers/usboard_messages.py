"""Neobotix USBoard and USBoard-USS5: up to 16 ultrasonic transducers, on CAN or on a serial line.

Messages have 8 bytes on both links, byte 0 is the command. On CAN the id tells it too, as an offset from the base id:

    offset    message                                                direction
    +0        any command                                            to the board
    +1        00 01 02 03 04 05 06 07      CONNECT                   from it
    +2 +3     02 part d d d d 00 00        sensors 1-4, 5-8, cm      (old boards)
    +4 +5     03 part d d d d 00 00        sensors 9-12, 13-16, cm   (old boards)
    +6        06 i p[6i..6i+5]             parameters, i = 0..8
    +7        07 l0 l1 l2 l3 n01 n23 00    analog inputs, 12 bits: low bytes, then high nibbles (even channel low)
    +8 +9     04|05 sumLo sumHi ..         answers to parameter writes
    +13..+16  0D info l0 l1 l2 l3 n01 n23  group 0..3; info bits 0-1 group, 2-3 resolution, 4-7 who fired

A value is 0 no transducer, 1 closer than measurable, 2 no echo, else a distance in units of the resolution. Who fired:
F each transducer for itself, a single bit: what the four heard of that one's ping (cross echo).

On the serial line (19200 8N1) we send the bare 8 bytes; the board sends FF, the 8 bytes, and a CRC, high byte first.

Source: Neobotix documentation of the USBoard-USS5, sections "Parameter Set" and "Command Set". Vectors: tests.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum

from drivers.checksums import crc16_usboard
from drivers.errors import FrameError


class Command(IntEnum):
    """Byte 0 of every message."""

    CONNECT = 0
    SET_CHANNEL_ACTIVE = 1
    GET_DATA_1TO8 = 2
    GET_DATA_9TO16 = 3
    WRITE_PARASET = 4
    WRITE_PARASET_TO_EEPROM = 5
    READ_PARASET = 6
    GET_ANALOGIN = 7
    GET_DATA = 13


MESSAGE_SIZE = 8
PARAMETER_SIZE = 54
PARAMETER_PARTS = 9
_PART_SIZE = 6
CONNECT_ANSWER = bytes(range(8))
_RESOLUTIONS_M = (0.01, 0.005, 0.0025, 0.00125)
LEGACY_RESOLUTION_M = 0.01


# ---- messages


def encode_command(command: Command, *data: int) -> bytes:
    """One message to the board, padded with zeros."""
    return bytes((command, *data)).ljust(MESSAGE_SIZE, b"\0")


def encode_get_data(groups: Sequence[int]) -> bytes:
    """Ask for the newest values of groups 0..3 (four transducers each)."""
    return encode_command(Command.GET_DATA, sum(1 << group for group in set(groups)))


def encode_set_active(channels: Sequence[int]) -> bytes:
    """Switch on these channels (1..16) and all others off, until the next power-up. The board does not answer."""
    mask = sum(1 << (channel - 1) for channel in set(channels))
    return encode_command(Command.SET_CHANNEL_ACTIVE, mask & 0xFF, mask >> 8)


@dataclass(frozen=True, slots=True)
class GroupValues:
    """Raw values of four neighbouring channels. fired_by: the channel heard by all four, None if each heard itself."""

    first_channel: int
    resolution_m: float
    values: tuple[int, ...]
    fired_by: int | None = None


def decode_group(message: bytes) -> GroupValues:
    """A GET_DATA answer. Raises FrameError `bad_info` if none or several transducers are said to have fired."""
    info = message[1]
    group = info & 3
    fired = info >> 4
    if fired == 0xF:
        fired_by = None
    elif fired in (1, 2, 4, 8):
        fired_by = 4 * group + fired.bit_length()
    else:
        raise FrameError("bad_info", f"{info:02X}h")
    return GroupValues(4 * group + 1, _RESOLUTIONS_M[info >> 2 & 3], _twelve_bits(message), fired_by)


def decode_part(message: bytes) -> GroupValues:
    """A GET_DATA_1TO8 or GET_DATA_9TO16 answer: one byte per channel, in centimetres."""
    part = message[1]
    if part > 1 or message[6:] != b"\0\0":
        raise FrameError("bad_part", message.hex())
    first = 8 * (message[0] - Command.GET_DATA_1TO8) + 4 * part + 1
    return GroupValues(first, LEGACY_RESOLUTION_M, tuple(message[2:6]))


def decode_analog(message: bytes) -> tuple[float, ...]:
    """A GET_ANALOGIN answer: the four inputs in volts."""
    if message[7] != 0:
        raise FrameError("bad_analog", message.hex())
    return tuple(value * 5.0 / 4095.0 for value in _twelve_bits(message[:1] + message))


def check_message(message: bytes) -> None:
    """Raises FrameError if these 8 bytes are nothing that a board says: its name of the reason is the counter's."""
    command = message[0]
    if command == Command.GET_DATA:
        decode_group(message)
    elif command in (Command.GET_DATA_1TO8, Command.GET_DATA_9TO16):
        decode_part(message)
    elif command == Command.GET_ANALOGIN:
        decode_analog(message)
    elif command == Command.CONNECT:
        if message != CONNECT_ANSWER:
            raise FrameError("bad_connect", message.hex())
    elif command == Command.READ_PARASET:
        if message[1] >= PARAMETER_PARTS:
            raise FrameError("bad_parameters", message.hex())
    elif command not in (Command.WRITE_PARASET, Command.WRITE_PARASET_TO_EEPROM):  # answers to a setting tool
        raise FrameError("unknown_command", message.hex())


def _twelve_bits(message: bytes) -> tuple[int, ...]:
    """Four 12-bit values: low bytes at 2..5, high nibbles at 6 and 7."""
    n01, n23 = message[6], message[7]
    high = (n01 & 0xF, n01 >> 4, n23 & 0xF, n23 >> 4)
    return tuple(low | top << 8 for low, top in zip(message[2:6], high))


# ---- parameters


class SendMode(IntEnum):
    """When the board sends measurements."""

    ON_REQUEST = 0
    ON_CAN = 1
    ON_SERIAL = 2
    ON_BOTH = 3


_CAN_RATES_BPS = (1_000_000, 500_000, 250_000, 125_000, 100_000, 50_000)
_INTERVALS_S = (0.5, 1.0, 2.0, 0.2)
_FLAGS = (
    "extended_ids",
    "termination",
    "analog_inputs",
    "legacy_format",
    "invert_warn_relay",
    "invert_alarm_relay",
)


@dataclass(frozen=True, slots=True)
class UsBoardParameters:
    """The board's 54 bytes of parameters; the defaults are the board's own.

    interval_s: of automatic sending; 0.05 to 0.8 in steps of 0.05, or 1, or 2.  active: bit i is channel i + 1.
    send_groups: bit i is group i (0: all).  warning_cm, alarm_cm: relay distances, 16 each, up to 255.
    resolution_m, cross_echo_sender (0..3), fire_interval_s (0.01 to 0.16): per group of four.
    hardware_version: 0 is a USBoard V1, 20 and 21 a USS5, 200 and 201 a USS5-IP; read only, as the serial number.
    """

    can_rate_bps: int = 1_000_000
    base_id: int = 0x400
    extended_ids: bool = False
    termination: bool = False
    analog_inputs: bool = False
    legacy_format: bool = False
    invert_warn_relay: bool = False
    invert_alarm_relay: bool = False
    send_mode: SendMode = SendMode.ON_REQUEST
    send_groups: int = 0xF
    interval_s: float = 0.5
    active: int = 0xFFFF
    warning_cm: tuple[int, ...] = (100,) * 16
    alarm_cm: tuple[int, ...] = (30,) * 16
    resolution_m: tuple[float, ...] = (0.005,) * 4
    cross_echo: int = 0
    cross_echo_sender: tuple[int, ...] = (0,) * 4
    fire_interval_s: tuple[float, ...] = (0.02,) * 4
    low_pass_gain: float = 1.0
    hardware_version: int = 0
    serial_number: int = 0


def encode_parameters(parameters: UsBoardParameters) -> bytes:
    """The 54 bytes. Raises ValueError if a value cannot be expressed in them."""
    if not 0 <= parameters.base_id < 1 << 29 or not 0 <= parameters.serial_number < 1 << 32:
        raise ValueError(f"base_id {parameters.base_id:X}h or serial_number {parameters.serial_number} out of range")
    if not 0 <= parameters.active <= 0xFFFF or not 0 <= parameters.send_groups <= 0xF:
        raise ValueError("active has 16 bits, send_groups 4")
    if len(parameters.warning_cm) != 16 or len(parameters.alarm_cm) != 16:
        raise ValueError("warning_cm and alarm_cm need 16 values each")
    block = bytearray(PARAMETER_SIZE)
    block[0] = _CAN_RATES_BPS.index(parameters.can_rate_bps)
    block[1:5] = parameters.base_id.to_bytes(4, "little")
    block[5] = sum(1 << bit for bit, name in enumerate(_FLAGS) if getattr(parameters, name))
    block[6] = parameters.send_mode | parameters.send_groups << 4
    block[7] = _encode_interval(parameters.interval_s)
    block[8:10] = parameters.active.to_bytes(2, "little")
    block[10:26] = bytes(parameters.warning_cm)
    block[26:42] = bytes(parameters.alarm_cm)
    block[42] = _pack([_RESOLUTIONS_M.index(value) for value in parameters.resolution_m], bits=2)
    block[43] = parameters.cross_echo
    block[44] = _pack(parameters.cross_echo_sender, bits=2)
    tens_ms = [round(value * 100) - 1 for value in parameters.fire_interval_s]
    block[45], block[46] = _pack(tens_ms[:2], bits=4), _pack(tens_ms[2:], bits=4)
    block[47] = round(parameters.low_pass_gain * 128)
    block[49] = parameters.hardware_version
    block[50:54] = parameters.serial_number.to_bytes(4, "little")
    return bytes(block)


def decode_parameters(block: bytes) -> UsBoardParameters:
    """Raises FrameError `bad_parameters` if the 54 bytes hold what the documentation does not allow."""
    if len(block) != PARAMETER_SIZE or block[0] >= len(_CAN_RATES_BPS) or block[6] & 0xF > SendMode.ON_BOTH:
        raise FrameError("bad_parameters", block.hex())
    return UsBoardParameters(
        can_rate_bps=_CAN_RATES_BPS[block[0]],
        base_id=int.from_bytes(block[1:5], "little"),
        **{name: bool(block[5] >> bit & 1) for bit, name in enumerate(_FLAGS)},
        send_mode=SendMode(block[6] & 0xF),
        send_groups=block[6] >> 4,
        interval_s=_decode_interval(block[7]),
        active=int.from_bytes(block[8:10], "little"),
        warning_cm=tuple(block[10:26]),
        alarm_cm=tuple(block[26:42]),
        resolution_m=tuple(_RESOLUTIONS_M[index] for index in _unpack(block[42], bits=2)),
        cross_echo=block[43],
        cross_echo_sender=_unpack(block[44], bits=2),
        fire_interval_s=tuple((n + 1) / 100 for n in (*_unpack(block[45], bits=4), *_unpack(block[46], bits=4))),
        low_pass_gain=block[47] / 128,
        hardware_version=block[49],
        serial_number=int.from_bytes(block[50:54], "little"),
    )


def parameter_sum(block: bytes) -> int:
    """What the board answers to the last part of a write: the sum of bytes 0 to 47."""
    return sum(block[:48])


def encode_parameter_write(parameters: UsBoardParameters, *, to_eeprom: bool) -> list[bytes]:
    """The nine messages that write all parameters; send each after the answer to the one before (up to 10 s)."""
    command = Command.WRITE_PARASET_TO_EEPROM if to_eeprom else Command.WRITE_PARASET
    block = encode_parameters(parameters)
    return [
        encode_command(command, part, *block[_PART_SIZE * part : _PART_SIZE * (part + 1)])
        for part in range(PARAMETER_PARTS)
    ]


def write_accepted(answer: bytes, block: bytes, *, last: bool) -> bool:
    """Whether an answer to a write says that the part was taken; the last answer carries the sum of all."""
    said = int.from_bytes(answer[1:3], "little")
    return answer[0] in (Command.WRITE_PARASET, Command.WRITE_PARASET_TO_EEPROM) and said == (
        parameter_sum(block) if last else 0
    )


def _encode_interval(interval_s: float) -> int:
    if interval_s in _INTERVALS_S:
        return _INTERVALS_S.index(interval_s)
    steps = round(interval_s / 0.05)
    if not 1 <= steps <= 16 or not math.isclose(steps * 0.05, interval_s, abs_tol=1e-6):
        raise ValueError(f"interval_s {interval_s}: 0.05 to 0.8 in steps of 0.05, or 1, or 2")
    return steps - 1 << 4 | 0xF


def _decode_interval(byte: int) -> float:
    code = byte & 0xF
    if code == 0xF:
        return round(((byte >> 4) + 1) * 0.05, 2)
    if code >= len(_INTERVALS_S):
        raise FrameError("bad_parameters", f"interval {byte:02X}h")
    return _INTERVALS_S[code]


def _pack(values: Sequence[int], *, bits: int) -> int:
    if any(not 0 <= value < 1 << bits for value in values) or len(values) * bits != 8:
        raise ValueError(f"{list(values)} does not fit one byte, {bits} bits each")
    return sum(value << bits * index for index, value in enumerate(values))


def _unpack(byte: int, *, bits: int) -> tuple[int, ...]:
    return tuple(byte >> shift & (1 << bits) - 1 for shift in range(0, 8, bits))


# ---- links


def offset_of(message: bytes) -> int | None:
    """The id offset under which an answer must come: the id repeats what the message says."""
    command, second = message[0], message[1]
    if command == Command.GET_DATA:
        return 13 + (second & 3)
    if command in (Command.GET_DATA_1TO8, Command.GET_DATA_9TO16):
        return 2 * (command - 1) + (second & 1)
    return _PLAIN_OFFSETS.get(command)


_PLAIN_OFFSETS: dict[int, int] = {
    Command.CONNECT: 1,
    Command.READ_PARASET: 6,
    Command.GET_ANALOGIN: 7,
    Command.WRITE_PARASET: 8,
    Command.WRITE_PARASET_TO_EEPROM: 9,
}

SERIAL_HEADER = 0xFF
SERIAL_SIZE = 1 + MESSAGE_SIZE + 2


def encode_serial_frame(message: bytes) -> bytes:
    """What a board sends for an 8-byte message: header, message, CRC. (Hosts send the message bare.)"""
    return bytes((SERIAL_HEADER,)) + message + crc16_usboard(message).to_bytes(2, "big")
