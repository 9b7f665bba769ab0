//! An MP4 file with one track of H.264 (ISO/IEC 14496-12 and -15).
//!
//! The file is `ftyp`, `mdat`, `moov`: coded pictures go to the disk as they come, and the index, of about eight bytes a
//! picture, is kept in memory and written last. Nothing of a picture is kept.

use std::io::{self, Seek, SeekFrom, Write};

/// Ticks of the file's clock in a second.
pub const TICKS_PER_S: u32 = 90_000;

/// The movie as a whole is timed in milliseconds; 32 bits of them are 49 days.
const MOVIE_TICKS_PER_S: u64 = 1000;

/// Turns nothing and scales nothing: the unit matrix, in 16.16 and 2.30 fixed point.
const UNIT_MATRIX: [u32; 9] = [1 << 16, 0, 0, 0, 1 << 16, 0, 0, 0, 1 << 30];

/// What the header of a track says about its pictures.
pub struct TrackHeader {
    /// Pixels in a row.
    pub width: u16,
    /// Rows.
    pub height: u16,
    /// The sequence parameter set, without start code.
    pub sequence: Vec<u8>,
    /// The picture parameter set, without start code.
    pub picture: Vec<u8>,
    /// How long each picture is shown, in ticks.
    pub ticks_per_frame: u32,
}

/// Writes a file, picture by picture.
pub struct Mp4Writer<W: Write + Seek> {
    out: W,
    header: TrackHeader,
    /// Where `mdat` begins.
    data_at: u64,
    /// Where the next picture goes.
    end: u64,
    /// Bytes of each picture.
    lengths: Vec<u32>,
    /// Numbers of the pictures that stand alone, from 1. Each begins a chunk.
    keys: Vec<u32>,
    /// Where each chunk begins.
    chunks: Vec<u64>,
}

impl<W: Write + Seek> Mp4Writer<W> {
    /// Begins a file at the place where `out` stands, which must be its start.
    ///
    /// # Errors
    /// What `out` answers; [`io::ErrorKind::InvalidInput`] if the parameter sets are no parameter sets.
    pub fn begin(mut out: W, header: TrackHeader) -> io::Result<Mp4Writer<W>> {
        if header.sequence.len() < 4 || header.picture.is_empty() {
            return Err(io::Error::new(io::ErrorKind::InvalidInput, "the first picture has no parameter sets"));
        }
        let mut ftyp = Boxes::default();
        ftyp.put(b"ftyp", |b| b.bytes(b"isom").u32(512).bytes(b"isomiso2avc1mp41"));
        out.write_all(&ftyp.0)?;
        let data_at = ftyp.0.len() as u64;
        // A length of 1 means that 64 bits of length follow the name; they are known at the end.
        out.write_all(b"\0\0\0\x01mdat\0\0\0\0\0\0\0\0")?;
        let end = data_at + 16;
        Ok(Mp4Writer { out, header, data_at, end, lengths: vec![], keys: vec![], chunks: vec![] })
    }

    /// Adds a coded picture: its units, each behind its length in 32 bits, big-endian. The first picture must stand alone.
    ///
    /// # Errors
    /// What the file answers; [`io::ErrorKind::InvalidInput`] for a picture of 4 GB.
    pub fn write(&mut self, picture: &[u8], stands_alone: bool) -> io::Result<()> {
        let length = u32::try_from(picture.len()).map_err(|e| io::Error::new(io::ErrorKind::InvalidInput, e))?;
        self.out.write_all(picture)?;
        if stands_alone || self.chunks.is_empty() {
            self.chunks.push(self.end);
            self.keys.push(self.lengths.len() as u32 + 1);
        }
        self.lengths.push(length);
        self.end += u64::from(length);
        Ok(())
    }

    /// Writes the index, and gives back what was written to.
    ///
    /// # Errors
    /// What the file answers.
    pub fn finish(mut self) -> io::Result<W> {
        let mut index = Boxes::default();
        index.put(b"moov", |b| self.movie(b));
        self.out.write_all(&index.0)?;
        self.out.seek(SeekFrom::Start(self.data_at + 8))?;
        self.out.write_all(&(self.end - self.data_at).to_be_bytes())?;
        self.out.flush()?;
        Ok(self.out)
    }

