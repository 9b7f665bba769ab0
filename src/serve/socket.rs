//! A TCP connection that knows when its last byte came, and comes back to its owner at a steady beat.

use std::io::{self, ErrorKind, Read, Write};
use std::net::{Shutdown, TcpStream};
use std::time::{Duration, Instant};

/// Longest time that sending may block: a client that does not read is given up.
const WRITE_TIMEOUT: Duration = Duration::from_secs(1);

/// A connection's stream. Reading returns `WouldBlock` once in each beat, however slowly bytes trickle in, so that whoever
/// reads can look after its deadlines.
#[derive(Debug)]
pub(crate) struct Socket {
    stream: TcpStream,
    last_byte: Instant,
    beat: Duration,
    beat_began: Instant,
    waiting: bool,
    count: usize,
}

impl Socket {
    /// Takes over a connection that was just accepted.
    pub fn new(stream: TcpStream, beat: Duration) -> io::Result<Socket> {
        stream.set_nonblocking(false)?;
        stream.set_nodelay(true)?;
        stream.set_write_timeout(Some(WRITE_TIMEOUT))?;
        stream.set_read_timeout(Some(beat))?;
        let now = Instant::now();
        Ok(Socket { stream, last_byte: now, beat, beat_began: now, waiting: true, count: 0 })
    }

    /// When the last byte came.
    pub fn last_byte(&self) -> Instant {
        self.last_byte
    }

    /// Bytes read since this was last asked.
    pub fn take_count(&mut self) -> usize {
        std::mem::take(&mut self.count)
    }

    /// Changes the beat.
    pub fn set_beat(&mut self, beat: Duration) -> io::Result<()> {
        if beat != self.beat {
            self.stream.set_read_timeout(Some(beat))?;
            self.beat = beat;
        }
        Ok(())
    }

    /// Begins a beat.
    pub fn begin_beat(&mut self) {
        self.beat_began = Instant::now();
    }

    /// Whether reading waits for bytes.
    pub fn set_waiting(&mut self, waiting: bool) -> io::Result<()> {
        if waiting != self.waiting {
            self.stream.set_nonblocking(!waiting)?;
            self.waiting = waiting;
        }
        Ok(())
    }

    /// Tells the client that nothing more comes, and reads on for at most `patience` until it has left. If bytes remained
    /// unread when the connection is closed, the system would take back what was sent last.
    pub fn finish(&mut self, patience: Duration) {
        // Whoever is gone needs no farewell.
        let _ = self.stream.shutdown(Shutdown::Write);
        let began = Instant::now();
        let mut rest = [0; 4096];
        while began.elapsed() < patience {
            match self.stream.read(&mut rest) {
                Ok(0) => return,
                Err(error) if !is_timeout(&error) => return,
                _ => {}
            }
        }
    }

    /// Acknowledges what has come at once. The simulator sends a message in pieces and waits for the acknowledgement of one
    /// before it sends the last (Nagle's algorithm), which the system would otherwise delay by up to 40 ms.
    #[cfg(target_os = "linux")]
    fn acknowledge(&self) {
        use std::os::linux::net::TcpStreamExt;
        // Without it, driving goes on with the delay.
        let _ = self.stream.set_quickack(true);
    }

    #[cfg(not(target_os = "linux"))]
    fn acknowledge(&self) {}
}

/// Whether an error only says that nothing has come yet.
pub(crate) fn is_timeout(error: &io::Error) -> bool {
    matches!(error.kind(), ErrorKind::WouldBlock | ErrorKind::TimedOut | ErrorKind::Interrupted)
}

impl Read for Socket {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        if self.waiting && self.beat_began.elapsed() >= self.beat {
            return Err(ErrorKind::WouldBlock.into());
        }
        let len = self.stream.read(buffer)?;
        self.last_byte = Instant::now();
        self.count += len;
        self.acknowledge();
        Ok(len)
    }
}

impl Write for Socket {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let len = self.stream.write(bytes)?;
        // After a reply the system expects another and delays acknowledgements again.
        self.acknowledge();
        Ok(len)
    }

    fn flush(&mut self) -> io::Result<()> {
        self.stream.flush()
    }
}
