//! What is in an HDF5 file: attributes that are lists of strings, and tensors of floating-point numbers.

use std::ops::Range;
use std::sync::Arc;

use super::{Cursor, DATASPACE, DATATYPE, FILTERS, LAYOUT, Object, REMEDY, Result, UNDEFINED, text};

/// The strings of an attribute are together at most this many times as long as the file: several may lie in the same place.
const MAX_STRING_INFLATION: usize = 4;

/// A value that is attached to a group.
pub struct Attribute {
    /// Its name.
    pub name: String,
    /// Extent of each axis; none for a single value.
    pub shape: Vec<u64>,
    file: Arc<[u8]>,
    datatype: Datatype,
    values: Range<usize>,
}

impl Attribute {
    /// Parses the content of a message.
    pub(super) fn parse(file: &Arc<[u8]>, mut message: Cursor) -> Result<Attribute> {
        let version = message.u8()?;
        let flags = message.u8()?;
        let lens = [message.u16()?, message.u16()?, message.u16()?];
        if !(1..=3).contains(&version) || version > 1 && flags != 0 {
            return Err(format!("an attribute of version {version} with flags {flags}; {REMEDY}"));
        }
        message.take(if version == 3 { 1 } else { 0 })?;
        // Version 1 pads each part to eight bytes.
        let mut part = |len: u16| {
            let (at, padded) =
                (message.at, if version == 1 { usize::from(len).next_multiple_of(8) } else { len.into() });
            message.take(padded)?;
            Cursor::new(file, at as u64, len.into())
        };
        let [mut name, mut datatype, mut dataspace] = [part(lens[0])?, part(lens[1])?, part(lens[2])?];
        let name = text(name.take(lens[0].into())?)?;
        let (datatype, shape) = (Datatype::parse(&mut datatype)?, shape(&mut dataspace)?);
        Ok(Attribute { name, shape, file: file.clone(), datatype, values: message.at..message.end })
    }

    /// The strings, row-major.
    pub fn strings(&self) -> Result<Vec<String>> {
        let count = elements(&self.shape)?;
        let mut values = Cursor { file: &self.file, at: self.values.start, end: self.values.end };
        let (mut strings, mut total_len) = (vec![], 0);
        for _ in 0..count {
            let bytes = match self.datatype {
                Datatype::FixedString { len: 0 } => return Err("strings of no length".into()),
                Datatype::FixedString { len } => values.take(len)?,
                Datatype::String => {
                    let (len, heap_at, index) = (values.u32()?, values.u64()?, values.u32()?);
                    if len == 0 { &[][..] } else { heap_object(&self.file, heap_at, index)?.take(len as usize)? }
                }
                _ => return Err("numbers".into()),
            };
            total_len += bytes.len();
            if total_len > self.file.len().saturating_mul(MAX_STRING_INFLATION) {
                return Err("strings that are longer than the file".into());
            }
            let len = bytes.iter().position(|byte| *byte == 0).unwrap_or(bytes.len());
            strings.push(String::from_utf8(bytes[..len].to_vec()).map_err(|_| "bytes that are no text")?);
        }
        Ok(strings)
    }
}

/// Object `index` of the collection of strings at address `at`.
fn heap_object(file: &[u8], at: u64, index: u32) -> Result<Cursor<'_>> {
    let mut heap = Cursor::signed(file, at, b"GCOL")?;
    heap.take(4)?;
    let len = heap.u64()?;
    let mut heap = Cursor::new(file, at, len)?;
    heap.take(16)?;
    // An index has 16 bits, so an honest collection has fewer objects.
    for _ in 0..=u16::MAX {
        let found = heap.u16()?;
        heap.take(6)?;
        let len = heap.u64()?;
        if u32::from(found) == index && found != 0 {
            return Cursor::new(file, heap.at as u64, len);
        }
        let padded = usize::try_from(len).ok().and_then(|len| len.checked_next_multiple_of(8));
        heap.take(padded.filter(|_| found != 0).ok_or("a string is not in its heap")?)?;
    }
    Err("a string is not in its heap".into())
}

/// What the numbers or strings of an attribute or tensor are.
#[derive(Clone, Copy, PartialEq)]
enum Datatype {
    FixedString { len: usize },
    String,
    Float { bytes: usize, is_big_endian: bool },
    Other,
}

