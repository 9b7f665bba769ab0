//! A TCP stream whose reads never block for longer than one tick, and that knows when its last byte came.

use std::io::{self, ErrorKind, Read, Write};
use std::net::{Shutdown, TcpStream};
use std::time::{Duration, Instant};

/// Longest time that a write may block. The server closes a client that does not read for so long.
const WRITE_TIMEOUT: Duration = Duration::from_secs(1);

/// The stream of a connection. A read returns `WouldBlock` at the end of each tick, however slowly bytes arrive, so that the
/// reader can check its deadlines.
#[derive(Debug)]
pub(crate) struct Socket {
    stream: TcpStream,
    last_byte: Instant,
    tick: Duration,
    tick_began: Instant,
    waiting: bool,
    count: usize,
}

impl Socket {
    /// Takes over a connection that was just accepted; `tick` is the longest time that a read blocks.
    pub fn new(stream: TcpStream, tick: Duration) -> io::Result<Socket> {
        stream.set_nonblocking(false)?;
        stream.set_nodelay(true)?;
        stream.set_write_timeout(Some(WRITE_TIMEOUT))?;
        stream.set_read_timeout(Some(tick))?;
        let now = Instant::now();
        Ok(Socket { stream, last_byte: now, tick, tick_began: now, waiting: true, count: 0 })
    }

    /// When the last byte came.
    pub fn last_byte(&self) -> Instant {
        self.last_byte
    }

    /// Bytes read since the last call.
    pub fn take_count(&mut self) -> usize {
        std::mem::take(&mut self.count)
    }

    /// Changes the tick.
    pub fn set_tick(&mut self, tick: Duration) -> io::Result<()> {
        if tick != self.tick {
            self.stream.set_read_timeout(Some(tick))?;
            self.tick = tick;
        }
        Ok(())
    }

    /// Begins a tick.
    pub fn begin_tick(&mut self) {
        self.tick_began = Instant::now();
    }

    /// Sets whether a read waits for bytes.
    pub fn set_waiting(&mut self, waiting: bool) -> io::Result<()> {
        if waiting != self.waiting {
            self.stream.set_nonblocking(!waiting)?;
            self.waiting = waiting;
        }
        Ok(())
    }

    /// Tells the client that nothing more follows, and reads for at most `patience` until the client has closed its side. If
    /// unread bytes remained when the stream is closed, the system would discard what was sent last.
    pub fn finish(&mut self, patience: Duration) {
        // The client may be gone.
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

    /// Acknowledges received bytes at once. The simulator sends a message in pieces and waits for the acknowledgement of one
    /// piece before it sends the last (Nagle's algorithm); the system would otherwise delay it by up to 40 ms.
    #[cfg(target_os = "linux")]
    fn acknowledge(&self) {
        use std::os::linux::net::TcpStreamExt;
        // Without it, driving goes on with the delay.
        let _ = self.stream.set_quickack(true);
    }

    #[cfg(not(target_os = "linux"))]
    fn acknowledge(&self) {}
}

/// Whether an error only says that no bytes have arrived yet.
pub(crate) fn is_timeout(error: &io::Error) -> bool {
    matches!(error.kind(), ErrorKind::WouldBlock | ErrorKind::TimedOut | ErrorKind::Interrupted)
}

impl Read for Socket {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        if self.waiting && self.tick_began.elapsed() >= self.tick {
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
