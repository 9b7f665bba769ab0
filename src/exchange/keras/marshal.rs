//! Python's marshalled code objects, read as data.
//!
//! Keras stores a `Lambda` layer as the marshalled code of its Python function. The format has no version number and differs
//! between Python versions ([`Layout`]); the caller tries one after the other. Nothing is ever executed.

use std::rc::Rc;

/// Deepest nesting that is read. The code of a lambda is nested two or three deep.
const MAX_DEPTH: usize = 32;

/// Which Python wrote a code object.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Layout {
    /// 2.x.
    Python2,
    /// 3.0 to 3.7.
    Python30,
    /// 3.8 to 3.10: one number more.
    Python38,
    /// 3.11 on.
    Python311,
}

impl Layout {
    /// All of them.
    pub const ALL: [Layout; 4] = [Layout::Python2, Layout::Python30, Layout::Python38, Layout::Python311];

    /// Numbers before the first object of a code object; the first is the number of arguments.
    fn numbers(self) -> usize {
        match self {
            Layout::Python2 => 4,
            Layout::Python30 | Layout::Python311 => 5,
            Layout::Python38 => 6,
        }
    }

    /// Objects before the number of the first line, after it.
    fn objects(self) -> (usize, usize) {
        match self {
            Layout::Python311 => (8, 2),
            _ => (8, 1),
        }
    }
}

/// A Python object; only what arithmetic needs is told apart.
#[derive(Debug)]
pub(super) enum Object {
    Integer(i64),
    Float(f64),
    Bytes(Vec<u8>),
    Tuple(Vec<Rc<Object>>),
    Code(Code),
    /// Anything else.
    Other,
}

/// A code object: how many arguments, the byte code, the constants.
#[derive(Debug)]
pub(super) struct Code {
    pub arguments: u32,
    pub code: Rc<Object>,
    pub constants: Rc<Object>,
}

/// The code object that `bytes` are, whole and exactly; `None` if they are none of this layout.
pub(super) fn code(bytes: &[u8], layout: Layout) -> Option<Rc<Object>> {
    let mut reader = Reader { rest: bytes, layout, references: Vec::new() };
    let object = reader.object(0)?;
    (reader.rest.is_empty() && matches!(*object, Object::Code(_))).then_some(object)
}

struct Reader<'a> {
    rest: &'a [u8],
    layout: Layout,
    /// Objects that later ones refer to.
    references: Vec<Rc<Object>>,
}

impl<'a> Reader<'a> {
    fn bytes(&mut self, len: usize) -> Option<&'a [u8]> {
        let (bytes, rest) = self.rest.split_at_checked(len)?;
        self.rest = rest;
        Some(bytes)
    }

    fn array<const N: usize>(&mut self) -> Option<[u8; N]> {
        self.bytes(N)?.try_into().ok()
    }

    fn byte(&mut self) -> Option<usize> {
        self.array::<1>().map(|[byte]| usize::from(byte))
    }

    fn number(&mut self) -> Option<i32> {
        self.array().map(i32::from_le_bytes)
    }

    fn length(&mut self) -> Option<usize> {
        usize::try_from(self.number()?).ok()
    }

    fn tuple(&mut self, len: usize, depth: usize) -> Option<Object> {
        // Every element takes a byte at least, so a length beyond the rest is a lie.
        if len > self.rest.len() {
            return None;
        }
        (0..len).map(|_| self.object(depth + 1)).collect::<Option<Vec<_>>>().map(Object::Tuple)
    }

    fn object(&mut self, depth: usize) -> Option<Rc<Object>> {
        if depth > MAX_DEPTH {
            return None;
        }
        let [byte] = self.array()?;
        let place = (byte & 0x80 != 0).then_some(self.references.len());
        if place.is_some() {
            self.references.push(Rc::new(Object::Other));
        }
        let object = match byte & 0x7f {
            b'N' | b'T' | b'F' | b'.' | b'S' => Object::Other,
            b'i' => Object::Integer(i64::from(self.number()?)),
            b'I' => Object::Integer(i64::from_le_bytes(self.array()?)),
            b'l' => self.long()?,
            b'g' => Object::Float(f64::from_le_bytes(self.array()?)),
            b'f' => {
                let len = self.byte()?;
                Object::Float(std::str::from_utf8(self.bytes(len)?).ok()?.parse().ok()?)
            }
            b's' | b't' | b'u' | b'a' | b'A' => {
                let len = self.length()?;
                Object::Bytes(self.bytes(len)?.to_vec())
            }
            b'z' | b'Z' => {
                let len = self.byte()?;
                Object::Bytes(self.bytes(len)?.to_vec())
            }
            b')' => {
                let len = self.byte()?;
                self.tuple(len, depth)?
            }
            b'(' | b'[' | b'<' | b'>' => {
                let len = self.length()?;
                self.tuple(len, depth)?
            }
            b'r' => return self.length().and_then(|index| self.references.get(index).cloned()),
            // Python 2's reference to an earlier name.
            b'R' => {
                self.number()?;
                Object::Other
            }
            b'c' => Object::Code(self.code(depth)?),
            _ => return None,
        };
        let object = Rc::new(object);
        if let Some(place) = place {
            self.references[place] = object.clone();
        }
        Some(object)
    }

    /// An integer of any size in digits of 15 bits; those beyond 60 bits count as something else.
    fn long(&mut self) -> Option<Object> {
        let signed_digits = self.number()?;
        let digits = self.bytes(usize::try_from(signed_digits.unsigned_abs()).ok()?.checked_mul(2)?)?;
        if digits.len() > 8 {
            return Some(Object::Other);
        }
        let digits = digits.as_chunks::<2>().0.iter().rev();
        let size = digits.fold(0, |sum, digit| (sum << 15) | i64::from(u16::from_le_bytes(*digit) & 0x7fff));
        Some(Object::Integer(if signed_digits < 0 { -size } else { size }))
    }

    fn code(&mut self, depth: usize) -> Option<Code> {
        let arguments = u32::try_from(self.number()?).ok()?;
        for _ in 1..self.layout.numbers() {
            self.number()?;
        }
        let (before, after) = self.layout.objects();
        let (code, constants) = (self.object(depth + 1)?, self.object(depth + 1)?);
        for _ in 2..before {
            self.object(depth + 1)?;
        }
        self.number()?;
        for _ in 0..after {
            self.object(depth + 1)?;
        }
        Some(Code { arguments, code, constants })
    }
}
