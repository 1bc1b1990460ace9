// A folder as one zip, without holding it in memory: files are stored as they are, and the zip is a Blob of their parts.
// Equal folders give equal bytes (sorted names, no dates), so that a broken upload of one can go on later.

const TABLE = Uint32Array.from({ length: 256 }, (_, index) => {
  let value = index;
  for (let bit = 0; bit < 8; bit += 1) value = value & 1 ? (value >>> 1) ^ 0xedb88320 : value >>> 1;
  return value;
});
const MOST_32 = 0xffffffff;
const MOST_16 = 0xffff;
const DATE = 0x21; // 1 January 1980, the earliest there is
const UTF8 = 0x0800;

async function crc32(file, onBytes) {
  let crc = MOST_32;
  const reader = file.stream().getReader();
  for (;;) {
    const { done, value } = await reader.read();
    if (done) return (crc ^ MOST_32) >>> 0;
    for (let index = 0; index < value.length; index += 1) crc = TABLE[(crc ^ value[index]) & 255] ^ (crc >>> 8);
    onBytes(value.length);
  }
}

/** Little-endian numbers, each [bytes, value]. */
function packed(...fields) {
  const view = new DataView(new ArrayBuffer(fields.reduce((sum, [size]) => sum + size, 0)));
  let at = 0;
  for (const [size, value] of fields) {
    if (size === 8) view.setBigUint64(at, BigInt(value), true);
    else if (size === 4) view.setUint32(at, value, true);
    else view.setUint16(at, value, true);
    at += size;
  }
  return new Uint8Array(view.buffer);
}

/** The parts of a zip, in order. entries: {name, size, crc, body}. ZIP64 only where it is needed. */
export function zipParts(entries) {
  const encoder = new TextEncoder();
  const parts = [];
  const directory = [];
  let offset = 0;
  for (const { name, size, crc, body } of entries) {
    const label = encoder.encode(name);
    const large = size >= MOST_32;
    const far = offset >= MOST_32;
    const shown = large ? MOST_32 : size;
    const version = large || far ? 45 : 20;
    const sizes = large ? [[8, size], [8, size]] : [];
    const local = large ? packed([2, 1], [2, 16], ...sizes) : new Uint8Array();
    parts.push(
      packed([4, 0x04034b50], [2, version], [2, UTF8], [2, 0], [2, 0], [2, DATE], [4, crc], [4, shown], [4, shown],
        [2, label.length], [2, local.length]),
      label, local, body);
    const wide = [...sizes, ...(far ? [[8, offset]] : [])];
    const extra = wide.length ? packed([2, 1], [2, 8 * wide.length], ...wide) : new Uint8Array();
    directory.push(
      packed([4, 0x02014b50], [2, version], [2, version], [2, UTF8], [2, 0], [2, 0], [2, DATE], [4, crc], [4, shown],
        [4, shown], [2, label.length], [2, extra.length], [2, 0], [2, 0], [2, 0], [4, 0], [4, far ? MOST_32 : offset]),
      label, extra);
    offset += 30 + label.length + local.length + size;
  }
  const size = directory.reduce((sum, part) => sum + part.length, 0);
  const many = entries.length;
  if (offset >= MOST_32 || many >= MOST_16) {
    directory.push(
      packed([4, 0x06064b50], [8, 44], [2, 45], [2, 45], [4, 0], [4, 0], [8, many], [8, many], [8, size], [8, offset]),
      packed([4, 0x07064b50], [4, 0], [8, offset + size], [4, 1]));
  }
  const total = Math.min(many, MOST_16);
  const end = packed([4, 0x06054b50], [2, 0], [2, 0], [2, total], [2, total], [4, Math.min(size, MOST_32)],
    [4, Math.min(offset, MOST_32)], [2, 0]);
  return [...parts, ...directory, end];
}

/** Reads every file once, for its checksum. files: {name, file}. onBytes: called with bytes read so far. */
export async function zipped(files, onBytes = () => {}) {
  let read = 0;
  const entries = [];
  for (const { name, file } of [...files].sort((a, b) => (a.name < b.name ? -1 : 1))) {
    const crc = await crc32(file, (count) => onBytes((read += count)));
    entries.push({ name, size: file.size, crc, body: file });
  }
  return new Blob(zipParts(entries), { type: "application/zip" });
}

/** Names and sizes of what a zip holds; null if it is no zip, or one too large to look into here. */
export async function zipDirectory(file) {
  const tail = new DataView(await file.slice(Math.max(0, file.size - 65557)).arrayBuffer());
  let at = tail.byteLength - 22;
  while (at >= 0 && tail.getUint32(at, true) !== 0x06054b50) at -= 1;
  if (at < 0) return { ok: false, entries: null };
  const [size, offset] = [tail.getUint32(at + 12, true), tail.getUint32(at + 16, true)];
  if (offset === MOST_32 || tail.getUint16(at + 10, true) === MOST_16) return { ok: true, entries: null };
  const buffer = await file.slice(offset, offset + size).arrayBuffer();
  const view = new DataView(buffer);
  const decoder = new TextDecoder();
  const entries = [];
  for (let here = 0; here + 46 <= buffer.byteLength && view.getUint32(here, true) === 0x02014b50;) {
    const [label, extra, comment] = [28, 30, 32].map((field) => view.getUint16(here + field, true));
    const name = decoder.decode(new Uint8Array(buffer, here + 46, label));
    if (!name.endsWith("/")) {
      entries.push({ name, size: view.getUint32(here + 24, true), encrypted: Boolean(view.getUint16(here + 8, true) & 1) });
    }
    here += 46 + label + extra + comment;
  }
  return { ok: true, entries };
}
