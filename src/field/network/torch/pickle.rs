//! A pickle machine that runs nothing: it follows the opcodes of protocols 0 to 5 on a stack of its own and knows the few
//! calls by which PyTorch makes tensors (Python's `pickletools` describes the opcodes).
//!
//! Text and bytes stay where they are in the file. Containers lie in one list and refer to each other by number, so a
//! container may hold itself and none is ever copied unless a call asks for it; every opcode and every copied member counts
//! against one limit, which bounds memory and time.

mod calls;

use super::FORMAT;
use super::globals::Global;
use super::rebuild::{Record, Storage, View};
use crate::field::FieldError;
use std::collections::HashMap;

/// Most opcodes, and most members that calls copy: a network of 64 layers with its optimizer takes some ten thousand, and
/// a million bounds what the machine holds to about a hundred megabytes.
const MAX_STEPS: u64 = 1 << 20;
/// Most values on the stack at once; the largest tuple that a pickle can hold is as long.
const MAX_STACK: usize = 1 << 18;
/// Most marks on the stack at once: Python's own writer nests no deeper than its recursion limit.
const MAX_MARKS: usize = 1000;
/// Most bytes of the name of a module or of a global.
const MAX_GLOBAL: usize = 256;
/// Most bytes of the key of a storage: a number, or an address in decimal.
const MAX_KEY: usize = 256;
/// Most bytes of a number written as text.
const MAX_LINE: usize = 1 << 16;
/// Most axes of a tensor, which is more than any layer has.
pub(super) const MAX_AXES: usize = 16;

/// A value on the stack, in the memo, or in a container.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Value<'a> {
    /// `None`.
    None,
    /// A whole number of up to eight bytes.
    Int(i64),
    /// A longer whole number, its bytes as they are in the file.
    Long(&'a [u8]),
    /// Text, or a byte string of Python 2 that is text.
    Text(&'a str),
    /// Anything that cannot hold a tensor.
    Opaque,
    /// A global that is allowed.
    Global(Global),
    /// A container by its number.
    Container(usize),
    /// A storage, or a part of one, by the number of its view.
    Storage(usize),
    /// A tensor by its number.
    Tensor(usize),
}

/// What holds other values.
#[derive(Debug)]
pub(super) enum Container<'a> {
    /// A list.
    List(Vec<Value<'a>>),
    /// A tuple.
    Tuple(Vec<Value<'a>>),
    /// A dictionary: keys and values in the order of the file; a later pair replaces an earlier one with its key.
    Dictionary(Vec<(Value<'a>, Value<'a>)>),
}

/// What a pickle describes: one value and all that it refers to.
pub(super) struct Loaded<'a> {
    /// The value.
    pub root: Value<'a>,
    /// Containers by number.
    pub containers: Vec<Container<'a>>,
    /// Storages by number.
    pub storages: Vec<Storage<'a>>,
    /// Parts of storages by number.
    pub views: Vec<View>,
    /// Tensors by number.
    pub tensors: Vec<Record>,
    /// Where the byte after the pickle is.
    pub end: usize,
}

impl<'a> Loaded<'a> {
    /// The members of a list or tuple.
    pub fn sequence(&self, value: Value<'a>) -> Option<&[Value<'a>]> {
        let Value::Container(index) = value else { return None };
        match &self.containers[index] {
            Container::List(members) | Container::Tuple(members) => Some(members),
            Container::Dictionary(_) => None,
        }
    }
}

/// Reads the pickle that begins at byte `start`; `place` names it in messages.
pub(super) fn load<'a>(bytes: &'a [u8], start: usize, place: &'a str) -> Result<Loaded<'a>, FieldError> {
    let made = Loaded {
        root: Value::None,
        containers: Vec::new(),
        storages: Vec::new(),
        views: Vec::new(),
        tensors: Vec::new(),
        end: start,
    };
    let machine = Machine {
        bytes,
        place,
        at: start,
        opcode_at: start,
        steps: 0,
        stack: Vec::new(),
        marks: Vec::new(),
        memo: HashMap::new(),
        storage_of_key: HashMap::new(),
        made,
    };
    machine.run()
}

struct Machine<'a> {
    bytes: &'a [u8],
    place: &'a str,
    at: usize,
    opcode_at: usize,
    steps: u64,
    stack: Vec<Value<'a>>,
    /// Lengths of the stack where marks were set.
    marks: Vec<usize>,
    memo: HashMap<u64, Value<'a>>,
    storage_of_key: HashMap<&'a str, usize>,
    made: Loaded<'a>,
}

