//! WebSocket frames (RFC 6455, section 5) of a client. It cuts messages into frames as websocket-sharp 1.0 does, which no
//! library can be told to do.

use std::io::{self, Read, Write};

use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// Longest payload of a frame that the client sends. It cuts longer messages into pieces of this length.
pub const FRAGMENT_LEN: usize = 1016;
/// Longest message of a server that the client reads.
const MAX_MESSAGE_LEN: usize = 1 << 24;

/// Bit of the last frame of a message.
const FIN: u8 = 0x80;
const CONTINUATION: u8 = 0x0;
const TEXT: u8 = 0x1;
const BINARY: u8 = 0x2;
const CLOSE: u8 = 0x8;
const PING: u8 = 0x9;
const PONG: u8 = 0xa;

/// Writes messages to a stream, each frame in one write and with a mask of its own.
#[derive(Debug)]
pub struct FrameWriter<W> {
    stream: W,
    masks: ChaCha8Rng,
    frame: Vec<u8>,
}

impl<W: Write> FrameWriter<W> {
    /// A writer that draws its masks from `seed`.
    pub fn new(stream: W, seed: u64) -> FrameWriter<W> {
        FrameWriter { stream, masks: ChaCha8Rng::seed_from_u64(seed), frame: Vec::new() }
    }

    /// The stream.
    pub fn stream(&self) -> &W {
        &self.stream
    }

    /// Sends a text, in pieces if it is long.
    ///
    /// # Errors
    /// If the stream does not take it.
    pub fn text(&mut self, text: &str) -> io::Result<()> {
        let mut pieces = text.as_bytes().chunks(FRAGMENT_LEN);
        let (mut opcode, mut piece) = (TEXT, pieces.next().unwrap_or_default());
        for next in pieces {
            self.frame(opcode, piece)?;
            (opcode, piece) = (CONTINUATION, next);
        }
        self.frame(FIN | opcode, piece)
    }

    /// Answers a ping.
    ///
    /// # Errors
    /// If the stream does not take it.
    pub fn pong(&mut self, payload: &[u8]) -> io::Result<()> {
        self.frame(FIN | PONG, payload)
    }

    /// Sends a close frame, with `code` if there is one.
    ///
    /// # Errors
    /// If the stream does not take it.
    pub fn close(&mut self, code: Option<u16>) -> io::Result<()> {
        match code {
            Some(code) => self.frame(FIN | CLOSE, &code.to_be_bytes()),
            None => self.frame(FIN | CLOSE, &[]),
        }
    }

    fn frame(&mut self, first: u8, payload: &[u8]) -> io::Result<()> {
        const MASKED: u8 = 0x80;
        self.frame.clear();
        self.frame.push(first);
        match payload.len() {
            len @ 0..126 => self.frame.push(MASKED | len as u8),
            len => {
                // No payload is longer than a fragment.
                self.frame.push(MASKED | 126);
                self.frame.extend_from_slice(&(len as u16).to_be_bytes());
            }
        }
        let mut mask = [0; 4];
        self.masks.fill_bytes(&mut mask);
        self.frame.extend_from_slice(&mask);
        self.frame.extend(payload.iter().zip(mask.iter().cycle()).map(|(byte, mask)| byte ^ mask));
        self.stream.write_all(&self.frame)
    }
}

/// What a server sends.
#[derive(Debug, PartialEq, Eq)]
pub enum Incoming {
    /// A complete text.
    Text(String),
    /// A complete binary message.
    Binary,
    /// A ping, and the payload of its pong.
    Ping(Vec<u8>),
    /// A pong.
    Pong,
    /// The server closes, with this code.
    Close(Option<u16>),
}

/// Reads messages from a stream.
#[derive(Debug)]
pub struct FrameReader<R> {
    stream: R,
    /// The opcode and the bytes so far of a message that is not complete.
    begun: Option<(u8, Vec<u8>)>,
}

impl<R: Read> FrameReader<R> {
    /// A reader of what follows the handshake.
    pub fn new(stream: R) -> FrameReader<R> {
        FrameReader { stream, begun: None }
    }

    /// Waits for the next message.
    ///
    /// # Errors
    /// [`io::ErrorKind::InvalidData`] for frames that no server may send, [`io::ErrorKind::UnexpectedEof`] at the end of
    /// the stream, or what the stream says.
    pub fn read(&mut self) -> io::Result<Incoming> {
        loop {
            let (first, payload) = self.frame()?;
            let (fin, opcode) = (first & FIN != 0, first & 0xf);
            let message = match (opcode, self.begun.take()) {
                (PING | PONG | CLOSE, _) if !fin || payload.len() > 125 => {
                    return Err(invalid("a control frame that is fragmented or too long"));
                }
                (PING | PONG | CLOSE, begun) => {
                    self.begun = begun;
                    let code = || Some(u16::from_be_bytes([*payload.first()?, *payload.get(1)?]));
                    return Ok(match opcode {
                        PING => Incoming::Ping(payload),
                        PONG => Incoming::Pong,
                        _ => Incoming::Close(code()),
                    });
                }
                (TEXT | BINARY, None) => (opcode, payload),
                (CONTINUATION, Some((kind, mut message))) => {
                    if message.len() + payload.len() > MAX_MESSAGE_LEN {
                        return Err(invalid("a message of more than 16 MiB"));
                    }
                    message.extend_from_slice(&payload);
                    (kind, message)
                }
                _ => return Err(invalid("a frame that does not follow from the one before")),
            };
            match message {
                begun if !fin => self.begun = Some(begun),
                (TEXT, text) => return Ok(Incoming::Text(String::from_utf8_lossy(&text).into_owned())),
                _ => return Ok(Incoming::Binary),
            }
        }
    }