    fn movie<'a>(&self, b: &'a mut Boxes) -> &'a mut Boxes {
        let ticks = self.lengths.len() as u64 * u64::from(self.header.ticks_per_frame);
        let movie_ticks = (ticks * MOVIE_TICKS_PER_S / u64::from(TICKS_PER_S)) as u32;
        b.put(b"mvhd", |b| {
            b.u32(0).u32(0).u32(0).u32(MOVIE_TICKS_PER_S as u32).u32(movie_ticks);
            // Speed 1, full volume, and the number of the next track.
            b.u32(1 << 16).u16(1 << 8).zeros(10).u32s(&UNIT_MATRIX).zeros(24).u32(2)
        });
        b.put(b"trak", |b| {
            b.put(b"tkhd", |b| {
                // Enabled, and part of the movie; track 1.
                b.u32(3).u32(0).u32(0).u32(1).u32(0).u32(movie_ticks).zeros(16).u32s(&UNIT_MATRIX);
                b.u32(u32::from(self.header.width) << 16).u32(u32::from(self.header.height) << 16)
            });
            b.put(b"mdia", |b| {
                // Version 1: 64 bits of duration. The language is `und`, three letters of five bits.
                b.put(b"mdhd", |b| b.u32(1 << 24).zeros(16).u32(TICKS_PER_S).u64(ticks).u16(0x55c4).u16(0));
                b.put(b"hdlr", |b| b.u32(0).u32(0).bytes(b"vide").zeros(12).bytes(b"VideoHandler\0"));
                b.put(b"minf", |b| {
                    b.put(b"vmhd", |b| b.u32(1).zeros(8));
                    // The pictures are in this file.
                    b.put(b"dinf", |b| b.put(b"dref", |b| b.u32(0).u32(1).put(b"url ", |b| b.u32(1))));
                    b.put(b"stbl", |b| self.samples(b))
                })
            })
        })
    }

    /// The tables of the pictures.
    fn samples<'a>(&self, b: &'a mut Boxes) -> &'a mut Boxes {
        let count = self.lengths.len() as u32;
        b.put(b"stsd", |b| b.u32(0).u32(1).put(b"avc1", |b| self.sample_entry(b)));
        b.put(b"stts", |b| b.u32(0).u32(1).u32(count).u32(self.header.ticks_per_frame));
        b.put(b"stss", |b| b.u32(0).u32(self.keys.len() as u32).u32s(&self.keys));
        b.put(b"stsc", |b| {
            // A chunk lasts to the next picture that stands alone; only those that differ from the one before are listed.
            let ends = self.keys.iter().skip(1).copied().chain([count + 1]);
            let mut runs: Vec<[u32; 3]> = vec![];
            for (chunk, (key, end)) in self.keys.iter().zip(ends).enumerate() {
                if runs.last().is_none_or(|run| run[1] != end - key) {
                    runs.push([chunk as u32 + 1, end - key, 1]);
                }
            }
            b.u32(0).u32(runs.len() as u32).u32s(runs.as_flattened())
        });
        b.put(b"stsz", |b| b.u32(0).u32(0).u32(count).u32s(&self.lengths));
        b.put(b"co64", |b| {
            b.u32(0).u32(self.chunks.len() as u32);
            self.chunks.iter().fold(b, |b, at| b.u64(*at))
        })
    }

    fn sample_entry<'a>(&self, b: &'a mut Boxes) -> &'a mut Boxes {
        let TrackHeader { width, height, sequence, picture, .. } = &self.header;
        b.zeros(6).u16(1).zeros(16).u16(*width).u16(*height);
        // 72 dots an inch, one picture a sample, no name, 24 bits of colour.
        b.u32(72 << 16).u32(72 << 16).u32(0).u16(1).zeros(32).u16(24).u16(0xffff);
        b.put(b"avcC", |b| {
            // Version, profile, compatibility and level; lengths of 4 bytes; one sequence parameter set, one for pictures.
            b.bytes(&[1, sequence[1], sequence[2], sequence[3], 0xff, 0xe1]);
            b.u16(sequence.len() as u16).bytes(sequence).bytes(&[1]).u16(picture.len() as u16).bytes(picture)
        })
    }
}

/// Boxes within boxes: each is its length, its name, and what it holds.
#[derive(Default)]
struct Boxes(Vec<u8>);

impl Boxes {
    fn put(&mut self, name: &[u8; 4], content: impl FnOnce(&mut Boxes) -> &mut Boxes) -> &mut Boxes {
        let start = self.0.len();
        self.u32(0).bytes(name);
        content(self);
        let length = (self.0.len() - start) as u32;
        self.0[start..start + 4].copy_from_slice(&length.to_be_bytes());
        self
    }

    fn bytes(&mut self, bytes: &[u8]) -> &mut Boxes {
        self.0.extend(bytes);
        self
    }

    fn zeros(&mut self, count: usize) -> &mut Boxes {
        self.0.resize(self.0.len() + count, 0);
        self
    }

    fn u16(&mut self, value: u16) -> &mut Boxes {
        self.bytes(&value.to_be_bytes())
    }

    fn u32(&mut self, value: u32) -> &mut Boxes {
        self.bytes(&value.to_be_bytes())
    }

    fn u64(&mut self, value: u64) -> &mut Boxes {
        self.bytes(&value.to_be_bytes())
    }

    fn u32s(&mut self, values: &[u32]) -> &mut Boxes {
        values.iter().fold(self, |boxes, value| boxes.u32(*value))
    }
}
