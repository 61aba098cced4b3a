//! Archives from text, so that mutations reach what is in an archive without keeping its checksums whole.

/// Between two entries.
const BETWEEN: &[u8] = b"\n----\n";

/// The bytes themselves where they begin as an archive does; otherwise an archive of the entries that they list: a name, a
/// new line and the content, with [`BETWEEN`] between them.
pub fn archive(data: &[u8]) -> Vec<u8> {
    if data.starts_with(b"PK\x03\x04") {
        return data.to_vec();
    }
    let (mut out, mut directory, mut count) = (Vec::new(), Vec::new(), 0u16);
    for entry in split(data) {
        let end = entry.iter().position(|&b| b == b'\n').unwrap_or(entry.len());
        let (name, content) = (&entry[..end], entry.get(end + 1..).unwrap_or_default());
        // version, flags, method (stored), time, date, checksum, both sizes, both lengths
        let mut common = Vec::new();
        [10u16, 0, 0, 0, 33].iter().for_each(|n| common.extend(n.to_le_bytes()));
        let size = content.len() as u32;
        [checksum(content), size, size].iter().for_each(|n| common.extend(n.to_le_bytes()));
        [name.len() as u16, 0].iter().for_each(|n| common.extend(n.to_le_bytes()));
        let at = (out.len() as u32).to_le_bytes();
        out.extend([&b"PK\x03\x04"[..], &common, name, content].concat());
        directory.extend([&b"PK\x01\x02\x0a\x00"[..], &common, &[0; 10], &at, name].concat());
        count += 1;
    }
    let (size, at) = ((directory.len() as u32).to_le_bytes(), (out.len() as u32).to_le_bytes());
    let count = count.to_le_bytes();
    out.extend([&directory[..], b"PK\x05\x06\0\0\0\0", &count, &count, &size, &at, &[0, 0]].concat());
    out
}

fn split(mut data: &[u8]) -> Vec<&[u8]> {
    let mut entries = Vec::new();
    while let Some(end) = data.windows(BETWEEN.len()).position(|w| w == BETWEEN) {
        entries.push(&data[..end]);
        data = &data[end + BETWEEN.len()..];
    }
    entries.push(data);
    entries
}

/// CRC-32 as in zip archives, bit by bit.
fn checksum(bytes: &[u8]) -> u32 {
    let step = |crc: u32| if crc & 1 == 1 { crc >> 1 ^ 0xedb8_8320 } else { crc >> 1 };
    !bytes.iter().fold(!0, |crc, &byte| (0..8).fold(crc ^ u32::from(byte), |crc, _| step(crc)))
}