impl Datatype {
    fn parse(message: &mut Cursor) -> Result<Datatype> {
        let kind = message.u8()? & 0x0f;
        let flags = message.uint(3)?;
        let len = message.u32()? as usize;
        Ok(match kind {
            1 => {
                let (offset, bits) = (message.u16()?, message.u16()?);
                let [_, exponent_bits, _, mantissa_bits] = [message.u8()?, message.u8()?, message.u8()?, message.u8()?];
                // IEEE 754, little-endian or big-endian; bit 6 stands for the order of the VAX.
                match (len, offset, bits, exponent_bits, mantissa_bits) {
                    (4, 0, 32, 8, 23) | (8, 0, 64, 11, 52) if flags & 0x40 == 0 => {
                        Datatype::Float { bytes: len, is_big_endian: flags & 1 != 0 }
                    }
                    _ => Datatype::Other,
                }
            }
            3 => Datatype::FixedString { len },
            9 if flags & 0x0f == 1 && len == 16 => Datatype::String,
            _ => Datatype::Other,
        })
    }
}

/// Extent of each axis of a dataspace.
fn shape(message: &mut Cursor) -> Result<Vec<u64>> {
    let (version, rank, _flags, kind) = (message.u8()?, message.u8()?, message.u8()?, message.u8()?);
    match version {
        1 => drop(message.take(4)?),
        // No values at all.
        2 if kind == 2 => return Ok(vec![0]),
        2 => {}
        _ => return Err(format!("a dataspace of version {version}")),
    }
    (0..rank).map(|_| message.u64()).collect()
}

fn elements(shape: &[u64]) -> Result<usize> {
    let count = shape.iter().try_fold(1u64, |count, extent| count.checked_mul(*extent));
    count
        .and_then(|count| usize::try_from(count).ok())
        .ok_or_else(|| format!("the shape {shape:?} has too many elements"))
}

/// A tensor.
#[derive(Clone)]
pub struct Dataset {
    object: Object,
    shape: Vec<u64>,
}

impl Dataset {
    /// The tensor that `object` is.
    pub(super) fn new(object: Object) -> Result<Dataset> {
        let shape = shape(&mut object.first(DATASPACE)?)?;
        Ok(Dataset { object, shape })
    }

    /// Its name within the group.
    pub fn name(&self) -> &str {
        &self.object.name
    }

    /// Extent of each axis.
    pub fn shape(&self) -> &[u64] {
        &self.shape
    }

    /// The numbers, row-major.
    pub fn read(&self) -> Result<Vec<f32>> {
        let Datatype::Float { bytes, is_big_endian } = Datatype::parse(&mut self.object.first(DATATYPE)?)? else {
            return Err("its numbers are neither float32 nor float64".into());
        };
        let count = elements(&self.shape)?;
        let len = count.checked_mul(bytes).ok_or("it has too many elements")?;
        let mut values = self.values(len)?;
        let values = values.take(len)?;
        let number = |value: &[u8]| {
            // Eight bytes, the last ones first; numbers of four bytes in the lower half.
            let mut number = [0; 8];
            number[..bytes].copy_from_slice(value);
            if is_big_endian {
                number[..bytes].reverse();
            }
            let number = u64::from_le_bytes(number);
            if bytes == 4 { f32::from_bits(number as u32) } else { f64::from_bits(number) as f32 }
        };
        Ok(values.chunks_exact(bytes).map(number).collect())
    }

    /// Where the `len` bytes of the numbers are.
    fn values(&self, len: usize) -> Result<Cursor<'_>> {
        if len == 0 {
            return Cursor::new(&self.object.file, 0, 0);
        }
        let mut layout = self.object.first(LAYOUT)?;
        let version = layout.u8()?;
        let kind = match version {
            1..=2 => {
                let (_rank, kind) = (layout.u8()?, layout.u8()?);
                layout.take(5)?;
                kind
            }
            3..=4 => layout.u8()?,
            _ => return Err(format!("a layout of version {version}; {REMEDY}")),
        };
        match kind {
            0 if version >= 3 => {
                let len = layout.u16()?;
                Cursor::new(&self.object.file, layout.at as u64, len.into())
            }
            1 if !self.object.has(FILTERS) => match layout.u64()? {
                UNDEFINED => Err("it was never written".into()),
                at => Cursor::new(&self.object.file, at, len as u64),
            },
            _ => Err(format!("it is stored in chunks or compressed; {REMEDY}")),
        }
    }
}
