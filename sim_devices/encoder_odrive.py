"""One axis of an ODrive on CANSimple, firmware 0.5.x or 0.6.x; a robot has one for each wheel.

Source: ODrive's protocol pages and message descriptions (DBC) of 0.5.6 and 0.6.10, and its open firmware.

    11-bit id = node << 5 | command; little-endian. A value is asked for by a remote frame, or an empty one, of its id.
    01 heartbeat, 100 ms    09 encoder estimates, 10 ms: f32 revolutions, f32 revolutions/s
    0A counts (0.5.x, when asked)    07 axis state    0B-0E modes, position, velocity, torque    0F limits
    03 errors    14 Iq    16 reboot    17 bus voltage and current    18 clear errors    19 set position
    06 address (0.6.x): node, serial number; asked of all by node 3F    04, 05 values of its tree (0.6.x), by number

Heartbeat: u32 axis error, u8 state, then 0.5.x: motor, encoder and controller error flags, bit 7 of the last byte says
trajectory done; 0.6.x: procedure result, trajectory done, 0.

Habits kept: velocity moves the wheel in closed loop only; a calibration takes seconds and ends in idle; positions are
32-bit floats, so their steps grow with the way; the estimates start at 0 with every start and reboot (incremental
encoder); an error disarms. Commands longer than needed are taken; of shorter ones the missing bytes count as 0 (hosts
in use send the axis state as one byte). A board whose node id another one is given has none (3F): it answers who asks
for addresses and says nothing else. An id that was not saved is forgotten in a reboot.

Assumed: until a host sets a mode, the board has the one that fits what it is told; torque mode moves nothing; a target
position is reached at the velocity limit; closed loop is entered without a calibration before, as a board with stored
calibration does; 0.6.x sends what `cyclic_ms` names besides. Which value of the tree has which number depends on the
firmware: each number reads 0 until it is written, and then what was written.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from math import floor

from sim_devices.device import Frame
from sim_devices.wheel import Undo, Wheel
from sim_devices.wire import SECOND_NS

MILLISECOND_NS = 1_000_000
IDLE, CLOSED_LOOP = 1, 8
CALIBRATIONS_S = {3: 6.0, 4: 2.0, 6: 2.0, 7: 4.0, 10: 2.0, 11: 3.0}
VELOCITY_CONTROL, POSITION_CONTROL = 2, 3
BOOT_NS = 300 * MILLISECOND_NS
SUCCESS, BUSY, CANCELLED = 0, 1, 2
INVALID_STATE = 0x01
EVERYBODY = 0x3F  # as address; as a node's own: none
TREE_READ, TREE_WRITE = 0, 1
SAVE, ERASE = 1, 2  # of a reboot
ESTOP_REQUESTED = 0x4000
TREE, TREE_ANSWER = 0x04, 0x05  # 0.6.x; errors of encoder and sensorless estimator in 0.5.x
FAILED_PARTS = (0x40, 0x100, 0x200)  # bits of a 0.5.x axis error: motor, encoder, controller
(
    VERSION, HEARTBEAT, ESTOP, ERROR, ENCODER_ERROR, SENSORLESS_ERROR, ADDRESS, STATE, _, ESTIMATES, COUNTS, MODES, POS,
    VEL, TORQUE, LIMITS, ANTICOGGING, TRAJ_VEL, TRAJ_ACCEL, TRAJ_INERTIA, IQ, TEMPERATURE, REBOOT, BUS, CLEAR,
    SET_POSITION, POS_GAIN, VEL_GAINS, TORQUES, POWERS,
) = range(30)  # fmt: skip


class ODriveAxis:
    """One axis. The first step is power-on.

    wheel: what its motor turns; one of its turns is `gear` turns of the motor.  cpr: counts of the encoder a motor turn
    (its sign is the wheel's business).  sign: -1 for a motor mounted the other way round.  generation: "0.5" or "0.6".
    start_turns: what the position reads at power-on.  cyclic_ms: periods of messages sent unasked, by command.
    serial: 48 bits; None makes one of the node id.
    """

    fault_family = "encoder"

    def __init__(
        self,
        wheel: Wheel,
        node: int,
        *,
        generation: str = "0.6",
        gear: float = 1.0,
        sign: int = 1,
        cpr: int = 8192,
        start_turns: float = 0.0,
        cyclic_ms: Mapping[int, int] | None = None,
        bus_v: float = 24.0,
        serial: int | None = None,
    ) -> None:
        if not 0 <= node <= 0x3E:
            raise ValueError("an ODrive has a node id from 0 to 62")
        if generation not in ("0.5", "0.6"):
            raise ValueError("ODrive firmware is of generation 0.5 or 0.6")
        self.wheel = wheel
        self.node = node
        self.is_new = generation == "0.6"
        self.cpr = cpr
        self.bus_v = bus_v
        self.error = 0
        self._gear = gear
        self._sign = sign
        self._start_turns = start_turns
        self._cyclic_ns = {
            command: period * MILLISECOND_NS
            for command, period in ({HEARTBEAT: 100, ESTIMATES: 10} | dict(cyclic_ms or {})).items()
            if period
        }
        self._serial = 0x3A5B7C9D1E00 + node if serial is None else serial
        self._saved_node = node
        self._tree: dict[int, bytes] = {}
        self._powered = False
        self._begin(0)

    # -- what the bus and the tests see -------------------------------------------------------------------------------

    def step(self, now_ns: int, received: Sequence[Frame]) -> list[Frame]:
        """Advance to now_ns; returns the frames it sends, in order."""
        if not self._powered:
            self.power_on(now_ns)
        out: list[Frame] = []
        self._timers(now_ns, out)
        if now_ns >= self._awake_ns:
            for frame in received:
                self._hear(frame, now_ns, out)
        return out

    @property
    def next_ns(self) -> int | None:
        """When it wants to send next."""
        return min((*self._due_ns.values(), *(at for at in (self._done_ns, self._arrival_ns) if at is not None)))

    def power_on(self, now_ns: int) -> None:
        """Power comes, or a reboot: idle, no errors, position as at every start."""
        self._powered = True
        self._begin(now_ns)
        self._awake_ns = now_ns + BOOT_NS
        self._due_ns.update(dict.fromkeys(self._cyclic_ns, self._awake_ns))
        self._zero_turns = self._raw_turns(now_ns) - self._start_turns
        self.wheel.drive(now_ns, 0.0)

    def turns(self, now_ns: int) -> float:
        """What the position estimate reads, before it becomes a 32-bit float."""
        return self._raw_turns(now_ns) - self._zero_turns

    def inflict(self, kind: str, value: float, arguments: Mapping[str, float], now_ns: int) -> Undo | None:
        """See wheel.Faulty. `wrap` puts the count of 0A before its end; the position is then beyond a float's steps."""
        if kind == "reset":
            self.power_on(now_ns)
        elif kind == "wrap":
            steps = -round(value) if not arguments.get("down") else round(value) - (1 << 32)
            self._zero_turns = self._raw_turns(now_ns) - ((1 << 31) + steps) / self.cpr
        elif kind == "alarm":
            self._fail(round(value), now_ns)
            return lambda _: self._clear()
        return None

    # -- state --------------------------------------------------------------------------------------------------------

    def _begin(self, now_ns: int) -> None:
        self.state = IDLE
        self.error = 0
        self.disarm_reason = 0
        self.procedure_result = SUCCESS
        self.trajectory_done = True
        self._mode: int | None = None
        self._velocity_limit = 20.0
        self._awake_ns = now_ns
        self._done_ns: int | None = None  # of a calibration
        self._arrival_ns: int | None = None  # at a target position
        self._due_ns: dict[int, int] = {}
        self._zero_turns = 0.0

    def _raw_turns(self, now_ns: int) -> float:
        return self.wheel.turns(now_ns) * self._gear * self._sign

    def _speed(self, now_ns: int) -> float:
        window_ns = 10 * MILLISECOND_NS
        return (self._raw_turns(now_ns) - self._raw_turns(now_ns - window_ns)) * SECOND_NS / window_ns

    def _timers(self, now_ns: int, out: list[Frame]) -> None:
        if self._done_ns is not None and now_ns >= self._done_ns:
            self._enter(IDLE, SUCCESS)
        if self._arrival_ns is not None and now_ns >= self._arrival_ns:
            self._turn(self._arrival_ns, 0.0)
        while (at_ns := min(self._due_ns.values())) <= now_ns:
            for command, due_ns in sorted(self._due_ns.items()):
                if due_ns == at_ns:
                    stale = now_ns - at_ns > SECOND_NS
                    if self.node != EVERYBODY:
                        out.append(self._frame(command, self._value(command, now_ns if stale else at_ns)))
                    self._due_ns[command] = (now_ns if stale else at_ns) + self._cyclic_ns[command]

    def _enter(self, state: int, result: int) -> None:
        self.state, self.procedure_result, self._done_ns = state, result, None

    def _request(self, state: int, now_ns: int) -> None:
        """The state that the host asks for."""
        self._turn(now_ns, 0.0)
        if state in (0, IDLE):
            self._enter(IDLE, CANCELLED if self._done_ns is not None else SUCCESS)
        elif self.error:
            self._enter(IDLE, CANCELLED)
        elif state == CLOSED_LOOP:
            self._enter(CLOSED_LOOP, SUCCESS)
        elif state in CALIBRATIONS_S:
            self._enter(state, BUSY)
            self._done_ns = now_ns + round(CALIBRATIONS_S[state] * SECOND_NS)
        else:
            self._fail(INVALID_STATE, now_ns)

    def _fail(self, error: int, now_ns: int) -> None:
        self.error |= error
        self.disarm_reason = error
        self._turn(now_ns, 0.0)
        self._enter(IDLE, CANCELLED)

    def _clear(self) -> None:
        self.error = 0
        self.disarm_reason = 0

    def _turn(self, now_ns: int, motor_turns_per_s: float) -> None:
        self._arrival_ns = None
        self.trajectory_done = True
        self.wheel.drive(now_ns, motor_turns_per_s * self._sign / self._gear * self.wheel.ticks_per_turn)

    # -- frames -------------------------------------------------------------------------------------------------------

    def _frame(self, command: int, data: bytes) -> Frame:
        return Frame(self.node << 5 | command, data)

    def _hear(self, frame: Frame, now_ns: int, out: list[Frame]) -> None:
        if frame.extended or frame.can_id >> 5 not in (self.node, EVERYBODY):
            return
        command = frame.can_id & 0x1F
        if frame.remote or not frame.data:
            value = b"" if command == HEARTBEAT and not self.is_new else self._value(command, now_ns)
            if value:
                out.append(self._frame(command, value))
                return
        if not frame.remote and command == TREE and self.is_new:
            out += self._look_up(frame.data)
        elif not frame.remote:
            self._obey(command, frame.data, now_ns)

    def _value(self, command: int, now_ns: int) -> bytes:
        """What a message of this command says; nothing if there is none."""
        match command:
            case 0x01:
                return self._heartbeat()
            case 0x03:
                return struct.pack("<II", self.error, self.disarm_reason) if self.is_new else bytes(8)
            case 0x09:
                return struct.pack("<ff", self.turns(now_ns), self._speed(now_ns))
            case 0x14:
                return struct.pack("<ff", 0.0, 0.0)
            case 0x17:
                return struct.pack("<ff", self.bus_v, 0.0)
        return self._value_of_new(command) if self.is_new else self._value_of_old(command, now_ns)

    def _value_of_old(self, command: int, now_ns: int) -> bytes:
        match command:
            case 0x04 | 0x05 | 0x1D:
                return bytes(8)
            case 0x0A:
                count = floor(self.turns(now_ns) * self.cpr)
                running = (count + (1 << 31)) % (1 << 32) - (1 << 31)
                return struct.pack("<ii", running, count % self.cpr)
            case 0x15:
                return struct.pack("<ff", 0.0, 0.0)
            case 0x1C:
                return struct.pack("<f4x", 0.0)
        return b""

    def _value_of_new(self, command: int) -> bytes:
        match command:
            case 0x00:
                return bytes((2, 4, 4, 58, 0, 6, 10, 0))
            case 0x06:
                return bytes((self.node,)) + self._serial.to_bytes(6, "little")
            case 0x15:
                return struct.pack("<ff", 30.0, 25.0)
            case 0x1C | 0x1D:
                return struct.pack("<ff", 0.0, 0.0)
        return b""

    def _heartbeat(self) -> bytes:
        if self.is_new:
            tail = (self.procedure_result, int(self.trajectory_done), 0)
        else:
            motor, encoder, controller = (int(bool(self.error & part)) for part in FAILED_PARTS)
            tail = (motor, encoder, controller | (0x80 if self.trajectory_done else 0))
        return struct.pack("<IB3B", self.error, self.state, *tail)

    def _obey(self, command: int, told: bytes, now_ns: int) -> None:
        data = told.ljust(8, b"\0") if told else b""
        if command == ESTOP:
            self._fail(ESTOP_REQUESTED, now_ns)
        elif command == REBOOT:
            self._reboot(data[0] if data else 0, now_ns)
        elif command == CLEAR:
            self._clear()
        elif command == STATE and len(data) >= 4:
            self._request(int.from_bytes(data[:4], "little"), now_ns)
        elif command == MODES and len(data) >= 8:
            self._mode = int.from_bytes(data[:4], "little")
        elif command == LIMITS and len(data) >= 4:
            self._velocity_limit = abs(struct.unpack("<f", data[:4])[0])
        elif command == ADDRESS and data:
            self._take_address(told)
        elif command == SET_POSITION and len(data) >= 4:
            place = struct.unpack("<f" if self.is_new else "<i", data[:4])[0]
            self._zero_turns = self._raw_turns(now_ns) - (place if self.is_new else place / self.cpr)
        elif command in (POS, VEL) and len(data) >= 4 and self.state == CLOSED_LOOP:
            self._move(command, struct.unpack("<f", data[:4])[0], now_ns)

    def _reboot(self, how: int, now_ns: int) -> None:
        """Saves its node id, or forgets it with all else that was saved, or goes back to the saved one."""
        if self.is_new:
            if how == SAVE:
                self._saved_node = self.node
            elif how == ERASE:
                self._saved_node, self._tree = EVERYBODY, {}
            self.node = self._saved_node
        self.power_on(now_ns)

    def _take_address(self, data: bytes) -> None:
        """A new node id; 0.6.x takes it if the serial number fits, and gives up its own to another board."""
        if self.is_new and data[1:7] not in (b"", self._serial.to_bytes(6, "little")):
            if data[0] == self.node:
                self.node = EVERYBODY
        elif data[0] < EVERYBODY or (self.is_new and data[0] == EVERYBODY):
            self.node = data[0]

    def _look_up(self, data: bytes) -> list[Frame]:
        """A value of the tree, read or written: which, its number, 0, its bytes."""
        if len(data) < 4:
            return []
        what, number = data[0], int.from_bytes(data[1:3], "little")
        if what == TREE_WRITE:
            self._tree[number] = data[4:].ljust(4, b"\0")
            return []
        if what != TREE_READ:
            return []
        return [self._frame(TREE_ANSWER, bytes((0, *data[1:3], 0)) + self._tree.get(number, bytes(4)))]

    def _move(self, command: int, target: float, now_ns: int) -> None:
        if not abs(target) < 1e9:  # not a number, or none a motor could follow
            return
        if command == VEL and self._mode in (None, VELOCITY_CONTROL):
            self._turn(now_ns, max(-self._velocity_limit, min(self._velocity_limit, target)))
        elif command == POS and self._mode in (None, POSITION_CONTROL) and self._velocity_limit > 0.0:
            ahead = target - self.turns(now_ns)
            self._turn(now_ns, self._velocity_limit if ahead > 0 else -self._velocity_limit)
            self._arrival_ns = now_ns + round(abs(ahead) / self._velocity_limit * SECOND_NS)
            self.trajectory_done = False
