//! Reading of tar archives (POSIX.1-2001 ustar and pax, and GNU's long names): the directory once, then any entry by its place.
//!
//! An archive is never unpacked, so a name in it leads nowhere. Links and devices are no files and are left out.

use std::io::{Read, Seek, SeekFrom};

/// Tar archives are made of blocks of this many bytes.
const BLOCK: u64 = 512;
/// Archives with more entries are refused.
const MAX_ENTRIES: usize = 1 << 20;
/// A longer name is no name.
const MAX_NAME_BYTES: u64 = 64 << 10;

/// One file in an archive.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct TarEntry {
    /// Its path in the archive: `/` between the parts, and any bytes that the author wished.
    pub name: String,
    /// Where its content begins.
    pub at: u64,
    /// Length of its content; it lies within the archive.
    pub len: u64,
}

/// The files in the archive `source`, in its order. An archive that ends early has the files before its end.
///
/// # Errors
/// A message without the path if `source` cannot be read, is no tar archive, or has more than 2²⁰ entries.
pub fn entries(source: &mut (impl Read + Seek)) -> Result<Vec<TarEntry>, String> {
    let end = source.seek(SeekFrom::End(0)).map_err(|e| e.to_string())?;
    let (mut entries, mut at, mut long_name) = (Vec::new(), 0, None);
    let mut header = [0; BLOCK as usize];
    while at + BLOCK <= end {
        source.seek(SeekFrom::Start(at)).map_err(|e| e.to_string())?;
        source.read_exact(&mut header).map_err(|e| e.to_string())?;
        if header.iter().all(|&byte| byte == 0) {
            break;
        }
        if !checksum_fits(&header) {
            return Err(if at == 0 { "is no tar archive".into() } else { format!("is damaged at byte {at}") });
        }
        let len = number(&header[124..136]).ok_or_else(|| format!("is damaged at byte {at}: a length"))?;
        let begin = at + BLOCK;
        at = len.div_ceil(BLOCK).checked_mul(BLOCK).and_then(|len| begin.checked_add(len)).unwrap_or(u64::MAX);
        match header[156] {
            // A name longer than the header holds comes before its entry: GNU's `L`, POSIX's `x`.
            kind @ (b'L' | b'x') if len <= MAX_NAME_BYTES && begin + len <= end => {
                let mut text = vec![0; len as usize];
                source.read_exact(&mut text).map_err(|e| e.to_string())?;
                let text = String::from_utf8_lossy(&text);
                long_name = if kind == b'L' { Some(text.trim_end_matches('\0').to_owned()) } else { pax_path(&text) };
            }
            0 | b'0' | b'7' => {
                let name = long_name.take().unwrap_or_else(|| short_name(&header));
                if begin.checked_add(len).is_some_and(|content_end| content_end <= end) {
                    entries.push(TarEntry { name, at: begin, len });
                }
                if entries.len() > MAX_ENTRIES {
                    return Err(format!("has more than {MAX_ENTRIES} entries"));
                }
            }
            _ => long_name = None,
        }
    }
    Ok(entries)
}

/// Whether `head`, the first 512 bytes of a file, begins a tar archive.
pub fn begins_tar(head: &[u8]) -> bool {
    head.first_chunk::<{ BLOCK as usize }>().is_some_and(|header| header[0] != 0 && checksum_fits(header))
}

/// The checksum is the sum of the header's bytes, with spaces where it stands.
fn checksum_fits(header: &[u8; BLOCK as usize]) -> bool {
    let sum: u64 =
        header.iter().enumerate().map(|(i, &b)| u64::from(if (148..156).contains(&i) { b' ' } else { b })).sum();
    number(&header[148..156]) == Some(sum)
}

/// A number in octal digits, or in binary where the first bit is set.
fn number(field: &[u8]) -> Option<u64> {
    if field[0] & 0x80 != 0 {
        let mut digits = field[1..].iter();
        return digits.try_fold(u64::from(field[0] & 0x7f), |number, &digit| {
            number.checked_mul(256)?.checked_add(u64::from(digit))
        });
    }
    let text = std::str::from_utf8(field).ok()?;
    u64::from_str_radix(text.trim_matches(['\0', ' ']), 8).ok()
}

