// ROS 2 messages in CDR (little endian) as plain objects. Alignment counts from behind the four header bytes.

const TEXT = new TextDecoder();

class Reader {
  constructor(bytes) {
    if (bytes.length < 4 || bytes[0] !== 0 || bytes[1] !== 1) throw new Error("not little-endian CDR");
    this.bytes = bytes;
    this.view = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength);
    this.at = 4;
  }
  align(size) { this.at += (size - ((this.at - 4) % size)) % size; }
  take(size) { this.align(size); const at = this.at; this.at += size; return at; }
  u8() { return this.view.getUint8(this.take(1)); }
  i32() { return this.view.getInt32(this.take(4), true); }
  u32() { return this.view.getUint32(this.take(4), true); }
  f32() { return this.view.getFloat32(this.take(4), true); }
  f64() { return this.view.getFloat64(this.take(8), true); }
  f64s(count) { return Array.from({ length: count }, () => this.f64()); }
  string() {
    const length = this.u32(), start = this.at;
    this.at += length;
    return TEXT.decode(this.bytes.subarray(start, start + Math.max(length - 1, 0)));
  }
  f32sequence() {
    const length = this.u32(), start = this.at;
    if (start + 4 * length > this.bytes.length) throw new Error("sequence longer than the message");
    this.at += 4 * length;
    return new Float32Array(this.bytes.slice(start, start + 4 * length).buffer);
  }
  i8sequence() {
    const length = this.u32(), start = this.at;
    if (start + length > this.bytes.length) throw new Error("sequence longer than the message");
    this.at += length;
    return new Int8Array(this.bytes.slice(start, start + length).buffer);
  }
  stamp() { const s = this.i32(); return s + this.u32() * 1e-9; }
  header() { return { stamp: this.stamp(), frame: this.string() }; }
  pose() {
    const [x, y, z, qx, qy, qz, qw] = this.f64s(7);
    return { x, y, z, yaw: Math.atan2(2 * (qw * qz + qx * qy), 1 - 2 * (qy * qy + qz * qz)) };
  }
}

export function laserScan(bytes) {
  const r = new Reader(bytes);
  return {
    ...r.header(), angleMin: r.f32(), angleMax: r.f32(), angleIncrement: r.f32(), timeIncrement: r.f32(),
    scanTime: r.f32(), rangeMin: r.f32(), rangeMax: r.f32(), ranges: r.f32sequence(),
  };
}

export function poseWithCovariance(bytes) {
  const r = new Reader(bytes);
  return { ...r.header(), ...r.pose(), covariance: r.f64s(36) };
}

export function occupancyGrid(bytes) {
  const r = new Reader(bytes);
  const header = r.header();
  r.stamp();
  return { ...header, resolution: r.f32(), width: r.u32(), height: r.u32(), origin: r.pose(), cells: r.i8sequence() };
}

export function occupancyGridUpdate(bytes) {
  const r = new Reader(bytes);
  return { ...r.header(), x: r.i32(), y: r.i32(), width: r.u32(), height: r.u32(), cells: r.i8sequence() };
}

export function range(bytes) {
  const r = new Reader(bytes);
  return { ...r.header(), kind: r.u8(), fieldOfView: r.f32(), min: r.f32(), max: r.f32(), range: r.f32() };
}
