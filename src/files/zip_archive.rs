//! Reading of zip archives (PKWARE's APPNOTE 6.3.10): the directory once, then any entry by its place.
//!
//! An archive is never unpacked onto the disk, so a name in it leads nowhere. Whatever an archive declares is checked against
//! its own length and against the limit of the caller before memory is taken for it.

use std::io::{Read, Seek, SeekFrom};

use flate2::Crc;
use flate2::read::DeflateDecoder;

/// First bytes of an archive that is not empty.
pub const SIGNATURE: &[u8] = b"PK\x03\x04";

/// Archives with more entries are refused.
const MAX_ENTRIES: u64 = 1 << 20;

/// Archives whose directory is longer are refused.
const MAX_DIRECTORY_BYTES: u64 = 256 << 20;

/// Length of the end record without its comment.
const END_BYTES: usize = 22;

/// What stands in a field of 32 bits whose value is in the zip64 extra field.
const IN_ZIP64: u64 = u32::MAX as u64;

/// The directory of an archive. It holds no file handle, so threads can share it, each with a handle of its own.
#[derive(Debug)]
pub struct ZipArchive {
    entries: Vec<ZipEntry>,
}

/// One file in an archive.
#[derive(Clone, Debug, PartialEq)]
pub struct ZipEntry {
    /// Its path in the archive, as the archive says: `/` between the parts, and any bytes that the author wished.
    pub name: String,
    /// Length of its content, as the archive says; [`ZipArchive::read`] checks it.
    pub len: u64,
    packed_len: u64,
    header_at: u64,
    crc32: u32,
    method: u16,
    flags: u16,
}

impl ZipArchive {
    /// Reads the directory of the archive `source`.
    ///
    /// # Errors
    /// A message without the path if `source` cannot be read, is no zip archive, is damaged, or has more than 2²⁰ entries.
    pub fn open(source: &mut (impl Read + Seek)) -> Result<ZipArchive, String> {
        let len = source.seek(SeekFrom::End(0)).map_err(unreadable)?;
        let end = End::find(source, len)?;
        if end.entries > MAX_ENTRIES || end.directory_len > MAX_DIRECTORY_BYTES {
            return Err(format!("has {} entries, too many to be read", end.entries));
        }
        if end.directory_at.checked_add(end.directory_len).is_none_or(|directory_end| directory_end > len) {
            return Err("is no zip archive, or is damaged: its directory lies outside".into());
        }
        let directory = bytes_at(source, end.directory_at, end.directory_len)?;
        let mut rest = &directory[..];
        let mut entries = Vec::new();
        for _ in 0..end.entries {
            let damaged = || format!("is damaged: entry {} of its directory", entries.len());
            entries.push(ZipEntry::parse(&mut rest).ok_or_else(damaged)?);
        }
        Ok(ZipArchive { entries })
    }

    /// All entries, in the order of the directory; folders too, whose names end in `/`.
    pub fn entries(&self) -> &[ZipEntry] {
        &self.entries
    }

    /// The entry `name`; the last one, should there be several.
    pub fn find(&self, name: &str) -> Option<&ZipEntry> {
        self.entries.iter().rev().find(|entry| entry.name == name)
    }