    /// The first byte and the payload of the next frame.
    fn frame(&mut self) -> io::Result<(u8, Vec<u8>)> {
        let mut head = [0; 2];
        self.stream.read_exact(&mut head)?;
        let [first, second] = head;
        if first & 0x70 != 0 {
            return Err(invalid("a frame of an extension that was not agreed on"));
        }
        if second & 0x80 != 0 {
            return Err(invalid("a frame with a mask, which only clients may send"));
        }
        let len = match second {
            126 => {
                let mut len = [0; 2];
                self.stream.read_exact(&mut len)?;
                usize::from(u16::from_be_bytes(len))
            }
            127 => {
                let mut len = [0; 8];
                self.stream.read_exact(&mut len)?;
                usize::try_from(u64::from_be_bytes(len)).unwrap_or(usize::MAX)
            }
            len => usize::from(len),
        };
        if len > MAX_MESSAGE_LEN {
            return Err(invalid("a frame of more than 16 MiB"));
        }
        let mut payload = vec![0; len];
        self.stream.read_exact(&mut payload)?;
        Ok((first, payload))
    }
}

fn invalid(what: &str) -> io::Error {
    io::Error::new(io::ErrorKind::InvalidData, format!("the server sent {what}"))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The frames in `bytes`: first byte, whether masked, unmasked payload.
    fn frames(mut bytes: &[u8]) -> Vec<(u8, bool, Vec<u8>)> {
        let mut found = Vec::new();
        while let [first, second, rest @ ..] = bytes {
            let (len, rest) = match second & 0x7f {
                126 => (usize::from(u16::from_be_bytes([rest[0], rest[1]])), &rest[2..]),
                len => (usize::from(len), rest),
            };
            let (mask, rest) = rest.split_at(4);
            let payload = rest[..len].iter().zip(mask.iter().cycle()).map(|(byte, mask)| byte ^ mask).collect();
            found.push((*first, second & 0x80 != 0, payload));
            bytes = &rest[len..];
        }
        found
    }

    #[test]
    fn texts_are_masked_and_cut_into_pieces_of_1016_bytes() {
        for (len, pieces) in [(1, 1), (125, 1), (126, 1), (1016, 1), (1017, 2), (2032, 2), (16_000, 16)] {
            let text: String = (0..len).map(|k| char::from(b'a' + (k % 26) as u8)).collect();
            let mut writer = FrameWriter::new(Vec::new(), 1);
            writer.text(&text).unwrap();
            let frames = frames(writer.stream());
            assert_eq!(frames.len(), pieces);
            for (at, (first, masked, payload)) in frames.iter().enumerate() {
                let last = at + 1 == pieces;
                assert_eq!(*first, if at == 0 { 1 } else { 0 } | if last { 0x80 } else { 0 });
                assert!(masked & (last || payload.len() == FRAGMENT_LEN));
            }
            assert_eq!(frames.into_iter().flat_map(|f| f.2).collect::<Vec<_>>(), text.as_bytes());
        }
    }

    #[test]
    fn masks_differ_from_frame_to_frame() {
        let mut writer = FrameWriter::new(Vec::new(), 1);
        writer.text("2").unwrap();
        writer.text("2").unwrap();
        let bytes = writer.stream();
        assert_ne!(bytes[2..6], bytes[9..13]);
    }

    fn read(bytes: &[u8]) -> Vec<io::Result<Incoming>> {
        let mut reader = FrameReader::new(bytes);
        let mut found = Vec::new();
        loop {
            match reader.read() {
                Err(e) if e.kind() == io::ErrorKind::UnexpectedEof => return found,
                Err(e) => {
                    found.push(Err(e));
                    return found;
                }
                message => found.push(message),
            }
        }
    }

    #[test]
    fn messages_of_a_server_are_read_whole_also_around_control_frames() {
        let bytes = b"\x01\x0242\x89\x01x\x00\x02[\"\x8a\x00\x80\x03a\"]\x82\x01b\x81\x00\x88\x02\x03\xe8";
        let texts = |text: &str| Incoming::Text(text.into());
        let read: Vec<Incoming> = read(bytes).into_iter().map(Result::unwrap).collect();
        assert_eq!(
            read,
            [
                Incoming::Ping(b"x".into()),
                Incoming::Pong,
                texts("42[\"a\"]"),
                Incoming::Binary,
                texts(""),
                Incoming::Close(Some(1000))
            ]
        );
        let mut long = vec![0x81, 126, 1, 0];
        long.extend([b'z'; 256]);
        assert_eq!(super::FrameReader::new(&long[..]).read().unwrap(), texts(&"z".repeat(256)));
    }

    #[test]
    fn what_no_server_may_send_is_an_error() {
        for bytes in [
            &b"\xc1\x00"[..],                            // reserved bit
            b"\x81\x80\0\0\0\0",                         // masked
            b"\x80\x01a",                                // continuation of nothing
            b"\x01\x01a\x81\x01b",                       // a text within a text
            b"\x09\x00",                                 // fragmented ping
            b"\x83\x00",                                 // unknown opcode
            b"\x81\x7f\x7f\xff\xff\xff\xff\xff\xff\xff", // longer than memory
        ] {
            let read = read(bytes);
            assert_eq!(read.last().unwrap().as_ref().unwrap_err().kind(), io::ErrorKind::InvalidData, "{bytes:?}");
        }
    }
}
