//! Archives of recordings.

use std::collections::BTreeMap;
use std::io::Write as _;

use flate2::Compression;
use flate2::write::{DeflateEncoder, GzEncoder};

/// Files by their paths.
pub type Tree = BTreeMap<String, Vec<u8>>;

/// A .zip archive of `tree`, whose paths stand below `below`.
pub fn zip(tree: &Tree, below: &str) -> Vec<u8> {
    let (mut archive, mut directory) = (Vec::new(), Vec::new());
    for (name, bytes) in tree {
        let name = format!("{below}{name}");
        let mut packer = DeflateEncoder::new(Vec::new(), Compression::fast());
        packer.write_all(bytes).unwrap();
        let packed = packer.finish().unwrap();
        let mut crc = flate2::Crc::new();
        crc.update(bytes);
        let at = archive.len() as u32;
        let sizes = [20u16.to_le_bytes(), 0u16.to_le_bytes(), 8u16.to_le_bytes(), [0; 2], [0; 2]].concat();
        let lengths = [crc.sum(), packed.len() as u32, bytes.len() as u32].map(u32::to_le_bytes).concat();
        let names = [(name.len() as u16).to_le_bytes(), [0; 2]].concat();
        archive.extend([&b"PK\x03\x04"[..], &sizes, &lengths, &names, name.as_bytes(), &packed].concat());
        let rest = [&[0; 10][..], &at.to_le_bytes()].concat();
        directory.extend(
            [&b"PK\x01\x02"[..], &20u16.to_le_bytes(), &sizes, &lengths, &names, &rest, name.as_bytes()].concat(),
        );
    }
    let (count, at) = (tree.len() as u16, archive.len() as u32);
    archive.extend(&directory);
    let end = [count.to_le_bytes(), count.to_le_bytes()].concat();
    let places = [directory.len() as u32, at].map(u32::to_le_bytes).concat();
    archive.extend([&b"PK\x05\x06"[..], &[0; 4], &end, &places, &[0; 2]].concat());
    archive
}

/// A .tar.gz archive of `tree`.
pub fn tar_gz(tree: &Tree) -> Vec<u8> {
    let mut packer = GzEncoder::new(Vec::new(), Compression::fast());
    for (name, bytes) in tree {
        let mut header = [0u8; 512];
        header[..name.len()].copy_from_slice(name.as_bytes());
        header[124..135].copy_from_slice(format!("{:011o}", bytes.len()).as_bytes());
        header[148..156].fill(b' ');
        header[156] = b'0';
        let sum: u32 = header.iter().map(|&byte| u32::from(byte)).sum();
        header[148..155].copy_from_slice(format!("{sum:06o}\0").as_bytes());
        packer.write_all(&header).unwrap();
        packer.write_all(bytes).unwrap();
        packer.write_all(&vec![0; bytes.len().next_multiple_of(512) - bytes.len()]).unwrap();
    }
    packer.write_all(&[0; 1024]).unwrap();
    packer.finish().unwrap()
}
