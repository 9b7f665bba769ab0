//! Lines of a text file, whoever wrote it: UTF-8 with or without a byte order mark, UTF-16, Latin-1; lines that end in LF, CRLF
//! or CR.

use std::borrow::Cow;
use std::io::{self, BufRead, Cursor, Read};
use std::path::Path;

use crate::dataset::store::Store;

/// A longer line is no line of a log.
const MAX_LINE_BYTES: usize = 64 << 10;
/// Text of two bytes a character is turned into UTF-8 as a whole; a longer one is refused.
const MAX_UTF16_BYTES: u64 = 256 << 20;

/// Reads a text file line by line.
pub(crate) struct Lines {
    input: Box<dyn BufRead>,
    buffer: Vec<u8>,
    /// Number of the line that was read last, from 1.
    number: u32,
}

impl Lines {
    /// Opens the file at `path`.
    ///
    /// # Errors
    /// If it cannot be read.
    pub fn open(store: &Store, path: &Path) -> io::Result<Lines> {
        Lines::new(store.open(path)?)
    }

    /// The lines of `input`.
    ///
    /// # Errors
    /// If it cannot be read.
    pub fn new(mut input: Box<dyn BufRead>) -> io::Result<Lines> {
        let head = input.fill_buf()?;
        let zeros = |first: usize| head.iter().skip(first).step_by(2).take(32).filter(|&&byte| byte == 0).count();
        // Text in Latin letters has a zero in every other byte, with or without a mark.
        let little = head.starts_with(&[0xff, 0xfe]) || (zeros(1) >= 16 && zeros(0) == 0);
        let big = head.starts_with(&[0xfe, 0xff]) || (zeros(0) >= 16 && zeros(1) == 0);
        if little || big {
            let mut bytes = Vec::new();
            input.take(MAX_UTF16_BYTES + 1).read_to_end(&mut bytes)?;
            if bytes.len() as u64 > MAX_UTF16_BYTES {
                return Err(io::Error::new(
                    io::ErrorKind::FileTooLarge,
                    "UTF-16 of more than 256 MiB: save it as UTF-8",
                ));
            }
            let of = |pair: &[u8]| {
                if little { u16::from_le_bytes([pair[0], pair[1]]) } else { u16::from_be_bytes([pair[0], pair[1]]) }
            };
            let text: String =
                char::decode_utf16(bytes.chunks_exact(2).map(of)).map(|c| c.unwrap_or('\u{fffd}')).collect();
            input = Box::new(Cursor::new(text.into_bytes()));
        }
        Ok(Lines { input, buffer: Vec::new(), number: 0 })
    }

    /// The number of the next line, from 1, and the line without its end; `None` at the end.
    ///
    /// # Errors
    /// If reading fails or a line is longer than 64 KiB.
    pub fn next(&mut self) -> io::Result<Option<(u32, Cow<'_, str>)>> {
        self.buffer.clear();
        let mut ended = false;
        loop {
            let chunk = self.input.fill_buf()?;
            if chunk.is_empty() {
                break;
            }
            let end = chunk.iter().position(|&byte| byte == b'\n' || byte == b'\r');
            let line = &chunk[..end.unwrap_or(chunk.len())];
            self.buffer.extend_from_slice(line);
            if self.buffer.len() > MAX_LINE_BYTES {
                let message = format!("line {} is longer than 64 KiB: this is no driving log", self.number + 1);
                return Err(io::Error::new(io::ErrorKind::InvalidData, message));
            }
            let Some(end) = end else {
                let len = chunk.len();
                self.input.consume(len);
                continue;
            };
            ended = true;
            let carriage_return = chunk[end] == b'\r';
            self.input.consume(end + 1);
            if carriage_return && self.input.fill_buf()?.first() == Some(&b'\n') {
                self.input.consume(1);
            }
            break;
        }
        if !ended && self.buffer.is_empty() {
            return Ok(None);
        }
        self.number = self.number.saturating_add(1);
        let bytes = self.buffer.strip_prefix(b"\xef\xbb\xbf").unwrap_or(&self.buffer);
        let text = match std::str::from_utf8(bytes) {
            Ok(text) => Cow::Borrowed(text.trim_start_matches('\u{feff}')),
            // Latin-1 has the first 256 characters of Unicode.
            Err(_) => Cow::Owned(bytes.iter().map(|&byte| char::from(byte)).collect()),
        };
        Ok(Some((self.number, text)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn lines(bytes: &[u8]) -> Vec<String> {
        let mut lines = Lines::new(Box::new(Cursor::new(bytes.to_vec()))).unwrap();
        std::iter::from_fn(|| lines.next().unwrap().map(|(_, line)| line.into_owned())).collect()
    }

    #[test]
    fn every_line_end_and_encoding_gives_the_same_lines() {
        let text = "straße 1,0.5\n\nzwei\nand this is a longer line of plain text\n";
        let expected: Vec<&str> = text.lines().collect();
        for end in ["\n", "\r\n", "\r"] {
            let text = text.replace('\n', end);
            assert_eq!(lines(text.as_bytes()), expected, "{end:?}");
            assert_eq!(lines(format!("\u{feff}{text}").as_bytes()), expected);
            let latin: Vec<u8> = text.chars().map(|c| c as u8).collect();
            assert_eq!(lines(&latin), expected);
            let marked = format!("\u{feff}{text}");
            for (little, text) in [(true, &marked), (false, &marked), (true, &text), (false, &text)] {
                let bytes = |unit: u16| if little { unit.to_le_bytes() } else { unit.to_be_bytes() };
                let utf16: Vec<u8> = text.encode_utf16().flat_map(bytes).collect();
                assert_eq!(lines(&utf16), expected, "little {little} {end:?}");
            }
        }
        assert_eq!(lines(b"no end"), ["no end"]);
        assert!(lines(b"").is_empty());
    }

    #[test]
    fn endless_lines_are_refused() {
        let mut lines = Lines::new(Box::new(Cursor::new(vec![b'x'; 70_000]))).unwrap();
        assert!(lines.next().is_err());
    }
}
