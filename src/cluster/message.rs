//! What ranks send each other, as bytes.

use serde::Serialize;
use serde::de::DeserializeOwned;

use crate::error::{Error, Result};

/// What can be sent. Everything that serde writes and reads is sent as JSON, whose numbers keep their bits here as long as they
/// are finite; others are sent as their bits.
pub trait Message: Sized {
    /// The bytes to send.
    ///
    /// # Errors
    ///
    /// [`Error::Fault`] if there are none.
    fn to_bytes(&self) -> Result<Vec<u8>>;

    /// What was sent.
    ///
    /// # Errors
    ///
    /// [`Error::Fault`] if `bytes` are those of something else.
    fn of_bytes(bytes: &[u8]) -> Result<Self>;
}

impl<T: Serialize + DeserializeOwned> Message for T {
    fn to_bytes(&self) -> Result<Vec<u8>> {
        written(self)
    }

    fn of_bytes(bytes: &[u8]) -> Result<T> {
        serde_json::from_slice(bytes).map_err(|e| unreadable(&e.to_string()))
    }
}

/// What need not be read as the same type, as JSON.
///
/// # Errors
///
/// [`Error::Fault`] if it cannot be written.
pub fn written(value: &impl Serialize) -> Result<Vec<u8>> {
    serde_json::to_vec(value).map_err(|e| Error::Fault(format!("a message cannot be written: {e}")))
}

/// `parts`, each behind its length.
pub fn join<B: AsRef<[u8]>>(parts: impl IntoIterator<Item = B>) -> Vec<u8> {
    let mut bytes = Vec::new();
    for part in parts {
        bytes.extend((part.as_ref().len() as u64).to_le_bytes());
        bytes.extend(part.as_ref());
    }
    bytes
}

/// The parts of what [`join`] made.
///
/// # Errors
///
/// [`Error::Fault`] for other bytes.
pub fn split(mut bytes: &[u8]) -> Result<Vec<&[u8]>> {
    let mut parts = Vec::new();
    while let Some((len, rest)) = bytes.split_first_chunk() {
        let part = usize::try_from(u64::from_le_bytes(*len)).ok().and_then(|len| rest.split_at_checked(len));
        let (part, after) = part.ok_or_else(|| unreadable("it is cut off"))?;
        parts.push(part);
        bytes = after;
    }
    if bytes.is_empty() { Ok(parts) } else { Err(unreadable("it is cut off")) }
}

/// The first `N` parts of a message, and all others.
pub type Parts<'a, const N: usize> = ([&'a [u8]; N], Vec<&'a [u8]>);

/// The first `N` parts of what [`join`] made, and all others.
///
/// # Errors
///
/// As [`split`], also for fewer parts.
pub fn split_first<const N: usize>(bytes: &[u8]) -> Result<Parts<'_, N>> {
    let mut parts = split(bytes)?;
    if parts.len() < N {
        return Err(unreadable("it has too few parts"));
    }
    let rest = parts.split_off(N);
    let first = <[&[u8]; N]>::try_from(parts).map_err(|_| unreadable("it has other parts"))?;
    Ok((first, rest))
}

fn unreadable(why: &str) -> Error {
    Error::Fault(format!("a message of another rank cannot be read: {why}"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parts_come_back_and_what_is_cut_off_is_an_error() {
        let parts: [&[u8]; 3] = [b"ab", b"", b"c"];
        let bytes = join(parts);
        assert_eq!(split(&bytes).unwrap(), parts);
        let ([first], rest) = split_first::<1>(&bytes).unwrap();
        assert_eq!((first, rest), (parts[0], parts[1..].to_vec()));
        for len in (1..bytes.len()).filter(|len| ![10, 18].contains(len)) {
            assert!(split(&bytes[..len]).is_err(), "{len}");
        }
        assert!(split_first::<4>(&bytes).is_err());
    }
}