    /// The content of `entry` of the archive `source`.
    ///
    /// # Errors
    /// A message that names neither the archive nor the entry if the entry is longer than `max_len`, damaged, encrypted, or
    /// packed by another method than deflate.
    pub fn read(source: &mut (impl Read + Seek), entry: &ZipEntry, max_len: u64) -> Result<Vec<u8>, String> {
        if entry.flags & 1 != 0 {
            return Err("is encrypted".into());
        }
        if entry.len > max_len {
            return Err(format!("unpacks to {} bytes; more than {max_len} are not read", entry.len));
        }
        let header = bytes_at(source, entry.header_at, 30)?;
        if !header.starts_with(SIGNATURE) {
            return Err("is damaged: nothing begins where the directory says".into());
        }
        // The lengths of name and extra field differ from those in the directory.
        let skip = u64::from(u16_at(&header, 26)) + u64::from(u16_at(&header, 28));
        source.seek(SeekFrom::Current(skip as i64)).map_err(unreadable)?;
        let packed = source.take(entry.packed_len);
        let mut content = Vec::new();
        // One byte more than declared shows that the declaration is wrong.
        let read = match entry.method {
            0 => packed.take(entry.len + 1).read_to_end(&mut content),
            8 => DeflateDecoder::new(packed).take(entry.len + 1).read_to_end(&mut content),
            other => return Err(format!("is packed by method {other}; deflate and no packing can be read")),
        };
        read.map_err(|error| format!("is damaged: {error}"))?;
        if content.len() as u64 != entry.len {
            return Err("is damaged: it has another length than the directory says".into());
        }
        let mut crc = Crc::new();
        crc.update(&content);
        match crc.sum() == entry.crc32 {
            true => Ok(content),
            false => Err("is damaged: its checksum is wrong".into()),
        }
    }
}

impl ZipEntry {
    /// Parses the first record of `rest`, and leaves what follows it.
    fn parse(rest: &mut &[u8]) -> Option<ZipEntry> {
        let (record, tail) = rest.split_at_checked(46)?;
        if !record.starts_with(b"PK\x01\x02") {
            return None;
        }
        let (name, tail) = tail.split_at_checked(usize::from(u16_at(record, 28)))?;
        let (extra, tail) = tail.split_at_checked(usize::from(u16_at(record, 30)))?;
        let (_comment, tail) = tail.split_at_checked(usize::from(u16_at(record, 32)))?;
        *rest = tail;
        let mut wide = zip64_extra(extra);
        // Those fields that do not fit stand in the extra field, in this order.
        let mut field = |at: usize| match u64::from(u32_at(record, at)) {
            IN_ZIP64 => wide.split_off(..8).map(|value| u64_at(value, 0)),
            value => Some(value),
        };
        let len = field(24)?;
        let packed_len = field(20)?;
        let header_at = field(42)?;
        Some(ZipEntry {
            name: String::from_utf8_lossy(name).into_owned(),
            len,
            packed_len,
            header_at,
            crc32: u32_at(record, 16),
            method: u16_at(record, 10),
            flags: u16_at(record, 8),
        })
    }
}

/// What the end of an archive says about its directory.
struct End {
    entries: u64,
    directory_len: u64,
    directory_at: u64,
}

impl End {
    fn find(source: &mut (impl Read + Seek), len: u64) -> Result<End, String> {
        // A comment of up to 65,535 bytes may follow; the zip64 locator (20 bytes) stands before.
        let tail_len = len.min((END_BYTES + 65_535 + 20) as u64);
        let tail = bytes_at(source, len - tail_len, tail_len)?;
        let at = (0..=tail.len().saturating_sub(END_BYTES)).rev().find(|at| {
            let record = &tail[*at..];
            record.starts_with(b"PK\x05\x06")
                && record.len() >= END_BYTES
                && END_BYTES + usize::from(u16_at(record, 20)) <= record.len()
        });
        let at = at.ok_or("is no zip archive, or is damaged: it has no end record")?;
        let end = &tail[at..];
        let locator = at.checked_sub(20).map(|locator_at| &tail[locator_at..at]);
        if let Some(locator) = locator.filter(|locator| locator.starts_with(b"PK\x06\x07")) {
            let record_at = u64_at(locator, 8);
            if record_at.checked_add(56).is_none_or(|record_end| record_end > len) {
                return Err("is damaged: its zip64 end record lies outside".into());
            }
            let record = bytes_at(source, record_at, 56)?;
            if !record.starts_with(b"PK\x06\x06") {
                return Err("is damaged: it has no zip64 end record".into());
            }
            return Ok(End {
                entries: u64_at(&record, 32),
                directory_len: u64_at(&record, 40),
                directory_at: u64_at(&record, 48),
            });
        }
        Ok(End {
            entries: u16_at(end, 10).into(),
            directory_len: u32_at(end, 12).into(),
            directory_at: u32_at(end, 16).into(),
        })
    }
}

