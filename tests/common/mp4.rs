//! A reader of MP4 files that shares nothing with the writer: boxes by their names, samples by their tables.

use std::fs;
use std::path::Path;

/// One video track.
pub struct Video {
    /// Pixels in a row, and rows.
    pub size: (u16, u16),
    /// Profile of H.264: 77 is Main.
    pub profile: u8,
    /// Length of the movie and of its track, s.
    pub seconds: [f64; 2],
    pub samples: Vec<Sample>,
}

/// One picture.
pub struct Sample {
    pub start_s: f64,
    pub is_key: bool,
    pub bytes: Vec<u8>,
}

/// Name and content of each box in `bytes`; lengths must lead exactly to the end.
fn boxes(mut bytes: &[u8]) -> Vec<([u8; 4], &[u8])> {
    let mut found = vec![];
    while !bytes.is_empty() {
        let name: [u8; 4] = bytes[4..8].try_into().unwrap();
        let (len, head) = match u32_at(bytes, 0) {
            1 => (u64_at(bytes, 8) as usize, 16),
            len => (len as usize, 8),
        };
        assert!(len >= head && len <= bytes.len(), "box {} of {len} bytes", String::from_utf8_lossy(&name));
        found.push((name, &bytes[head..len]));
        bytes = &bytes[len..];
    }
    found
}

/// The content of the box at `path`, four letters a step.
fn find<'a>(mut bytes: &'a [u8], path: &str) -> &'a [u8] {
    for step in path.split('/') {
        bytes =
            boxes(bytes).into_iter().find(|(name, _)| name == step.as_bytes()).unwrap_or_else(|| panic!("{step}")).1;
    }
    bytes
}

fn u16_at(bytes: &[u8], at: usize) -> u16 {
    u16::from_be_bytes(bytes[at..at + 2].try_into().unwrap())
}

fn u32_at(bytes: &[u8], at: usize) -> u32 {
    u32::from_be_bytes(bytes[at..at + 4].try_into().unwrap())
}

fn u64_at(bytes: &[u8], at: usize) -> u64 {
    u64::from_be_bytes(bytes[at..at + 8].try_into().unwrap())
}

/// Rows of `N` numbers behind a count at 4.
fn table<const N: usize>(bytes: &[u8]) -> Vec<[u32; N]> {
    assert_eq!(bytes.len(), 8 + u32_at(bytes, 4) as usize * 4 * N);
    (0..u32_at(bytes, 4) as usize).map(|row| std::array::from_fn(|k| u32_at(bytes, 8 + 4 * (row * N + k)))).collect()
}

/// Reads `path` whole.
pub fn read(path: &Path) -> Video {
    let file = fs::read(path).unwrap();
    assert_eq!(&find(&file, "ftyp")[..4], b"isom");
    let (movie, media) = (find(&file, "moov/mvhd"), find(&file, "moov/trak/mdia/mdhd"));
    assert_eq!((movie[0], media[0]), (0, 1));
    let ticks_per_s = f64::from(u32_at(media, 20));
    let seconds = [f64::from(u32_at(movie, 16)) / f64::from(u32_at(movie, 12)), u64_at(media, 24) as f64 / ticks_per_s];
    assert_eq!(&find(&file, "moov/trak/mdia/hdlr")[8..12], b"vide");
    let tables = find(&file, "moov/trak/mdia/minf/stbl");
    let entries = find(tables, "stsd");
    let [(name, entry)] = boxes(&entries[8..])[..] else { panic!("one kind of sample") };
    assert_eq!(&name, b"avc1");
    let configuration = find(&entry[78..], "avcC");

    let sizes = find(tables, "stsz");
    assert_eq!(u32_at(sizes, 4), 0);
    let sizes: Vec<usize> = sizes[12..].chunks_exact(4).map(|size| u32_at(size, 0) as usize).collect();
    let keys = table::<1>(find(tables, "stss")).concat();
    let mut starts = vec![];
    for [count, ticks] in table(find(tables, "stts")) {
        (0..count).for_each(|_| starts.push(starts.last().map_or(0, |last| last + ticks)));
    }
    let runs = table::<3>(find(tables, "stsc"));
    let mut samples: Vec<Sample> = vec![];
    for (chunk, at) in find(tables, "co64")[8..].chunks_exact(8).map(|at| u64_at(at, 0) as usize).enumerate() {
        let run = runs.iter().rev().find(|run| run[0] as usize <= chunk + 1).unwrap();
        let mut at = at;
        for _ in 0..run[1] {
            let number = samples.len();
            let start_s = f64::from(starts[number]) / ticks_per_s;
            let bytes = file[at..at + sizes[number]].to_vec();
            at += bytes.len();
            samples.push(Sample { start_s, is_key: keys.contains(&(number as u32 + 1)), bytes });
        }
    }
    assert_eq!((samples.len(), starts.len()), (sizes.len(), sizes.len()));
    Video { size: (u16_at(entry, 24), u16_at(entry, 26)), profile: configuration[1], seconds, samples }
}