/// The name in the header: a prefix of up to 155 bytes, and up to 100 more.
fn short_name(header: &[u8; BLOCK as usize]) -> String {
    let text = |bytes: &[u8]| {
        let end = bytes.iter().position(|&byte| byte == 0).unwrap_or(bytes.len());
        String::from_utf8_lossy(&bytes[..end]).into_owned()
    };
    let (name, prefix) = (text(&header[..100]), text(&header[345..500]));
    // GNU's own format has other things where the prefix would be.
    if prefix.is_empty() || &header[257..263] != b"ustar\0" { name } else { format!("{prefix}/{name}") }
}

/// The path among the records `LENGTH KEY=VALUE` of a pax header.
fn pax_path(text: &str) -> Option<String> {
    text.lines().filter_map(|record| record.split_once(' ')?.1.strip_prefix("path=")).next_back().map(str::to_owned)
}

#[cfg(test)]
pub(crate) mod testing {
    /// A tar archive of `files`, as `tar --format=ustar` would write it.
    pub(crate) fn tar(files: &[(String, Vec<u8>)]) -> Vec<u8> {
        let mut archive = Vec::new();
        for (name, bytes) in files {
            let mut header = [0u8; 512];
            header[..name.len()].copy_from_slice(name.as_bytes());
            header[100..107].copy_from_slice(b"0000644");
            header[124..135].copy_from_slice(format!("{:011o}", bytes.len()).as_bytes());
            header[148..156].fill(b' ');
            header[156] = b'0';
            header[257..263].copy_from_slice(b"ustar\0");
            let sum: u32 = header.iter().map(|&byte| u32::from(byte)).sum();
            header[148..155].copy_from_slice(format!("{sum:06o}\0").as_bytes());
            archive.extend(header);
            archive.extend(bytes);
            archive.resize(archive.len().next_multiple_of(512), 0);
        }
        archive.resize(archive.len() + 1024, 0);
        archive
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::io::Cursor;

    fn list(bytes: &[u8]) -> Result<Vec<TarEntry>, String> {
        entries(&mut Cursor::new(bytes))
    }

    #[test]
    fn entries_are_found_by_place() {
        let files = [("a/b.txt".to_owned(), b"hello".to_vec()), ("c".to_owned(), vec![7; 1000])];
        let archive = testing::tar(&files);
        let found = list(&archive).unwrap();
        assert!(begins_tar(&archive) && found.len() == 2);
        for (entry, (name, bytes)) in found.iter().zip(&files) {
            assert_eq!((&entry.name, &archive[entry.at as usize..][..entry.len as usize]), (name, &bytes[..]));
        }
        // A cut archive has what came before the cut.
        assert_eq!(list(&archive[..1100]).unwrap().len(), 1);
    }

    #[test]
    fn numbers_are_octal_or_binary_and_nothing_else() {
        assert_eq!(number(b"00000001750\0"), Some(1000));
        assert_eq!(number(b" 17\0\0\0\0\0"), Some(15));
        // In 12 bytes as GNU tar writes them, and in the 8 of a checksum.
        assert_eq!(number(&[0x80, 0, 0, 0, 0, 0, 0, 1, 0, 0, 0, 2]), Some((1 << 32) + 2));
        assert_eq!(number(&[0x80, 0, 0, 0, 0, 0, 1, 2]), Some(258));
        assert_eq!(number(&[0xff; 12]), None);
        assert_eq!(number(b"9\0\0\0\0\0\0\0"), None);
    }

    #[test]
    fn what_is_no_archive_is_refused() {
        assert!(list(&[9; 2000]).unwrap_err().contains("no tar archive"));
        assert_eq!(list(b"short"), Ok(Vec::new()));
        let mut archive = testing::tar(&[("x".into(), vec![1; 600])]);
        archive[130] = b'9';
        assert!(list(&archive).is_err());
        assert!(!begins_tar(&archive) && !begins_tar(b"PK"));
    }

    #[test]
    fn long_names_come_before_their_entries() {
        let long = format!("{}/x.jpg", "folder".repeat(30));
        let mut archive = testing::tar(&[("L".into(), [long.as_bytes(), b"\0"].concat()), ("x".into(), b"1".to_vec())]);
        archive[156] = b'L';
        archive[148..156].fill(b' ');
        let sum: u32 = archive[..512].iter().map(|&byte| u32::from(byte)).sum();
        archive[148..155].copy_from_slice(format!("{sum:06o}\0").as_bytes());
        assert_eq!(list(&archive).unwrap()[0].name, long);
    }
}
