//! Reading of HDF5 files as Keras writes them (HDF5 File Format Specification, version 3.0).
//!
//! What h5py writes by default is read: groups by symbol tables or by links in their header, attributes in the header, strings
//! of fixed and of variable length, tensors in one piece. Chunks, filters and groups that are indexed by fractal heaps are
//! refused with a remedy; Keras uses none of them.
//!
//! The file lies in memory, and every address and length is checked against it. Loops that a damaged file could close are
//! bounded by what an honest file can hold.

mod values;

use std::ops::Range;
use std::sync::Arc;

pub(super) use values::{Attribute, Dataset};

/// An address that leads nowhere.
const UNDEFINED: u64 = u64::MAX;
/// Longest name of a group, tensor or attribute.
const MAX_NAME_BYTES: usize = 4096;
/// Most messages that the header of an object can have.
const MAX_MESSAGES: usize = 1 << 14;
/// Most blocks that continue the header of an object.
const MAX_CONTINUATIONS: usize = 1 << 10;
/// Most entries of a group.
const MAX_LINKS: usize = 1 << 14;
/// Most levels of the tree that sorts the entries of a group.
const MAX_LEVELS: u8 = 8;
/// What to do about a file in a layout that is not read.
const REMEDY: &str = "load it with Keras and save it again";

type Result<T> = std::result::Result<T, String>;

/// A part of the file that is read number by number, little-endian.
#[derive(Clone)]
struct Cursor<'a> {
    file: &'a [u8],
    at: usize,
    end: usize,
}

impl<'a> Cursor<'a> {
    /// The `len` bytes at address `at`.
    fn new(file: &'a [u8], at: u64, len: u64) -> Result<Cursor<'a>> {
        let end = at.checked_add(len).filter(|end| *end <= file.len() as u64);
        let end = end.ok_or_else(|| format!("{len} bytes at {at} lie outside of the file"))?;
        Ok(Cursor { file, at: at as usize, end: end as usize })
    }

    /// All from `signature` on, which must stand at address `at`.
    fn signed(file: &'a [u8], at: u64, signature: &[u8; 4]) -> Result<Cursor<'a>> {
        let mut cursor = Cursor::new(file, at, (file.len() as u64).saturating_sub(at))?;
        match cursor.take(4)? == signature {
            true => Ok(cursor),
            false => Err(format!("there is no {} at {at}", String::from_utf8_lossy(signature))),
        }
    }

    fn range(&mut self, len: usize) -> Result<Range<usize>> {
        let end = self.at.checked_add(len).filter(|end| *end <= self.end).ok_or("something ends too early")?;
        Ok(std::mem::replace(&mut self.at, end)..end)
    }

    fn take(&mut self, len: usize) -> Result<&'a [u8]> {
        Ok(&self.file[self.range(len)?])
    }

    fn uint(&mut self, len: usize) -> Result<u64> {
        Ok(self.take(len)?.iter().rev().fold(0, |value, byte| value << 8 | u64::from(*byte)))
    }

    fn u8(&mut self) -> Result<u8> {
        Ok(self.uint(1)? as u8)
    }

    fn u16(&mut self) -> Result<u16> {
        Ok(self.uint(2)? as u16)
    }

    fn u32(&mut self) -> Result<u32> {
        Ok(self.uint(4)? as u32)
    }

    fn u64(&mut self) -> Result<u64> {
        self.uint(8)
    }
}

/// The text up to the first zero byte.
fn text(bytes: &[u8]) -> Result<String> {
    let len = bytes.iter().position(|byte| *byte == 0).unwrap_or(bytes.len());
    match len > MAX_NAME_BYTES {
        true => Err(format!("a name has {len} bytes")),
        false => Ok(String::from_utf8_lossy(&bytes[..len]).into_owned()),
    }
}

/// Opens the file `bytes`, and answers its root group.
pub(super) fn open(bytes: Vec<u8>) -> Result<Group> {
    let file: Arc<[u8]> = bytes.into();
    let mut head = Cursor::new(&file, 0, file.len() as u64)?;
    if head.take(8).ok() != Some(b"\x89HDF\r\n\x1a\n") {
        return Err("it does not begin as one".into());
    }
    let (sizes, root_at) = match head.u8()? {
        version @ 0..=1 => {
            head.take(4)?;
            let sizes = [head.u8()?, head.u8()?];
            // Sizes of nodes and flags, four addresses, and the place of the root's name, which is empty.
            head.take(if version == 0 { 9 } else { 13 } + 5 * 8)?;
            (sizes, head.u64()?)
        }
        2..=3 => {
            let sizes = [head.u8()?, head.u8()?];
            head.take(1 + 3 * 8)?;
            (sizes, head.u64()?)
        }
        version => return Err(format!("version {version} of HDF5 is unknown")),
    };
    match sizes {
        [8, 8] => Ok(Group(Object::read(&file, String::new(), root_at)?)),
        [addresses, lengths] => {
            Err(format!("it has addresses of {addresses} and lengths of {lengths} bytes; {REMEDY}"))
        }
    }
}

/// A group or a tensor: its name, and the messages of its header.
#[derive(Clone)]
struct Object {
    file: Arc<[u8]>,
    name: String,
    messages: Vec<Message>,
}

#[derive(Clone)]
struct Message {
    kind: u16,
    is_shared: bool,
    content: Range<usize>,
}

/// Kinds of messages.
const DATASPACE: u16 = 0x01;
const LINK_INFO: u16 = 0x02;
const DATATYPE: u16 = 0x03;
const LINK: u16 = 0x06;
const LAYOUT: u16 = 0x08;
const FILTERS: u16 = 0x0b;
const ATTRIBUTE: u16 = 0x0c;
const CONTINUATION: u16 = 0x10;
const SYMBOL_TABLE: u16 = 0x11;
const ATTRIBUTE_INFO: u16 = 0x15;

impl Object {
    /// The object whose header is at address `at`.
    fn read(file: &Arc<[u8]>, name: String, at: u64) -> Result<Object> {
        let mut head = Cursor::new(file, at, (file.len() as u64).saturating_sub(at))?;
        let is_modern = head.file[head.at..].starts_with(b"OHDR");
        let mut is_ordered = false;
        let len = if is_modern {
            head.take(5)?;
            let flags = head.u8()?;
            is_ordered = flags & 4 != 0;
            head.take(if flags & 0x20 != 0 { 16 } else { 0 } + if flags & 0x10 != 0 { 4 } else { 0 })?;
            head.uint(1 << (flags & 3))?
        } else {
            if head.u8()? != 1 {
                return Err(format!("there is no object at {at}"));
            }
            head.take(7)?;
            let len = head.u32()?;
            head.take(4)?;
            len.into()
        };
        let mut messages = vec![];
        let mut blocks = vec![(head.at as u64, len)];
        let mut next = 0;
        while let Some((block_at, len)) = blocks.get(next).copied() {
            let mut block = Cursor::new(file, block_at, len)?;
            if is_modern && next > 0 {
                // A signature in front, a checksum behind.
                block.take(4)?;
                block.end = block.end.saturating_sub(4).max(block.at);
            }
            next += 1;
            while block.end - block.at >= if is_modern { 4 } else { 8 } {
                let (kind, len, flags);
                if is_modern {
                    (kind, len, flags) = (block.u8()?.into(), block.u16()?, block.u8()?);
                    block.take(if is_ordered { 2 } else { 0 })?;
                } else {
                    (kind, len, flags) = (block.u16()?, block.u16()?, block.u8()?);
                    block.take(3)?;
                }
                let mut content = Cursor::new(file, block.at as u64, len.into())?;
                let message = Message { kind, is_shared: flags & 2 != 0, content: block.range(len.into())? };
                match kind {
                    0 => {}
                    CONTINUATION => blocks.push((content.u64()?, content.u64()?)),
                    _ => messages.push(message),
                }
                if messages.len() > MAX_MESSAGES || blocks.len() > MAX_CONTINUATIONS {
                    return Err("the header of an object has no end".into());
                }
            }
        }
        Ok(Object { file: file.clone(), name, messages })
    }