fn limit(what: &'static str, found: u64, limit: u64) -> FieldError {
    FieldError::Limit { what, found, limit }
}

impl<'a> Machine<'a> {
    fn fault(&self, detail: impl AsRef<str>) -> FieldError {
        let detail = format!("{}: {}", self.place, detail.as_ref());
        FieldError::Malformed { format: FORMAT, at: Some(self.opcode_at as u64), detail }
    }

    fn unsupported(&self, what: impl AsRef<str>) -> FieldError {
        let detail = format!("{} in the {} at byte {}", what.as_ref(), self.place, self.opcode_at);
        FieldError::Unsupported { detail }
    }

    /// Counts work, so that a small file cannot ask for much of it.
    fn charge(&mut self, steps: usize) -> Result<(), FieldError> {
        self.steps += steps as u64;
        if self.steps > MAX_STEPS {
            return Err(limit("opcodes of a pickle", self.steps, MAX_STEPS));
        }
        Ok(())
    }

    fn take(&mut self, count: usize) -> Result<&'a [u8], FieldError> {
        let bytes = self.bytes;
        let taken = self.at.checked_add(count).and_then(|end| bytes.get(self.at..end));
        let taken = taken.ok_or_else(|| self.fault("the pickle is cut short"))?;
        self.at += count;
        Ok(taken)
    }

    fn array<const N: usize>(&mut self) -> Result<[u8; N], FieldError> {
        let taken = self.take(N)?;
        Ok(*taken.first_chunk().expect("as many bytes as were taken"))
    }

    fn u8(&mut self) -> Result<usize, FieldError> {
        Ok(usize::from(self.array::<1>()?[0]))
    }

    fn u32(&mut self) -> Result<usize, FieldError> {
        Ok(u32::from_le_bytes(self.array()?) as usize)
    }

    fn u64(&mut self) -> Result<usize, FieldError> {
        let length = u64::from_le_bytes(self.array()?);
        usize::try_from(length).map_err(|_| self.fault("the pickle is cut short"))
    }

    /// The bytes up to the next line break, which is passed.
    fn line(&mut self, most: usize) -> Result<&'a [u8], FieldError> {
        let rest = &self.bytes[self.at..];
        let end = rest.iter().take(most + 1).position(|&b| b == b'\n');
        let end = end.ok_or_else(|| self.fault("a line does not end"))?;
        self.at += end + 1;
        Ok(&rest[..end])
    }

    fn push(&mut self, value: Value<'a>) -> Result<(), FieldError> {
        if self.stack.len() == MAX_STACK {
            return Err(limit("values on the stack of a pickle", MAX_STACK as u64 + 1, MAX_STACK as u64));
        }
        self.stack.push(value);
        Ok(())
    }

    /// Index of the lowest value above the last mark.
    fn floor(&self) -> usize {
        self.marks.last().copied().unwrap_or(0)
    }

    fn pop(&mut self) -> Result<Value<'a>, FieldError> {
        let above = self.stack.len() > self.floor();
        above.then(|| self.stack.pop()).flatten().ok_or_else(|| self.fault("a value is taken that is not there"))
    }

    fn top(&self) -> Result<Value<'a>, FieldError> {
        let above = &self.stack[self.floor()..];
        above.last().copied().ok_or_else(|| self.fault("a value is used that is not there"))
    }

    /// The values above the last mark, which goes with them.
    fn pop_mark(&mut self) -> Result<Vec<Value<'a>>, FieldError> {
        let mark = self.marks.pop().ok_or_else(|| self.fault("a mark is taken that is not there"))?;
        Ok(self.above(mark))
    }

    /// Takes the values from index `first` up, in a list no longer than they are: `split_off` would hand over the stack's own
    /// allocation when it takes all, and a container for each of many opcodes would hold as much.
    fn above(&mut self, first: usize) -> Vec<Value<'a>> {
        self.stack.drain(first..).collect()
    }

    fn push_container(&mut self, container: Container<'a>) -> Result<(), FieldError> {
        let value = self.made_container(container);
        self.push(value)
    }

    fn made_container(&mut self, container: Container<'a>) -> Value<'a> {
        self.made.containers.push(container);
        Value::Container(self.made.containers.len() - 1)
    }

    fn push_tuple(&mut self, count: usize) -> Result<(), FieldError> {
        let first = self.stack.len().checked_sub(count).filter(|&first| first >= self.floor());
        let first = first.ok_or_else(|| self.fault("a tuple is made of values that are not there"))?;
        let members = self.above(first);
        self.push_container(Container::Tuple(members))
    }

    fn remember(&mut self, key: u64) -> Result<(), FieldError> {
        let top = self.top()?;
        self.memo.insert(key, top);
        Ok(())
    }

    fn recall(&mut self, key: u64) -> Result<(), FieldError> {
        let value = self.memo.get(&key).copied();
        let value = value.ok_or_else(|| self.fault("the memo has no such entry"))?;
        self.push(value)
    }

    fn memo_key(&mut self) -> Result<u64, FieldError> {
        let line = self.line(20)?;
        let key = std::str::from_utf8(line).ok().and_then(|text| text.trim_end().parse().ok());
        key.ok_or_else(|| self.fault("a memo entry has no number"))
    }

    fn text_of(bytes: &'a [u8]) -> Value<'a> {
        std::str::from_utf8(bytes).map_or(Value::Opaque, Value::Text)
    }

    fn run(mut self) -> Result<Loaded<'a>, FieldError> {
        loop {
            self.opcode_at = self.at;
            self.charge(1)?;
            let opcode = self.u8()? as u8;
            if opcode == b'.' {
                self.made.root = self.pop()?;
                self.made.end = self.at;
                return Ok(self.made);
            }
            self.step(opcode)?;
        }
    }

    fn step(&mut self, opcode: u8) -> Result<(), FieldError> {
        match opcode {
            // the protocol's number, and the length of a frame, which only helps those who read in pieces
            0x80 => match self.u8()? {
                0..=5 => Ok(()),
                other => Err(self.unsupported(format!("protocol {other} of pickles"))),
            },
            0x95 => self.take(8).map(|_| ()),
            b'(' if self.marks.len() == MAX_MARKS => {
                Err(limit("open marks of a pickle", MAX_MARKS as u64 + 1, MAX_MARKS as u64))
            }
            b'(' => {
                self.marks.push(self.stack.len());
                Ok(())
            }
            b'0' if self.marks.last() == Some(&self.stack.len()) => self.pop_mark().map(|_| ()),
            b'0' => self.pop().map(|_| ()),
            b'1' => self.pop_mark().map(|_| ()),
            b'2' => self.top().and_then(|top| self.push(top)),
            b'p' => self.memo_key().and_then(|key| self.remember(key)),
            b'q' => self.u8().and_then(|key| self.remember(key as u64)),
            b'r' => self.u32().and_then(|key| self.remember(key as u64)),
            0x94 => self.remember(self.memo.len() as u64),
            b'g' => self.memo_key().and_then(|key| self.recall(key)),
            b'h' => self.u8().and_then(|key| self.recall(key as u64)),
            b'j' => self.u32().and_then(|key| self.recall(key as u64)),
            b'c' | b'i' | b'o' | b'R' | b'b' | b'Q' | 0x81 | 0x92 | 0x93 => self.object(opcode),
            b'P' => Err(self.unsupported("a persistent name as text")),
            0x82..=0x84 => Err(self.unsupported("a registered extension")),
            0x97 | 0x98 => Err(self.unsupported("a buffer outside the pickle")),
            b']' | b')' | b'}' | 0x8f | b'l' | b't' | b'd' | 0x91 | 0x85..=0x87 => self.container(opcode),
            b'a' | b'e' | b's' | b'u' | 0x90 => self.fill(opcode),
            _ => {
                let value = self.scalar(opcode)?;
                self.push(value)
            }
        }
    }

    /// Opcodes that push one value of a kind without members.
    fn scalar(&mut self, opcode: u8) -> Result<Value<'a>, FieldError> {
        Ok(match opcode {
            b'N' => Value::None,
            0x88 | 0x89 => Value::Opaque,
            b'J' => Value::Int(i64::from(i32::from_le_bytes(self.array()?))),
            b'K' => Value::Int(i64::from(self.array::<1>()?[0])),
            b'M' => Value::Int(i64::from(u16::from_le_bytes(self.array()?))),
            0x8a => {
                let count = self.u8()?;
                whole(self.take(count)?)
            }
            0x8b => {
                let count = self.u32()?;
                whole(self.take(count)?)
            }
            b'I' | b'L' => {
                let line = self.line(MAX_LINE)?;
                let text = std::str::from_utf8(line).unwrap_or_default().trim_end().trim_end_matches('L');
                text.parse().map_or(Value::Opaque, Value::Int)
            }
            b'G' => self.take(8).map(|_| Value::Opaque)?,
            b'F' => self.line(MAX_LINE).map(|_| Value::Opaque)?,
            b'X' | b'T' => {
                let count = self.u32()?;
                Self::text_of(self.take(count)?)
            }
            b'U' | 0x8c => {
                let count = self.u8()?;
                Self::text_of(self.take(count)?)
            }
            0x8d => {
                let count = self.u64()?;
                Self::text_of(self.take(count)?)
            }
            b'S' | b'V' => {
                let line = self.line(MAX_LINE)?;
                let quoted = |q: u8| line.strip_prefix(&[q]).and_then(|l| l.strip_suffix(&[q]));
                let line = if opcode == b'S' { quoted(b'\'').or_else(|| quoted(b'"')).unwrap_or(line) } else { line };
                // escapes stand for characters that no name of a tensor has
                if line.contains(&b'\\') { Value::Opaque } else { Self::text_of(line) }
            }
            b'C' => {
                let count = self.u8()?;
                self.take(count).map(|_| Value::Opaque)?
            }
            b'B' => {
                let count = self.u32()?;
                self.take(count).map(|_| Value::Opaque)?
            }
            0x8e | 0x96 => {
                let count = self.u64()?;
                self.take(count).map(|_| Value::Opaque)?
            }
            other => return Err(self.fault(format!("no opcode is written as {other:#04x}"))),
        })
    }

    /// Opcodes that push a container.
    fn container(&mut self, opcode: u8) -> Result<(), FieldError> {
        match opcode {
            b']' => self.push_container(Container::List(Vec::new())),
            b')' => self.push_container(Container::Tuple(Vec::new())),
            b'}' => self.push_container(Container::Dictionary(Vec::new())),
            0x8f => self.push(Value::Opaque),
            0x85..=0x87 => self.push_tuple(usize::from(opcode - 0x84)),
            0x91 => self.pop_mark().and_then(|_| self.push(Value::Opaque)),
            _ => {
                let members = self.pop_mark()?;
                let made = match opcode {
                    b'l' => Container::List(members),
                    b't' => Container::Tuple(members),
                    _ => Container::Dictionary(self.pairs(&members)?),
                };
                self.push_container(made)
            }
        }
    }

    fn pairs(&self, members: &[Value<'a>]) -> Result<Vec<(Value<'a>, Value<'a>)>, FieldError> {
        let (pairs, rest) = members.as_chunks::<2>();
        if !rest.is_empty() {
            return Err(self.fault("a key of a dictionary has no value"));
        }
        Ok(pairs.iter().map(|pair| (pair[0], pair[1])).collect())
    }

    /// Opcodes that put members into a container below them. What is put into an opaque value is gone.
    fn fill(&mut self, opcode: u8) -> Result<(), FieldError> {
        let members = match opcode {
            b'a' => vec![self.pop()?],
            b's' => {
                let value = self.pop()?;
                vec![self.pop()?, value]
            }
            _ => self.pop_mark()?,
        };
        let target = self.top()?;
        if target == Value::Opaque {
            return Ok(());
        }
        let pairs = if matches!(opcode, b's' | b'u') { self.pairs(&members)? } else { Vec::new() };
        let container = match target {
            Value::Container(index) => self.made.containers.get_mut(index),
            _ => None,
        };
        match (container, opcode) {
            (Some(Container::List(list)), b'a' | b'e') => list.extend(members),
            (Some(Container::Dictionary(dictionary)), b's' | b'u') => dictionary.extend(pairs),
            _ => return Err(self.fault("members are put into a value that holds none")),
        }
        Ok(())
    }
}

/// A whole number in two's complement, little end first.
fn whole(bytes: &[u8]) -> Value<'_> {
    if bytes.len() > 8 {
        return Value::Long(bytes);
    }
    let negative = bytes.last().is_some_and(|b| b & 0x80 != 0);
    let mut filled = if negative { [0xff; 8] } else { [0; 8] };
    filled[..bytes.len()].copy_from_slice(bytes);
    Value::Int(i64::from_le_bytes(filled))
}