/// The values of the zip64 extra field, if there is one.
fn zip64_extra(mut extra: &[u8]) -> &[u8] {
    while let Some((head, tail)) = extra.split_at_checked(4) {
        let Some((values, tail)) = tail.split_at_checked(usize::from(u16_at(head, 2))) else { break };
        if u16_at(head, 0) == 1 {
            return values;
        }
        extra = tail;
    }
    &[]
}

/// `len` bytes from `at` on; `len` is bounded by the caller.
fn bytes_at(source: &mut (impl Read + Seek), at: u64, len: u64) -> Result<Vec<u8>, String> {
    source.seek(SeekFrom::Start(at)).map_err(unreadable)?;
    let mut bytes = Vec::new();
    source.take(len).read_to_end(&mut bytes).map_err(unreadable)?;
    match bytes.len() as u64 == len {
        true => Ok(bytes),
        false => Err("is damaged: it ends too early".into()),
    }
}

fn unreadable(error: std::io::Error) -> String {
    format!("cannot be read: {error}")
}

fn u16_at(bytes: &[u8], at: usize) -> u16 {
    u16::from_le_bytes([bytes[at], bytes[at + 1]])
}

fn u32_at(bytes: &[u8], at: usize) -> u32 {
    u32::from(u16_at(bytes, at)) | u32::from(u16_at(bytes, at + 2)) << 16
}

fn u64_at(bytes: &[u8], at: usize) -> u64 {
    u64::from(u32_at(bytes, at)) | u64::from(u32_at(bytes, at + 4)) << 32
}

#[cfg(test)]
mod tests {
    use super::*;
    use flate2::{Compression, write::DeflateEncoder};
    use std::io::{Cursor, Write};

    /// An archive with a comment; `zip64` moves the sizes and the place of each entry into the extra field.
    fn archive(files: &[(&str, u16, &[u8])], zip64: bool) -> Vec<u8> {
        let (mut bytes, mut directory) = (Vec::new(), Vec::new());
        for (name, method, content) in files {
            let packed = match method {
                8 => {
                    let mut encoder = DeflateEncoder::new(Vec::new(), Compression::default());
                    encoder.write_all(content).unwrap();
                    encoder.finish().unwrap()
                }
                _ => content.to_vec(),
            };
            let at = bytes.len() as u64;
            let mut crc = Crc::new();
            crc.update(content);
            let sizes = [packed.len() as u64, content.len() as u64];
            let narrow = |value: u64| if zip64 { u32::MAX } else { value as u32 };
            let mut common = vec![20, 0, 0, 0];
            common.extend(method.to_le_bytes());
            common.extend([0; 4]);
            common.extend(crc.sum().to_le_bytes());
            sizes.iter().for_each(|size| common.extend(narrow(*size).to_le_bytes()));
            common.extend((name.len() as u16).to_le_bytes());
            let mut extra = Vec::new();
            if zip64 {
                // A field of another kind stands before it.
                extra.extend([0x99, 0x99, 1, 0, 7, 1, 0, 24, 0]);
                [sizes[1], sizes[0], at].iter().for_each(|value| extra.extend(value.to_le_bytes()));
            }
            bytes.extend(SIGNATURE);
            bytes.extend(&common);
            // The extra field here is another one than in the directory.
            bytes.extend([4, 0]);
            bytes.extend(name.as_bytes());
            bytes.extend([0x98, 0x99, 0, 0]);
            bytes.extend(&packed);
            directory.extend(b"PK\x01\x02\x14\0");
            directory.extend(&common);
            directory.extend((extra.len() as u16).to_le_bytes());
            directory.extend([0; 10]);
            directory.extend(narrow(at).to_le_bytes());
            directory.extend(name.as_bytes());
            directory.extend(&extra);
        }
        let (at, len) = (bytes.len() as u64, directory.len() as u64);
        bytes.extend(&directory);
        if zip64 {
            let record_at = bytes.len() as u64;
            bytes.extend(b"PK\x06\x06\x2c\0\0\0\0\0\0\0");
            bytes.extend([0; 12]);
            [files.len() as u64, files.len() as u64, len, at].iter().for_each(|v| bytes.extend(v.to_le_bytes()));
            bytes.extend(b"PK\x06\x07\0\0\0\0");
            bytes.extend(record_at.to_le_bytes());
            bytes.extend([1, 0, 0, 0]);
        }
        bytes.extend(b"PK\x05\x06\0\0\0\0");
        let count = if zip64 { u16::MAX } else { files.len() as u16 };
        bytes.extend([count.to_le_bytes(), count.to_le_bytes()].concat());
        bytes.extend([(len as u32).to_le_bytes(), (at as u32).to_le_bytes()].concat());
        bytes.extend(b"\x03\0hi!");
        bytes
    }