    fn cursor(&self, message: &Message) -> Result<Cursor<'_>> {
        match message.is_shared {
            true => Err(format!("a part of `{}` is shared with others; {REMEDY}", self.name)),
            false => Ok(Cursor { file: &self.file, at: message.content.start, end: message.content.end }),
        }
    }

    fn all(&self, kind: u16) -> impl Iterator<Item = Result<Cursor<'_>>> {
        self.messages.iter().filter(move |message| message.kind == kind).map(|message| self.cursor(message))
    }

    fn first(&self, kind: u16) -> Result<Cursor<'_>> {
        self.all(kind).next().ok_or_else(|| format!("`{}` has no message {kind:#x}", self.name))?
    }

    fn has(&self, kind: u16) -> bool {
        self.messages.iter().any(|message| message.kind == kind)
    }

    /// Refuses entries that lie in a fractal heap. `flags` say whether a number of `wide` bytes stands before its address.
    fn refuse_heap(&self, kind: u16, wide: usize) -> Result<()> {
        for info in self.all(kind) {
            let mut info = info?;
            info.take(1)?;
            let flags = info.u8()?;
            info.take(if flags & 1 != 0 { wide } else { 0 })?;
            if info.u64()? != UNDEFINED {
                return Err(format!("`{}` has so many entries that they are in a heap; {REMEDY}", self.name));
            }
        }
        Ok(())
    }

    /// Names and addresses of the entries of a group, in the order of the file.
    fn links(&self) -> Result<Vec<(String, u64)>> {
        self.refuse_heap(LINK_INFO, 8)?;
        let mut links = vec![];
        for link in self.all(LINK) {
            let mut link = link?;
            link.take(1)?;
            let flags = link.u8()?;
            let kind = if flags & 8 != 0 { link.u8()? } else { 0 };
            link.take(if flags & 4 != 0 { 8 } else { 0 } + if flags & 0x10 != 0 { 1 } else { 0 })?;
            let len = link.uint(1 << (flags & 3))?;
            let name = text(link.take(usize::try_from(len).unwrap_or(usize::MAX))?)?;
            if kind == 0 {
                links.push((name, link.u64()?));
            }
        }
        if self.has(SYMBOL_TABLE) {
            let mut table = self.first(SYMBOL_TABLE)?;
            let (tree_at, mut nodes_left) = (table.u64()?, MAX_LINKS);
            let mut heap = Cursor::signed(&self.file, table.u64()?, b"HEAP")?;
            heap.take(4)?;
            let (len, _free) = (heap.u64()?, heap.u64()?);
            let names = Cursor::new(&self.file, heap.u64()?, len)?;
            self.tree(tree_at, MAX_LEVELS, &mut nodes_left, &names, &mut links)?;
        }
        Ok(links)
    }

    /// Adds the entries below a node of the tree that sorts them by name to `links`. `nodes_left` bounds the number of nodes.
    fn tree(
        &self,
        at: u64,
        level_above: u8,
        nodes_left: &mut usize,
        names: &Cursor,
        links: &mut Vec<(String, u64)>,
    ) -> Result<()> {
        let mut node = Cursor::signed(&self.file, at, b"TREE")?;
        let (kind, level) = (node.u8()?, node.u8()?);
        // Each level is below the one above, so the tree has an end.
        if kind != 0 || level >= level_above {
            return Err(format!("the list of entries of `{}` is wrong", self.name));
        }
        let count = node.u16()?;
        node.take(2 * 8)?;
        for _ in 0..count {
            node.take(8)?;
            let child_at = node.u64()?;
            *nodes_left =
                nodes_left.checked_sub(1).ok_or_else(|| format!("the entries of `{}` have no end", self.name))?;
            if level > 0 {
                self.tree(child_at, level, nodes_left, names, links)?;
                continue;
            }
            let mut leaf = Cursor::signed(&self.file, child_at, b"SNOD")?;
            leaf.take(2)?;
            for _ in 0..leaf.u16()? {
                let (name_at, object_at) = (leaf.u64()?, leaf.u64()?);
                leaf.take(24)?;
                let name_at = usize::try_from(name_at).ok().and_then(|at| names.at.checked_add(at));
                let name =
                    name_at.and_then(|at| names.file[..names.end].get(at..)).ok_or("a name is outside of its heap")?;
                links.push((text(name)?, object_at));
            }
            if links.len() > MAX_LINKS {
                return Err(format!("`{}` has more than {MAX_LINKS} entries", self.name));
            }
        }
        Ok(())
    }
}

