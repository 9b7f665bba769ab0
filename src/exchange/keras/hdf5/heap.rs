//! Entries of a group that are too many for its header: a fractal heap holds them, a version 2 B-tree lists them.

use super::{Cursor, REMEDY, Result, UNDEFINED};

/// The bytes of every entry that the tree at `tree_at` lists, in the heap at `heap_at`.
pub(super) fn objects(file: &[u8], heap_at: u64, tree_at: u64) -> Result<Vec<Cursor<'_>>> {
    let heap = Heap::read(file, heap_at)?;
    let mut tree = Cursor::signed(file, tree_at, b"BTHD")?;
    tree.take(2)?;
    let (node_len, record_len, depth) = (tree.u32()?, tree.u16()?, tree.u16()?);
    tree.take(2)?;
    let (root_at, records) = (tree.u64()?, tree.u16()?);
    // Signature, version, kind and checksum take ten bytes of a node; a record is a hash of four bytes and the heap's identifier.
    let max_records = u64::from(node_len.saturating_sub(10)) / u64::from(record_len.max(1));
    if usize::from(record_len) < 4 + heap.id_len() || depth > 1 {
        return Err(format!("a group has so many entries that their list has {depth} levels; {REMEDY}"));
    }
    let mut found = vec![];
    let mut take = |node: &mut Cursor, records: u64| -> Result<()> {
        for _ in 0..records {
            let mut record = Cursor::new(file, node.at as u64, record_len.into())?;
            node.take(record_len.into())?;
            record.take(4)?;
            found.push(heap.object(&mut record)?);
        }
        Ok(())
    };
    if records > 0 && depth == 0 {
        let mut leaf = Cursor::signed(file, root_at, b"BTLF")?;
        leaf.take(2)?;
        take(&mut leaf, records.into())?;
    } else if records > 0 {
        let mut root = Cursor::signed(file, root_at, b"BTIN")?;
        root.take(2)?;
        take(&mut root, records.into())?;
        for _ in 0..=records {
            let (leaf_at, records) = (root.u64()?, root.uint(bytes_for(max_records))?);
            if records > max_records {
                return Err("a list of entries is longer than its block".into());
            }
            let mut leaf = Cursor::signed(file, leaf_at, b"BTLF")?;
            leaf.take(2)?;
            take(&mut leaf, records)?;
        }
    }
    Ok(found)
}

/// Bytes in which numbers up to `max` are written.
fn bytes_for(max: u64) -> usize {
    (max.max(1).ilog2() / 8 + 1) as usize
}

/// A heap: blocks of growing size, which together are one space of addresses.
struct Heap<'a> {
    file: &'a [u8],
    offset_len: usize,
    length_len: usize,
    /// First address within the heap, place in the file, and length of each block.
    blocks: Vec<(u64, u64, u64)>,
}

impl<'a> Heap<'a> {
    fn read(file: &'a [u8], at: u64) -> Result<Heap<'a>> {
        let mut head = Cursor::signed(file, at, b"FRHP")?;
        head.take(3)?;
        let filters_len = head.u16()?;
        head.take(1)?;
        let max_object_len = head.u32()?;
        head.take(12 * 8)?;
        let width = head.u16()?;
        let (first_len, max_direct_len, offset_bits) = (head.u64()?, head.u64()?, head.u16()?);
        head.take(2)?;
        let (root_at, rows) = (head.u64()?, head.u16()?);
        let is_power = |len: u64| len.is_power_of_two() && len < 1 << 32;
        if filters_len != 0 || offset_bits > 64 || !is_power(first_len) || !is_power(max_direct_len) || width > 256 {
            return Err(format!("the entries of a group are in a heap of an unusual kind; {REMEDY}"));
        }
        let offset_len = usize::from(offset_bits).div_ceil(8);
        let length_len = (max_direct_len.ilog2() as usize).div_ceil(8).min(bytes_for(max_object_len.into()));
        let mut blocks = vec![];
        if rows == 0 && root_at != UNDEFINED {
            blocks.push((0, root_at, first_len));
        } else if rows > 0 {
            let direct_rows = u64::from((max_direct_len / first_len).max(1).ilog2()) + 2;
            if u64::from(rows) > direct_rows {
                return Err(format!("the entries of a group fill a heap of {rows} rows; {REMEDY}"));
            }
            let mut root = Cursor::signed(file, root_at, b"FHIB")?;
            root.take(1 + 8 + offset_len)?;
            let mut start = 0;
            for row in 0..u32::from(rows) {
                // The first two rows have blocks of one size; then it doubles with each row.
                let len = first_len << row.saturating_sub(1);
                for _ in 0..width {
                    let block_at = root.u64()?;
                    if block_at != UNDEFINED {
                        blocks.push((start, block_at, len));
                    }
                    start += len;
                }
            }
        }
        Ok(Heap { file, offset_len, length_len, blocks })
    }

    fn id_len(&self) -> usize {
        1 + self.offset_len + self.length_len
    }

    /// The object whose identifier stands at `id`.
    fn object(&self, id: &mut Cursor) -> Result<Cursor<'a>> {
        // Version 0, and an object that lies in the blocks: neither huge nor tiny.
        if id.u8()? & 0xf0 != 0 {
            return Err(format!("an entry of a group is stored by itself; {REMEDY}"));
        }
        let (offset, len) = (id.uint(self.offset_len)?, id.uint(self.length_len)?);
        let block = self.blocks.iter().rev().find(|(start, _, _)| *start <= offset);
        let block = block.filter(|(start, _, block_len)| {
            (offset - start).checked_add(len).is_some_and(|object_end| object_end <= *block_len)
        });
        let (start, block_at, _) = block.ok_or("an entry of a group is outside of its heap")?;
        Cursor::new(self.file, block_at.checked_add(offset - start).unwrap_or(UNDEFINED), len)
    }
}