    fn read_all(bytes: &[u8], max_len: u64) -> Result<Vec<(String, Vec<u8>)>, String> {
        let mut source = Cursor::new(bytes);
        let archive = ZipArchive::open(&mut source)?;
        let read = |entry: &ZipEntry| Ok((entry.name.clone(), ZipArchive::read(&mut source, entry, max_len)?));
        archive.entries().iter().map(read).collect()
    }

    #[test]
    fn stored_and_deflated_entries_are_read_with_narrow_and_wide_sizes() {
        let long: Vec<u8> = (0..100_000u32).map(|i| (i / 700) as u8).collect();
        let files = [("IMG/", 0, &b""[..]), ("a.csv", 0, b"one,two"), ("IMG/b", 8, &long)];
        for zip64 in [false, true] {
            let bytes = archive(&files, zip64);
            let found = read_all(&bytes, 1 << 20).unwrap();
            assert_eq!(found, files.map(|(name, _, content)| (name.to_string(), content.to_vec())), "zip64 {zip64}");
            let directory = ZipArchive::open(&mut Cursor::new(&bytes)).unwrap();
            assert_eq!(directory.find("a.csv").unwrap().len, 7);
            assert_eq!(directory.find("b"), None);
        }
    }

    #[test]
    fn what_cannot_be_read_is_refused_with_its_reason() {
        let good = archive(&[("a", 8, &[7; 5000])], false);
        let said = |bytes: &[u8], max_len| read_all(bytes, max_len).unwrap_err();
        assert!(said(&good, 4999).contains("more than 4999"));
        assert!(said(&good[..good.len() - 4], 1 << 20).contains("no end record"));
        assert!(said(b"", 9).contains("no zip archive") && said(b"PK\x03\x04", 9).contains("no zip archive"));
        assert!(said(&archive(&[("a", 93, b"x")], false), 9).contains("method 93"));
        let directory_at = good.len() - 25 - 47;
        let changed = |at: usize, value: u8| {
            let mut bytes = good.clone();
            bytes[at] = value;
            said(&bytes, 1 << 20)
        };
        assert_eq!(&good[directory_at..directory_at + 4], b"PK\x01\x02");
        assert!(changed(directory_at + 8, 1).contains("encrypted"));
        assert!(changed(directory_at + 16, good[directory_at + 16] ^ 1).contains("checksum"));
        // It says 4999 bytes and unpacks to more: no more than it says is taken.
        assert!(changed(directory_at + 24, 0x87).contains("another length"));
        assert!(changed(directory_at + 42, 9).contains("nothing begins"));
        assert!(changed(directory_at, 0).contains("entry 0"));
        assert!(changed(good.len() - 25 + 19, 0xff).contains("lies outside"));
        assert!(changed(good.len() - 25 + 11, 0xff).contains("entry 1"), "more entries than the directory holds");
    }
}