/// A group.
#[derive(Clone)]
pub(super) struct Group(Object);

impl Group {
    /// Its name within the group above.
    pub fn name(&self) -> &str {
        &self.0.name
    }

    /// Everything in it, in the order of the file.
    fn children(&self) -> Result<Vec<Object>> {
        let (mut children, mut messages) = (vec![], 0);
        for (name, at) in self.0.links()? {
            let child = Object::read(&self.0.file, name, at)?;
            // A message takes at least four bytes, so this many stand in no honest file.
            messages += child.messages.len();
            if messages > self.0.file.len() / 4 {
                return Err(format!("the entries of `{}` are one within the other", self.name()));
            }
            children.push(child);
        }
        Ok(children)
    }

    /// The groups in it, in the order of the file.
    pub fn groups(&self) -> Result<Vec<Group>> {
        Ok(self.children()?.into_iter().filter(|child| !child.has(LAYOUT)).map(Group).collect())
    }

    /// The tensors in it, in the order of the file.
    pub fn datasets(&self) -> Result<Vec<Dataset>> {
        self.children()?.into_iter().filter(|child| child.has(LAYOUT)).map(Dataset::new).collect()
    }

    fn child(&self, name: &str) -> Result<Object> {
        let found = self.0.links()?.into_iter().find(|(link, _)| link == name);
        let (name, at) = found.ok_or_else(|| format!("`{name}` is not in `{}`", self.name()))?;
        Object::read(&self.0.file, name, at)
    }

    /// The group at `path`, with `/` between the names.
    pub fn group(&self, path: &str) -> Result<Group> {
        let mut names = path.split('/').filter(|name| !name.is_empty());
        names.try_fold(self.clone(), |group, name| match group.child(name)? {
            child if child.has(LAYOUT) => Err(format!("`{name}` is a tensor and no group")),
            child => Ok(Group(child)),
        })
    }

    /// The tensor `name`.
    pub fn dataset(&self, name: &str) -> Result<Dataset> {
        Dataset::new(self.child(name)?)
    }

    /// All attributes, in the order of the file.
    pub fn attributes(&self) -> Result<Vec<Attribute>> {
        self.0.refuse_heap(ATTRIBUTE_INFO, 2)?;
        self.0.all(ATTRIBUTE).map(|message| Attribute::parse(&self.0.file, message?)).collect()
    }
}
